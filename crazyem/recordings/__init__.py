"""Flights on disk: one reader a file format, all giving the same `Recording`; and the MCAP writer of our own."""

from crazyem.recordings.recording import Event, Recording, SignalArray
from crazyem.recordings.registry import open_recording

__all__ = ["Event", "Recording", "SignalArray", "open_recording"]
