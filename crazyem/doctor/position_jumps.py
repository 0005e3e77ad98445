"""Leaps of a position that no drone can make, out and back or for good, and a position stored in coarse steps."""

import math

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor.streams import longest, same_as_before
from crazyem.recordings.finding import Finding, Fix, Grade
from crazyem.recordings.recording import SignalArray

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

LEAST_JUMP = 0.1  # m in one step, beyond the motion around it: ten times what a step at 100 Hz and 1 m/s is
CRASH_ACCELERATION = 100.0  # m/s^2 of a crash: by what a drone may leave the line between two samples
JUMP_NOISE_RATIO = 12.0  # times the usual deviation of a step from the motion around it
MEDIAN_STEPS = 5  # steps on each side whose median is the motion
RETURN_SECONDS = 0.5  # s after which the position is where the motion before leads, if it leaps back
COARSE_RESOLUTION = 0.005  # m, resolution from which a velocity over 0.1 s is known to no better than 5 cm/s
_FEWEST_SAMPLES = 50


def position_jumps(name: str, array: SignalArray, *, furthest: float) -> list[Finding]:
    """Findings of one position signal, of samples not further than `furthest` [m]; what is held is no new sample."""
    with np.errstate(invalid="ignore"):
        good = np.isfinite(array.time) & (np.abs(array.value) <= furthest).all(axis=1) & ~same_as_before(array.value)
    sound = np.flatnonzero(good)
    time, value = array.time[sound], array.value[sound]
    if sound.size < _FEWEST_SAMPLES or (np.diff(time) <= 0.0).any():
        return []
    steps = np.diff(time)
    velocity = np.diff(value, axis=0) / steps[:, None]
    expected = _neighbour_velocity(velocity)
    off = np.linalg.norm(velocity - expected, axis=1) * steps
    usual = float(np.median(off))
    limit = np.maximum(np.maximum(LEAST_JUMP, JUMP_NOISE_RATIO * usual), 0.5 * CRASH_ACCELERATION * steps**2)
    rows = np.flatnonzero((off > limit) & (steps < RETURN_SECONDS))
    return [*_found(name, array, sound, time, value, rows, off), *_coarse(name, array, value)]


def _neighbour_velocity(velocity: Array) -> Array:
    """(n, 3) the median velocity of the steps on both sides of each step, without itself."""
    padded = np.pad(velocity, ((MEDIAN_STEPS, MEDIAN_STEPS), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * MEDIAN_STEPS + 1, axis=0)
    return np.median(windows, axis=2)


def _found(
    name: str, array: SignalArray, sound: Rows, time: Array, value: Array, rows: Rows, off: Array
) -> list[Finding]:
    """One finding for all leaps: those that come back can be marked."""
    if not rows.size:
        return []
    flags = np.zeros(array.time.size, bool)
    spans: list[tuple[float, float]] = []
    away = 0
    k = 0
    while k < rows.size:
        first = int(rows[k])
        size = float(off[first])
        later = rows[k + 1 :][time[rows[k + 1 :]] - time[first] < RETURN_SECONDS]
        # back where the motion before leads, to half of the leap
        back = next((int(r) for r in later if np.linalg.norm(value[r + 1] - value[first]) < 0.5 * size), None)
        if back is None:
            away += 1
            spans.append((float(time[first]), float(time[first + 1])))
            k += 1
        else:
            flags[sound[first + 1] : sound[back + 1]] = True  # with what was held
            spans.append((float(time[first + 1]), float(array.time[sound[back + 1] - 1])))
            k = int(np.searchsorted(rows, back, "right"))
    worst = int(rows[np.argmax(off[rows])])
    lasting = float(time[worst + 1] - time[worst])
    speed = float(off[worst]) / lasting
    marked = int(flags.sum())
    times = "once" if len(spans) == 1 else f"{len(spans)} times"
    back_again = "" if not marked else " and back" if not away else f", {len(spans) - away} of them back"
    return [
        Finding(
            "numbers",
            Grade.DEGRADES,
            f"{name} leaps {times}{back_again}, by up to {off[worst]:.2f} m in {1e3 * lasting:.0f} ms "
            f"({speed:.0f} m/s): no drone moves like that.",
            signal=name,
            intervals=longest(spans),
            evidence={"leaps": len(spans), "size_m": float(off[worst]), "speed_m_s": speed, "samples": marked},
            advice="Mark the samples away from the path as missing (--fix)."
            if marked
            else "Another frame from there on, or a jump of the filter on board: use the parts before and after.",
            fix=Fix("mark", (name,), rows=np.flatnonzero(flags)) if marked else None,
        )
    ]


def _coarse(name: str, array: SignalArray, value: Array) -> list[Finding]:
    """A note where the position is stored in coarse steps."""
    grains = [_grain(column) for column in value.T]
    known = [g for g in grains if math.isfinite(g)]
    if not known or min(known) < COARSE_RESOLUTION:
        return []
    grain = min(known)
    return [
        Finding(
            "numbers",
            Grade.HARMLESS,
            f"{name} is stored in steps of {100.0 * grain:.2g} cm.",
            signal=name,
            evidence={"resolution_m": grain},
            advice="Log it with more digits: a velocity over 0.1 s is known to no better than "
            f"{grain / 0.1:.2g} m/s from it.",
        )
    ]


def _grain(column: Array) -> float:
    """The step of which all changes of (n,) are multiples; NaN without changes or without such a step."""
    steps = np.abs(np.diff(column))
    steps = steps[steps > 1e-9]
    if steps.size < 20:
        return math.nan
    least = float(steps.min())
    multiple = steps / least
    return least if float((np.abs(multiple - np.round(multiple)) < 0.02).mean()) > 0.98 else 0.0
