"""Logs of the uSD card deck."""
