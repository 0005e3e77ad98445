"""A UDP relay that harms the packets between a host and a Crazyflie on purpose: `python -m firmware_sim.relay`."""
