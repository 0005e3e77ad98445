"""firmware_sim: a simulated Crazyflie that answers CRTP on udp://. Shares no code with crazyem."""
