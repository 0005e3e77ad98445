"""Logs of PX4 and MAVLink autopilots."""
