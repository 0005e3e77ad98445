"""A second front end of the same simulated drone: MAVLink 2 over UDP or a serial port, in the manner of PX4."""
