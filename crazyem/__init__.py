"""crazyem: online estimation of a Crazyflie's mass and inertia, and their safe return to its controller."""
