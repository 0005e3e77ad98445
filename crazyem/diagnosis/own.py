"""What belongs to one recording and to no drone: the clock of its rotors, the frame of its pose, what was assumed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from crazyem.diagnosis.alignment import Alignment
from crazyem.diagnosis.flight import Flight
from crazyem.diagnosis.frame import Frame


@dataclass(frozen=True, eq=False)
class Own:
    """Found in a recording and taken off before anything is fitted; never written into a vehicle file.

    Attributes:
        recording: its path.
        held_out: whether it is one that is only judged by.
        alignment: how late measured rotor speeds are behind the body rates; None where unknown.
        frame: how the pose lies against that of the other recordings; None where alike or unknown.
        notices: a sentence each.
    """

    recording: str
    held_out: bool
    alignment: Alignment | None
    frame: Frame | None
    notices: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """As docs/diagnosis.md has it."""
        clock, frame = self.alignment, self.frame
        return {
            "recording": self.recording,
            "held_out": self.held_out,
            "rotor_clock": clock and {
                "delay": clock.delay, "sd": clock.sd, "roll": clock.roll, "pitch": clock.pitch,
                "explained_share": clock.explained, "unit": "s",
            },
            "pose_frame": frame and {"roll": frame.roll, "pitch": frame.pitch, "sd": list(frame.sd), "unit": "rad"},
        }  # fmt: skip


def owned(flights: Sequence[Flight], kept_apart: Sequence[Flight]) -> tuple[Own, ...]:
    """Of all flights, those kept apart last."""
    return tuple(
        Own(f.name, apart, f.alignment, f.frame, (*f.notices, *([f.frame.said()] if f.frame else [])))
        for part, apart in ((flights, False), (kept_apart, True))
        for f in part
    )
