"""Nuisances of single recordings, not of the drone, and the roles of recordings.

The clock of the rotors, the frame of the pose and the height of the floor belong to a recording. If a recording
begins with turning rotors, it does not show the drone at rest, and heights would count from the origin of its frame. A
marker on top of a drone is several centimetres higher, which is as far as a ground effect reaches. Such a recording
gets the floor of the others. Hovers have too little information to be fitted if others have more:
then they are held out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.flights.alignment import Alignment
from crazyem.diagnosis.flights.flight import Flight, Frame
from crazyem.diagnosis.settings import LEVELLING, RECORDINGS


def with_common_floor(flights: Sequence[Flight], kept_apart: Sequence[Flight]) -> tuple[list[Flight], list[Flight]]:
    """The flights; those without a floor get the floor of the others, if these agree and the flight is not below it."""
    everyone = [*flights, *kept_apart]
    shown = [f.ground for f in everyone if f.grounded]
    if len(shown) < LEVELLING.min_floors or len(shown) == len(everyone) or np.ptp(shown) > LEVELLING.floor_range:
        return list(flights), list(kept_apart)
    level = float(np.median(shown))
    return [_stood(f, level) for f in flights], [_stood(f, level) for f in kept_apart]


def _stood(flight: Flight, level: float) -> Flight:
    height = flight.y[:, 2]
    if flight.grounded or not np.isfinite(height).any() or float(np.nanmin(height)) < level - LEVELLING.floor_range:
        return flight
    said = f"the drone is never seen at rest, so the floor is taken to be where the others have it, z = {level:.3f} m"
    return replace(flight, ground=level, notices=(*flight.notices, said))


def swapped(fitted: Sequence[Flight], kept_apart: Sequence[Flight]) -> bool:
    """Whether all flights to fit hover and a held-out one is much faster: then they exchange their roles.

    A fit to hovers gives wrong parameters, which fail on other flights: a velocity scale of 1.56 instead of 1.13, a
    quadratic drag of 0.07 instead of 0.02.
    """
    if not kept_apart:
        return False
    here, there = np.array([_rms_motion(f) for f in fitted]), np.array([_rms_motion(f) for f in kept_apart])
    hovers = bool(np.all(here[:, 0] < RECORDINGS.hover_speed) and np.all(here[:, 1] < RECORDINGS.hover_rate))
    return hovers and bool(
        np.any(there[:, 0] > max(RECORDINGS.hover_speed, RECORDINGS.speed_ratio * float(here[:, 0].max())))
    )


def swap_sentence(fitted: Sequence[str], kept_apart: Sequence[str]) -> str:
    """The sentence that tells of the exchange; `fitted` and `kept_apart` are the new roles."""
    now, first = (", ".join(Path(p).name for p in part) for part in (fitted, kept_apart))
    here = f"physics is fitted to what was held out, {now}, and confirmed by it"
    return f"{first}: only hovers, so {here} (--strict-held-out forbids that)"


def _rms_motion(flight: Flight) -> NDArray:
    """(2,) rms of the horizontal speed [m/s] and of the body rate [rad/s]; NaN where not measured."""
    return np.array([_rms(flight.y[:, 3:5]), _rms(flight.y[:, 10:13])])


def _rms(values: NDArray) -> float:
    known = np.isfinite(values).all(axis=1)
    return float(np.sqrt(np.mean(np.sum(np.square(values[known]), axis=1)))) if known.any() else float("nan")


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
        """Clock and frame in the format of free parameters of a fit (`naming/answer.py`)."""
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
