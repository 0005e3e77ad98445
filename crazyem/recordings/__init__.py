"""Recorded flights: one reader per file format, all of which return a `Recording`; and the writer of MCAP files."""

from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.finding import Finding, Fix, Grade
from crazyem.recordings.recording import Event, Recording, SignalArray
from crazyem.recordings.registry import open_recording

__all__ = ["Event", "Finding", "Fix", "Grade", "ReadOptions", "Recording", "SignalArray", "open_recording"]
