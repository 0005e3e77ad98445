"""Extremes of the motion of a recording while the drone was in the air."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from crazyem.doctor.kinematics import upright
from crazyem.recordings.airborne import Airtime
from crazyem.recordings.ordering import Array, sound_samples
from crazyem.recordings.recording import Recording

SATURATED_DUTY = 0.999  # duty from which a rotor is at its limit
_SPEED_SPAN = 0.1  # s over which position is differenced where there is no velocity


@dataclass(frozen=True, slots=True)
class Envelope:
    """Extremes of the airborne part; None where a signal is missing. SI, world z up, body FLU."""

    airborne_s: float
    judged_by: tuple[str, ...]
    speed_max_m_s: float | None = None
    speed_rms_m_s: float | None = None
    speed_from: str = ""
    tilt_max_deg: float | None = None
    tilt_from: str = ""
    body_rate_max_rad_s: tuple[float, float, float] | None = None
    altitude_min_m: float | None = None
    altitude_max_m: float | None = None
    vertical_speed_min_m_s: float | None = None
    vertical_speed_max_m_s: float | None = None
    acceleration_max_m_s2: float | None = None
    specific_force_min_m_s2: float | None = None
    specific_force_max_m_s2: float | None = None
    voltage_start_V: float | None = None
    voltage_end_V: float | None = None
    voltage_min_V: float | None = None
    motor_command_max: float | None = None
    motor_saturated_share: float | None = None
    airborne_intervals_s: tuple[tuple[float, float], ...] = ()


def envelope(recording: Recording, air: Airtime) -> Envelope:
    """Extremes of the airborne part, of samples as measured: one outlier is enough to set an extreme."""
    found = _speeds(recording, air)
    for name, extremes in _EXTREMES.items():
        value = _in_the_air(recording, name, air)
        if value is not None and not (name == "euler" and "tilt_from" in found):
            found |= extremes(value)
        del value  # of a long flight, one signal at a time
    return Envelope(air.seconds, air.judged_by, airborne_intervals_s=air.flown, **found)


def _range(key: str, value: Array) -> dict[str, float]:
    return {key.format("min"): float(value.min()), key.format("max"): float(value.max())}


def _tilt(source: str, upright: Array) -> dict[str, Any]:
    """From the cosines (n,) of the tilt."""
    return {"tilt_from": source, "tilt_max_deg": float(np.degrees(np.arccos(np.clip(upright.min(), -1.0, 1.0))))}


# Signal -> extremes of its samples in the air (n, c); Euler angles count where there is no quaternion.
_EXTREMES: dict[str, Callable[[Array], dict[str, Any]]] = {
    "attitude": lambda q: _tilt("attitude", upright(q)),
    "euler": lambda angles: _tilt("euler", np.cos(angles[:, 0]) * np.cos(angles[:, 1])),
    "body_rate": lambda rate: {"body_rate_max_rad_s": tuple(float(r) for r in np.abs(rate).max(axis=0))},
    "position": lambda position: _range("altitude_{}_m", position[:, 2]),
    "acceleration": lambda a: {"acceleration_max_m_s2": float(np.linalg.norm(a, axis=1).max())},
    "specific_force": lambda force: _range("specific_force_{}_m_s2", np.linalg.norm(force, axis=1)),
    "voltage": lambda volts: {
        "voltage_start_V": float(volts[0, 0]),
        "voltage_end_V": float(volts[-1, 0]),
        "voltage_min_V": float(volts.min()),
    },
    "motor_command": lambda duty: {
        "motor_command_max": float(duty.max()),
        "motor_saturated_share": float((duty >= SATURATED_DUTY).any(axis=1).mean()),
    },
}


def sound_signal(recording: Recording, name: str) -> tuple[Array, Array] | None:
    """Times (n,) and values (n, c) of the samples that are numbers, in order of time; None if there are none."""
    array = recording.signals.get(name)
    return None if array is None else sound_samples(array)


def _in_the_air(recording: Recording, name: str, air: Airtime) -> Array | None:
    """(n, c) sound samples of a signal in the air, None if there are none."""
    found = sound_signal(recording, name)
    if found is None:
        return None
    value = found[1][air.covers(found[0])]
    return value if value.size else None


def _speeds(recording: Recording, air: Airtime) -> dict[str, Any]:
    """Extremes of the velocity in the air, or of differences of the position."""
    source, velocity = "velocity", _in_the_air(recording, "velocity", air)
    if velocity is None:
        source, velocity = "position", _differences(recording, air)
    if velocity is None:
        return {}
    norm = np.linalg.norm(velocity, axis=1)
    extremes = {"speed_max_m_s": float(norm.max()), "speed_rms_m_s": float(np.sqrt(np.mean(norm**2)))}
    return {"speed_from": source, **extremes, **_range("vertical_speed_{}_m_s", velocity[:, 2])}


def _differences(recording: Recording, air: Airtime) -> Array | None:
    """Velocity (n, 3) [m/s] in the air by differences of the position; None if there are none."""
    found = sound_signal(recording, "position")
    if found is None:
        return None
    time, position = found
    row = np.searchsorted(time, time + _SPEED_SPAN)
    later = np.minimum(row, time.size - 1)
    span = time[later] - time
    whole = (row < time.size) & air.covers(time) & air.covers(time[later]) & (span < 2.0 * _SPEED_SPAN)
    return (position[later] - position)[whole] / span[whole, None] if whole.any() else None
