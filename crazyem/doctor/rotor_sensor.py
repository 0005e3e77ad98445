"""Check: a rotor speed sensor that counts a fraction or a multiple of the turns, drops to zero, or has no values.

A rotor cannot halve its speed within 0.01 s, but a faulty sensor can. The expected speed comes from the duty or from
the other rotors. A stretch is a fault if the speed jumps by a fraction at its start, jumps back at its end, and is near
that fraction of the expected speed between. A fraction for the whole flight follows from the expected speed alone.
Dropouts to zero are searched as well: a sensor that misses every second pulse often misses all pulses for a while.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor.streams import cadence, listed, longest
from crazyem.recordings.airborne import airtime
from crazyem.recordings.finding import Finding, Fix, Grade, intervals_of, percent, runs_of
from crazyem.recordings.ordering import Array, Flags, Intervals, inside, ordered
from crazyem.recordings.recording import Recording, SignalArray

COUNTED_FRACTIONS = {"a quarter": 1 / 4, "a third": 1 / 3, "half": 1 / 2, "twice": 2.0, "three times": 3.0}
CONSTANT_FRACTIONS = {**COUNTED_FRACTIONS, "two thirds": 2 / 3, "three quarters": 3 / 4, "one and a half times": 3 / 2}
JUMP_TOLERANCE = 0.15  # largest relative deviation of a jump from the fraction
SPEED_TOLERANCE = 0.35  # the same of the speed from the expected speed: rotors lag, and they differ
# The same for a whole flight: rotors of one drone differ by some 3 %. The second: largest distance to a fraction, as a
# share of the distance between this fraction and the next (logarithms).
FRACTION_TOLERANCE, FRACTION_SEPARATION = 0.1, 0.4
LONGEST_SAMPLE_INTERVAL = 0.025  # s; with slower sampling, a real change may look like a jump
DEGRADING_MISCOUNT_SHARE = 0.01  # share of the flight that degrades results
STOPPED_RATIO = 0.1  # speed over the usual speed, below which a rotor counts as stopped
_MOST_JUMPS = 5000


def check(recording: Recording) -> list[Finding]:
    """Findings for each rotor of each rotor_speed signal, within the time in the air."""
    flight = airtime(recording)
    if not flight.lifting:
        return []
    inner: Intervals = tuple((a + 0.3, b - 0.3) for a, b in flight.lifting if b - a > 1.0)
    found = []
    for name, array in recording.signals.items():
        if array.quantity == "rotor_speed" and array.time.size >= 50:
            rows = inside(array.time, inner)
            if rows.sum() >= 50:
                found += _signal(recording, name, array, rows)
    return found


def _signal(recording: Recording, name: str, array: SignalArray, rows: Flags) -> list[Finding]:
    speed = array.value
    expected = _expected(recording, array, rows)
    if expected is None:
        return []
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(speed) / expected
    found: list[Finding] = []
    sampled = cadence(array.time).period < LONGEST_SAMPLE_INTERVAL
    for rotor in range(speed.shape[1]):
        own = ratio[:, rotor]
        turning = own[rows & (own >= STOPPED_RATIO)]
        whole = _constant_fraction(turning)
        usual = float(np.median(turning)) if turning.size else 1.0
        if whole:
            found.append(_constant(name, array, rotor, whole, usual))
        zero = _stopped(own / usual, rows)
        if zero.any():
            found.append(_finding(name, array, rotor, zero, "zero", 0.0, rows))
        if sampled and not whole:
            jumps = _jumps(array.time, np.abs(speed[:, rotor]), own, rows)
            if jumps is None:
                continue
            for words, fraction in COUNTED_FRACTIONS.items():
                flags = np.zeros(array.time.size, bool)
                flags[_between(jumps, fraction)] = True
                if flags.any():
                    found.append(_finding(name, array, rotor, flags, words, fraction, rows))
    return [*found, *_missing(name, array, rows)]


def _expected(recording: Recording, array: SignalArray, rows: Flags) -> Array | None:
    """(n, c) rad/s, the expected speed of each rotor; None if it is unknown."""
    speed = np.abs(array.value)
    command = recording.signals.get("motor_command")
    if command is not None and command.value.shape[1] == speed.shape[1] and command.time.size >= 50:
        time, duty = ordered(command)
        volts = np.ones(time.size)
        if "voltage" in recording.signals:
            when, voltage = ordered(recording.signals["voltage"])
            if when.size > 1:
                volts = np.interp(time, when, voltage[:, 0])
        if time.size >= 50:
            drive = np.column_stack([np.interp(array.time, time, column * volts) for column in duty.T])
            return _law(drive, speed, rows)
    return _from_the_others(speed)


def _law(drive: Array, speed: Array, rows: Flags) -> Array:
    """Expected speed (n, c) = a + b drive, with one law for all rotors, so that a faulty sensor does not fit itself.

    b is the median slope over random pairs (Theil-Sen), so it is robust against outliers.
    """
    x, y = drive[rows].ravel(), speed[rows].ravel()
    sound = np.isfinite(x) & np.isfinite(y) & (y > 0)
    x, y = x[sound], y[sound]
    if x.size < 20:
        return np.full(speed.shape, np.nan)
    thin = np.random.default_rng(0).integers(0, x.size, (4000, 2))
    dx = x[thin[:, 0]] - x[thin[:, 1]]
    dy = y[thin[:, 0]] - y[thin[:, 1]]
    apart = np.abs(dx) > 0.1 * float(np.percentile(x, 95))
    slope = max(float(np.median(dy[apart] / dx[apart])), 0.0) if apart.sum() > 50 else 0.0
    level = float(np.median(y - slope * x))
    return np.maximum(level + slope * drive, 0.2 * float(np.median(y)))


def _from_the_others(speed: Array) -> Array | None:
    """(n, c) the median speed of the other rotors; None with fewer than three rotors."""
    count = speed.shape[1]
    if count < 3:
        return None
    expected = np.full(speed.shape, np.nan)
    for rotor in range(count):
        others = np.delete(speed, rotor, axis=1)
        sound = np.isfinite(others).all(axis=1)
        expected[sound, rotor] = np.median(others[sound], axis=1)
    return expected


# the known samples of a rotor: (k,) row numbers, (k,) speed over expected speed, (k - 1,) speed over the speed of the
# sample before, NaN across a gap
_Jumps = tuple[NDArray[np.int64], Array, Array]


def _jumps(time: Array, speed: Array, ratio: Array, rows: Flags) -> _Jumps | None:
    """The known samples and their speed ratios; None if the speed never jumps."""
    known = np.flatnonzero(rows & (speed > 0) & np.isfinite(ratio))
    if known.size < 3:
        return None
    leap = speed[known[1:]] / speed[known[:-1]]
    leap[np.diff(time[known]) > 3.5 * float(np.median(np.diff(time)))] = np.nan
    return (known, ratio[known], leap) if ((leap < 0.6) | (leap > 1.7)).any() else None


def _between(jumps: _Jumps, fraction: float) -> NDArray[np.int64]:
    """Rows of stretches at a fraction of the expected speed that begin and end with a jump."""
    rows, ratio, leap = jumps
    starts = np.flatnonzero(np.abs(leap / fraction - 1.0) < JUMP_TOLERANCE)
    ends = np.flatnonzero(np.abs(leap * fraction - 1.0) < JUMP_TOLERANCE)
    near = np.abs(ratio / fraction - 1.0) < SPEED_TOLERANCE
    normal = np.abs(ratio - 1.0) < SPEED_TOLERANCE
    last = rows.size - 1
    found = [np.empty(0, np.int64)]
    after = 0
    for start in starts[:_MOST_JUMPS]:
        if start < after or not normal[start]:
            continue
        place = int(np.searchsorted(ends, start, side="right"))
        # up to the jump back, or to the end of the flight
        end = int(ends[place]) if place < ends.size else last
        if near[start + 1 : end + 1].mean() > 0.8 and (place == ends.size or normal[min(end + 1, last)]):
            found.append(rows[start + 1 : end + 1])
            after = end + 1
    return np.concatenate(found)


def _stopped(ratio: Array, rows: Flags) -> Flags:
    """(n,) True where a rotor reads zero that turns before or after.

    `ratio` (n,) is the speed over the usual speed by this sensor; NaN is no evidence.
    """
    flags = np.zeros(ratio.size, bool)
    known = np.flatnonzero(np.isfinite(ratio))
    low = ratio[known] < STOPPED_RATIO
    for first, last in runs_of(low):
        neighbours = [k for k in (first - 1, last) if 0 <= k < known.size]
        if (ratio[known[neighbours]] > 0.5).any():
            flags[known[first:last]] = True
    return flags & rows


def _constant_fraction(ratio: Array) -> str:
    """The fraction that a sensor counts during the whole flight; "" if it counts correctly."""
    sound = ratio[np.isfinite(ratio)]
    if sound.size < 50:
        return ""
    middle = float(np.median(sound))
    known = {**CONSTANT_FRACTIONS, "": 1.0}
    off = sorted((abs(float(np.log(middle / fraction))), words) for words, fraction in known.items())
    (nearest, words), (_, second) = off[:2]
    apart = abs(float(np.log(known[words] / known[second])))
    steady = (np.abs(sound / middle - 1.0) < 0.2).mean() > 0.8
    return words if steady and nearest < min(np.log1p(FRACTION_TOLERANCE), FRACTION_SEPARATION * apart) else ""


def _constant(name: str, array: SignalArray, rotor: int, words: str, ratio: float) -> Finding:
    factor = [1.0] * array.value.shape[1]
    factor[rotor] = 1.0 / CONSTANT_FRACTIONS[words]
    text = f"The speed sensor of m{rotor + 1} counts {words} of the turns all the time."
    evidence = {"rotor": rotor + 1, "ratio": ratio, "share": 1.0}
    advice = f"Check its number of poles or blades; scale m{rotor + 1} by {factor[rotor]:.3g} (--fix)."
    fix = Fix("scale", (name,), factor=tuple(factor))
    return Finding("rotor_sensor", Grade.DEGRADES, text, name, (), evidence, advice, fix)


def _finding(
    name: str, array: SignalArray, rotor: int, flags: Flags, words: str, fraction: float, rows: Flags
) -> Finding:
    share = float(flags.sum()) / float(rows.sum())
    spans = intervals_of(array.time, flags)
    what = "drops to zero while the rotor must turn" if fraction == 0.0 else f"counts {words} of the turns"
    grade = Grade.DEGRADES if share >= DEGRADING_MISCOUNT_SHARE else Grade.HARMLESS
    text = f"The speed sensor of m{rotor + 1} {what} in {len(spans)} stretches, {percent(share)} of the flight."
    evidence = {"rotor": rotor + 1, "ratio": fraction, "share": share, "samples": int(flags.sum())}
    evidence |= {"stretches": len(spans), "longest_s": max(b - a for a, b in spans)}
    fix = Fix("mark", (name,), rows=np.flatnonzero(flags))
    advice = "Mark these samples as missing (--fix)."
    return Finding("rotor_sensor", grade, text, name, longest(spans), evidence, advice, fix)


def _missing(name: str, array: SignalArray, rows: Flags) -> Iterator[Finding]:
    """Finding about samples that the sensor reported as unknown, one for all rotors."""
    nan = ~np.isfinite(array.value)
    flags = nan.any(axis=1) & array.marked & rows
    if not flags.any():
        return
    counts = nan[flags].sum(axis=0)
    share = float(flags.sum()) / float(rows.sum())
    spans = intervals_of(array.time, flags)
    which = [f"m{i + 1} {int(count)}" for i, count in enumerate(counts) if count]
    text = f"{name} is missing in {int(flags.sum())} samples in the air ({percent(share)}; {listed(which)})."
    evidence = {"samples": int(flags.sum()), "share": share, "longest_s": max(b - a for a, b in spans)}
    advice = "Nothing to repair; they are treated as missing."
    grade = Grade.DEGRADES if share > 0.05 else Grade.HARMLESS
    yield Finding("rotor_sensor", grade, text, name, longest(spans), evidence, advice)
