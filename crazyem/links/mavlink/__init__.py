"""MAVLink links: PX4 and ArduPilot behind the same interface as a Crazyflie (`link.MavlinkLink`)."""
