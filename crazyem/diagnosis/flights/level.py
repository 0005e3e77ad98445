"""A battery that nobody measured: the voltage by which the commands of a flight's beginning carry the vehicle.

Batteries begin at other charges, so a voltage that is assumed alike for all is wrong by up to a third of the thrust,
differently in every flight; cut off at what the rotors can do it even hides that commands rise while the thrust stays.
Like the clock of its rotors the level is a property of a recording and never written anywhere. How strong or heavy the
drone is as a whole cannot be told from such a recording, only what changes in it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid
from scipy.optimize import brentq

from crazyem.physics.rotations import quaternion_from_euler
from crazyem.physics.rotors import thrust_from_command
from crazyem.recordings.airborne import Airtime
from crazyem.recordings.ordering import ordered
from crazyem.recordings.recording import Recording
from crazyem.vehicle import GRAVITY, Vehicle

CLEAR = 0.3  # m above the floor, where its effect is over; within
SOON = 5.0  # s of leaving it, else at once
LONG, SHORT = 3.0, 1.0  # s of flight that are looked at, and least;
LOOKS = (0.2, 0.5, 1.0, 2.0)  # s after leaving the floor when a prediction looks already
SLOPE, FEWEST_HEIGHTS = 0.2, 4  # s of a slope of the height that is a velocity, and heights in it
ADMITTED = (0.4, 1.4)  # times the nominal voltage


@dataclass(frozen=True)
class Level:
    """A voltage that was found.

    Attributes:
        voltage: V.
        known: s, stamp of the last sample that it follows from.
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
    """The voltage by which the impulse of the thrust along the vertical is that of weight and change of velocity.

    Args:
        time, command: (m,) s and (m, 4) duty sent, 0..1.
        nominal: V, about which it is looked for.
        until: s, what comes later is not looked at; then less than `SHORT` will do, from the moment it left the floor.

    Returns:
        None where the recording has neither velocity nor position, no flight that is long enough, or no voltage does
        it.
    """
    moving = {"velocity", "position"} & set(recording.signals)
    if flight is None or not flight.flown or not moving or not vehicle.thrust_curve:
        return None
    begin, short = _clear(recording, flight), SHORT
    if begin + SHORT > until:
        begin, short = flight.flown[0][0], 0.5 * LOOKS[0]
    end = min(begin + LONG, max(e for b, e in flight.flown if b <= begin), until)
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

    low, high = (share * nominal for share in ADMITTED)
    if not lacking(low) < 0.0 < lacking(high):
        return None
    return Level(float(brentq(lacking, low, high, xtol=1e-4)), float(max(at[-1], grid[-1])))


def _climbing(recording: Recording, begin: float, end: float) -> tuple[NDArray, NDArray]:
    """Stamps (n,) s within a time, and the upward velocity there (n,) m/s; without a recorded one the slope of the
    height at either end."""
    shown = "velocity" if "velocity" in recording.signals else "position"
    when, value = ordered(recording.signals[shown])
    seen = (when >= begin) & (when <= end) & np.isfinite(value[:, 2])
    at, upwards = when[seen], value[seen, 2]
    if shown == "velocity" or not at.size:
        return at, upwards
    ends = np.array([at[0] + 0.5 * SLOPE, at[-1] - 0.5 * SLOPE])
    near = [np.abs(at - e) <= 0.5 * SLOPE for e in ends]
    if ends[0] >= ends[1] or min(n.sum() for n in near) < FEWEST_HEIGHTS:
        return at[:0], upwards[:0]
    return ends, np.array([np.polyfit(at[n] - e, upwards[n], 1)[0] for n, e in zip(near, ends, strict=True)])


def _clear(recording: Recording, flight: Airtime) -> float:
    """When the drone was first clear of the floor [s]."""
    took_off = flight.flown[0][0]
    if "position" not in recording.signals or not np.isfinite(flight.ground):
        return took_off
    when, place = ordered(recording.signals["position"])
    high = when[(when >= took_off) & (when < took_off + SOON) & (place[:, 2] - flight.ground > CLEAR)]
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
