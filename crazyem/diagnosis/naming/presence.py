"""How probable it is that an effect is there, by what it explains of flight that it was not fitted to."""

# Probability that a name is right, by what it brings on flight held out [nats]: log-odds are SLOPE log(nats / EVEN), at
# most CALIBRATED. Models are approximate: on healthy flights of random worlds wrong names gain tens of nats, and their
# gains have a heavy tail. By 48 names in 67 random and foreign worlds (seeds 5050, 71001, 6060) EVEN is 42 and SLOPE
# 1.15 (EVEN 30 to 90 within 0.5 of log-likelihood); the lower end is taken, by which fewest effects are lost.
EVEN, SLOPE, CALIBRATED = 30.0, 1.1, 0.95
TOLD = 0.5  # probability below which an effect is no finding


def presence(held_out_nats: float) -> float:
    """Probability that an effect is there, whatever its look-alikes, by what it brings on flight held out [nats]."""
    if held_out_nats <= 0.0:
        return 0.0
    return min(CALIBRATED, 1.0 / (1.0 + (EVEN / held_out_nats) ** SLOPE))
