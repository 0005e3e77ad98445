"""Nuisances of single recordings, not of the drone: clock of the rotors, frame of the pose, assumptions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crazyem.diagnosis.flights.alignment import Alignment
from crazyem.diagnosis.flights.flight import Flight, Frame
from crazyem.diagnosis.settings import RECORDINGS


@dataclass(frozen=True, eq=False)
class RecordingNuisances:
    """Nuisances of a recording, corrected beforehand or fitted; never written into a vehicle file.

    Attributes:
        recording: its path.
        held_out: whether it is a held-out recording.
        alignment: delay of measured rotor speeds behind the body rates; None where unknown.
        frame: tilt of the pose frame against the other recordings; None if equal or unknown.
        strength: thrust over that of the fitted vehicle; None if it is not fitted (see `nuisances.SEVERAL`).
        notices: a sentence each.
    """

    recording: str
    held_out: bool
    alignment: Alignment | None
    frame: Frame | None
    strength: float | None
    notices: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """The nuisances in the format of docs/reference/json.md."""
        clock, frame = self.alignment, self.frame
        return {
            "recording": self.recording,
            "held_out": self.held_out,
            "rotor_clock": clock and {
                "delay": clock.delay, "sd": clock.sd, "roll": clock.roll, "pitch": clock.pitch,
                "explained_share": clock.explained, "unit": "s",
            },
            "pose_frame": frame and {"roll": frame.roll, "pitch": frame.pitch, "sd": list(frame.sd), "unit": "rad"},
            "notices": list(self.notices),
            "thrust": self.strength and {"scale": self.strength, "unit": ""},
        }  # fmt: skip

    def free(self) -> list[dict[str, Any]]:
        """Clock and frame in the format of free parameters of a fit (`naming/free.py`)."""
        name, found = Path(self.recording).name, []
        if self.alignment:
            found.append(("rotor clock", f"delay, {name}", self.alignment.delay, self.alignment.sd, "s"))
        if self.frame:
            angles = (self.frame.roll, self.frame.pitch)
            for axis, angle, sd in zip(("roll", "pitch"), angles, self.frame.sd, strict=True):
                found.append(("pose frame", f"{axis}, {name}", angle, sd, "rad"))
        keys = ("words", "parameter", "value", "sd", "unit")
        return [{"name": None, **dict(zip(keys, f, strict=True)), "expected": 0.0, "usual": None} for f in found]


def nuisances_of_recordings(
    flights: Sequence[Flight], kept_apart: Sequence[Flight], strengths: Mapping[str, float] | None = None
) -> tuple[RecordingNuisances, ...]:
    """The nuisances of all flights, held-out ones last; `strengths` by name of the recording."""
    return tuple(
        _nuisances_of(f, apart, (strengths or {}).get(f.name))
        for part, apart in ((flights, False), (kept_apart, True))
        for f in part
    )


def _nuisances_of(flight: Flight, held_out: bool, strength: float | None) -> RecordingNuisances:
    notices = [*flight.notices]
    if flight.frame:
        notices.append(flight.frame.description())
    if strength is not None and abs(strength - 1.0) > RECORDINGS.thrust_difference:
        notices.append(f"the thrust of this recording differs by {100.0 * (strength - 1.0):+.1f} % from the vehicle's")
    return RecordingNuisances(flight.name, held_out, flight.alignment, flight.frame, strength, tuple(notices))
