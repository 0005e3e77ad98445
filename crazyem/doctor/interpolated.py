"""Check: samples that were interpolated along straight lines in time, not measured, and that no reader has marked.

A measured signal is never exactly straight. Three samples in a row count as straight if the deviation of the middle one
from the line is less than 1e-4 of the change (stamps are rounded, too) plus the signal's resolution. Smooth signals at
high rates are nearly straight without interpolation. Then near misses are as frequent as hits, and nothing is reported.
"""

from collections.abc import Iterator

import numpy as np

from crazyem.doctor.streams import COMMAND_SIGNALS, cadence, graded, places
from crazyem.recordings.finding import Finding, Fix, Grade, percent, runs_of
from crazyem.recordings.ordering import Array, Flags, sound_rows
from crazyem.recordings.recording import Recording, SignalArray

STRAIGHT_DEVIATION = 1e-4  # largest deviation of a hit, over the change over two steps
NEAR_MISS_DEVIATION = 1e-3  # the same for a near miss
LEAST_RESOLUTION_STEPS = 1000.0  # least change over two steps, in units of the resolution, for a judgement
DEGRADING_INTERPOLATED_SHARE = 0.05  # share of samples that degrades results
RESAMPLED_SHARE = 0.5  # share of the moving samples from which the whole signal counts as resampled from a slower one


def check(recording: Recording) -> list[Finding]:
    """Findings about runs of interpolated samples and about signals resampled from a slower rate."""
    found: list[Finding] = []
    for name, array in recording.signals.items():
        if array.quantity and array.quantity not in COMMAND_SIGNALS and array.time.size >= 8:
            found += _signal(name, array)
    return found


def straightness(time: Array, value: Array) -> tuple[Flags, Flags, Flags]:
    """(n,) True where the signal moves and a sample lies on the line between its neighbours; where it almost does;
    where a sample is off this line.

    Args:
        time: (n,) s, increasing; may be uneven.
        value: (n, c), any unit; a component that does not move is no evidence, a component off the line is.
    """
    n = time.size
    span = time[2:] - time[:-2]
    with np.errstate(invalid="ignore", divide="ignore"):
        part = (time[1:-1] - time[:-2]) / span
    bend = np.zeros(n, bool)
    off_near = np.zeros(n, bool)
    moving = np.zeros(n, np.int8)
    with np.errstate(invalid="ignore"):
        for column in value.T:
            resolution = _resolution(column)
            change = column[2:] - column[:-2]
            deviation = np.abs(column[1:-1] - column[:-2] - part * change)
            np.abs(change, out=change)
            bend[1:-1] |= ~(deviation <= STRAIGHT_DEVIATION * change + resolution)
            off_near[1:-1] |= ~(deviation <= NEAR_MISS_DEVIATION * change + resolution)
            moving[1:-1] += change > LEAST_RESOLUTION_STEPS * resolution
    # two components on their lines are evidence; a single one only if a neighbour in time is on a line, too
    on = (moving > 0) & ~bend
    on &= (moving > 1) | (np.convolve(on, [1, 0, 1], "same") > 0)
    near = (moving > 0) & ~off_near & bend
    bend[[0, -1]] = False
    return on, near, bend


def _resolution(column: Array) -> float:
    """Upper bound of the resolution of a column: the smallest difference between some thousand of its values."""
    some = column[:: max(1, column.size // 4000)]
    values = np.unique(some[np.isfinite(some)])
    return float(np.diff(values).min()) if values.size > 1 else 0.0


def _signal(name: str, array: SignalArray) -> Iterator[Finding]:
    time, value, rows = array.time, array.value, np.arange(array.time.size)
    if (time[1:] <= time[:-1]).any():
        rows = np.flatnonzero(np.append(True, time[1:] > np.maximum.accumulate(time)[:-1]))
        time, value = time[rows], value[rows]
    if time.size < 8:
        return
    on, near, bend = straightness(time, value)
    hits, misses = int(on.sum()), int(near.sum())
    # by chance, a smooth signal has nine near misses for every hit
    if hits < 2 or hits < 0.5 * misses:
        return
    if array.marked.any() and hits < DEGRADING_INTERPOLATED_SHARE * time.size:
        return  # the reader has already marked this signal by its own rule
    present = sound_rows(value)
    share = hits / int(present.sum())
    wide = np.convolve(on, [1, 1, 1], "same") > 0
    spans = runs_of(wide)
    lasting = float((time[spans[:, 1] - 1] - time[spans[:, 0]]).max())
    moving = hits + int((bend & present).sum())
    evidence = {"samples": hits, "share": share, "runs": len(spans), "longest_s": lasting}
    fix = Fix("mark", (name,), rows=rows[on])
    if hits > RESAMPLED_SHARE * moving:
        duration = float(time[-1] - time[0])
        knots = runs_of(bend)
        beat = cadence(time[knots[:, 0]]).period if len(knots) else 0.0
        rate = 1.0 / beat if beat > 0 else len(knots) / max(duration, 1e-9)
        stored = (time.size - 1) / max(duration, 1e-9)
        text = f"{name} was measured at about {rate:.3g} Hz and drawn with straight lines to {stored:.0f} Hz."
        evidence |= {"rate_hz": rate, "stored_hz": stored}
        advice = "Mark the samples in between as missing (--fix); they hold nothing new."
        grade = Grade.HARMLESS if array.quantity == "voltage" else Grade.DEGRADES  # a voltage changes slowly
        yield Finding("interpolated", grade, text, name, (), evidence, advice, fix)
        return
    grade = graded(share, degrades=DEGRADING_INTERPOLATED_SHARE, unusable=0.6)
    text = (
        f"{percent(share)} of {name} lie on straight lines ({len(spans)} runs, the longest {lasting:.2f} s): "
        "drawn across lost samples, not measured."
    )
    yield Finding("interpolated", grade, text, name, places(time, wide), evidence, "Mark them as missing (--fix).", fix)
