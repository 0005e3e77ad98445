"""Arguments of the API functions: recordings and vehicles, as objects or as names and paths."""

from collections.abc import Sequence
from pathlib import Path

from crazyem.physics import folding
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.recording import Recording
from crazyem.recordings.registry import open_recording
from crazyem.recordings.thrust import vehicle_for
from crazyem.vehicle import Vehicle

RecordingLike = Recording | str | Path
VehicleLike = Vehicle | str | Path


def recording_of(given: RecordingLike, options: ReadOptions | None = None) -> Recording:
    """The given recording, or the recording at a path. Raises as `open_recording`."""
    return given if isinstance(given, Recording) else open_recording(given, options)


def recordings_of(
    given: RecordingLike | Sequence[RecordingLike], options: ReadOptions | None = None
) -> list[Recording]:
    """One recording or several, as `recording_of`."""
    several = given if isinstance(given, Sequence) and not isinstance(given, str) else [given]
    return [recording_of(one, options) for one in several]


def vehicle_of(given: VehicleLike | None, recording: Recording | None = None) -> Vehicle:
    """The given vehicle, preset or file; None: the vehicle of the recording (see `recordings.thrust.vehicle_for`).

    Raises:
        UsageError: no such vehicle. FileFormatError: the file is no vehicle.
    """
    if isinstance(given, Vehicle):
        return given
    if recording is not None:
        return vehicle_for(recording, None if given is None else str(given))
    return folding.load("cf2" if given is None else given)
