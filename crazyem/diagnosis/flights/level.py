"""The voltage of a battery that is not recorded: by this voltage, the first commands of a flight carry the weight.

Batteries have different charges. With one assumed voltage for all flights, the thrust is wrong by up to a third, by
another amount in every flight. With a thrust cut off at the limit of the rotors, it is even hidden that commands rise
while the thrust is constant. Like the clock of the rotors, this voltage belongs to a recording and is written nowhere.
Such a recording does not determine the total strength or mass of the drone, only their changes.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid
from scipy.optimize import brentq

from crazyem.diagnosis.settings import LEVELLING
from crazyem.physics.rotations import quaternion_from_euler
from crazyem.physics.rotors import thrust_from_command
from crazyem.recordings.airborne import Airtime
from crazyem.recordings.ordering import ordered
from crazyem.recordings.recording import Recording
from crazyem.vehicle import GRAVITY, Vehicle


@dataclass(frozen=True)
class Level:
    """An estimated voltage.

    Attributes:
        voltage: V.
        known: s, stamp of the last sample of the estimate.
    """

    voltage: float
    known: float


def level_of(
    recording: Recording,
    vehicle: Vehicle,
    flight: Airtime | None,
    time: NDArray,
    command: NDArray,
    *,
    nominal: float,
    until: float = np.inf,
) -> Level | None:
    """The voltage for which the vertical impulse of the thrust equals that of weight and change of velocity.

    Args:
        time, command: (m,) s and (m, 4) sent duty, 0..1.
        nominal: V, centre of the search.
        until: s, later samples are not used; if `until` is early, less than `LEVELLING.min_use` is enough.

    Returns:
        None if the recording has neither velocity nor position, if the flight is too short, or if no admitted voltage
        fits.
    """
    moving = {"velocity", "position"} & set(recording.signals)
    if flight is None or not flight.flown or not moving or not vehicle.thrust_curve:
        return None
    begin, short = _clear(recording, flight), LEVELLING.min_use
    if begin + LEVELLING.min_use > until:
        begin, short = flight.flown[0][0], 0.5 * LEVELLING.looks[0]
    end = min(begin + LEVELLING.use, max(e for b, e in flight.flown if b <= begin), until)
    at, upwards = _climbing(recording, begin, end)
    if "velocity" not in recording.signals and at.size:
        begin, end = float(at[0]), float(at[-1])
    inside = (time >= begin) & (time <= end)
    if at.size < 2 or inside.sum() < 2 or end - begin < short:
        return None
    grid = time[inside]
    wanted = vehicle.mass * (
        GRAVITY * (grid[-1] - grid[0]) + np.interp(grid[-1], at, upwards) - np.interp(grid[0], at, upwards)
    )
    upright = _upright(recording, grid)

    def lacking(voltage: float) -> float:
        volts = np.full(grid.size, voltage)
        thrust = thrust_from_command(command[inside], volts, thrust_curve=vehicle.thrust_curve).sum(axis=1)
        return float(trapezoid(thrust * upright, grid) - wanted)

    low, high = (share * nominal for share in LEVELLING.voltage_range)
    if not lacking(low) < 0.0 < lacking(high):
        return None
    return Level(float(brentq(lacking, low, high, xtol=1e-4)), float(max(at[-1], grid[-1])))


def _climbing(recording: Recording, begin: float, end: float) -> tuple[NDArray, NDArray]:
    """Stamps (n,) s between two times and upward velocities (n,) m/s there; without a recorded velocity, the slopes of
    the height at both ends."""
    shown = "velocity" if "velocity" in recording.signals else "position"
    when, value = ordered(recording.signals[shown])
    seen = (when >= begin) & (when <= end) & np.isfinite(value[:, 2])
    at, upwards = when[seen], value[seen, 2]
    if shown == "velocity" or not at.size:
        return at, upwards
    ends = np.array([at[0] + 0.5 * LEVELLING.slope, at[-1] - 0.5 * LEVELLING.slope])
    near = [np.abs(at - e) <= 0.5 * LEVELLING.slope for e in ends]
    if ends[0] >= ends[1] or min(n.sum() for n in near) < LEVELLING.min_heights:
        return at[:0], upwards[:0]
    return ends, np.array([np.polyfit(at[n] - e, upwards[n], 1)[0] for n, e in zip(near, ends, strict=True)])


def _clear(recording: Recording, flight: Airtime) -> float:
    """Time at which the drone first is `LEVELLING.clear_height` above the floor [s]; else of take-off."""
    took_off = flight.flown[0][0]
    if "position" not in recording.signals or not np.isfinite(flight.ground):
        return took_off
    when, place = ordered(recording.signals["position"])
    high = when[
        (when >= took_off)
        & (when < took_off + LEVELLING.max_rise_time)
        & (place[:, 2] - flight.ground > LEVELLING.clear_height)
    ]
    return float(high[0]) if high.size else took_off


def _upright(recording: Recording, time: NDArray) -> NDArray:
    """(m,) cosine of the tilt; 1 where no attitude is recorded."""
    for name in ("attitude", "euler"):
        when, value = ordered(recording.signals[name]) if name in recording.signals else (np.empty(0), np.empty(0))
        if when.size:
            q = quaternion_from_euler(*value.T) if name == "euler" else value
            tilt = 1.0 - 2.0 * (q[:, 0] ** 2 + q[:, 1] ** 2) / np.maximum((q**2).sum(axis=1), 1e-12)
            return np.interp(time, when, tilt)
    return np.ones(time.size)
