"""Flights on disk: one reader a file format, all giving the same `Recording`; and the MCAP writer of our own."""

from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.finding import Finding, Fix, Grade
from crazyem.recordings.recording import Event, Recording, SignalArray
from crazyem.recordings.registry import open_recording

__all__ = ["Event", "Finding", "Fix", "Grade", "ReadOptions", "Recording", "SignalArray", "open_recording"]
