"""A UDP relay that puts faults on the packets between a host and a Crazyflie: `python -m firmware_sim.relay`."""
