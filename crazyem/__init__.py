"""Firmware-in-the-loop estimation of a Crazyflie's mass and inertia, online, by expectation maximisation."""

from typing import Any

__all__ = ["attach", "load_vehicle", "open_recording"]


def __getattr__(name: str) -> Any:
    # Lazy, so that `crazyem --help` does not wait for numba and cflib.
    if name == "attach":
        from crazyem.live.attach import attach

        return attach
    if name == "load_vehicle":
        from crazyem.vehicle import load_vehicle

        return load_vehicle
    if name == "open_recording":
        from crazyem.recordings import open_recording

        return open_recording
    raise AttributeError(f"module 'crazyem' has no attribute '{name}'")
