"""Check: clock wraps, jumps and drift, stamps out of order or twice, and nominal against real rate."""

import itertools
import math
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor.streams import Stream, cadence, listed, longest, sole, streams
from crazyem.recordings.finding import Finding, Fix, Grade, percent
from crazyem.recordings.ordering import Array
from crazyem.recordings.recording import Recording
from crazyem.recordings.stamps import RESTART_SECONDS

# Counters that overflow: name -> seconds from zero to the overflow
CLOCK_WRAPS: dict[str, float] = {
    "24 bits of milliseconds": 2.0**24 * 1e-3,
    "32 bits of milliseconds": 2.0**32 * 1e-3,
    "32 bits of microseconds": 2.0**32 * 1e-6,
    "16 bits of milliseconds": 2.0**16 * 1e-3,
}
RATE_DEVIATION = 0.002  # relative deviation of the rate from which it is reported
WRONG_RATE_DEVIATION = 0.1  # the same from which a claimed rate is wrong
_USUAL_RATES = (
    1, 2, 4, 5, 8, 10, 12.5, 20, 25, 30, 40, 50, 60, 100, 120, 125, 200, 240, 250, 300, 400, 500, 800, 1000, 2000,
)  # Hz  # fmt: skip
CLOCK_JUMP = 0.3  # s; least jump between two clocks from one packet to the next: a radio link stalls for less


def check(recording: Recording) -> list[Finding]:
    """Findings per stream, and for the drone's clock against the host's."""
    found = []
    rates: dict[tuple[float, float], list[str]] = {}
    drifts: dict[str, tuple[int, list[Finding]]] = {}  # of each clock, from the stream with most arrival times
    several = len({array.clock for array in recording.signals.values()}) > 1
    for stream in streams(recording):
        if stream.time.size < 2:
            continue
        found += _order(stream)
        _rate(stream, recording.metadata, rates)
        arrivals = _arrivals(stream)
        if arrivals is None:
            continue
        found += _jumps(stream, *arrivals)
        if arrivals[0].size > drifts.get(stream.clock, (0, []))[0]:
            drifts[stream.clock] = (arrivals[0].size, [*_drift(*arrivals[:2], several=several)])
    found += [_rate_finding(nominal, real, names) for (nominal, real), names in rates.items()]
    return [*found, *(finding for _, findings in drifts.values() for finding in findings)]


# -- order ------------------------------------------------------------------------------------------------------------


def _order(stream: Stream) -> list[Finding]:
    steps = np.diff(stream.time)
    found = []
    if (steps < 0).any():
        rhythm = cadence(stream.time)
        period = rhythm.period if rhythm.period > 0 else float(np.median(np.abs(steps)))
        wrapped = np.zeros(steps.size, bool)
        for words, span in CLOCK_WRAPS.items():
            # the next stamp comes a period or a gap after the one before, modulo the counter
            rows = np.flatnonzero((steps < -0.5 * span) & (steps >= -span) & ~wrapped)
            if rows.size:
                wrapped[rows] = True
                found.append(_wrap(stream, rows + 1, span, words, period))
        back = np.flatnonzero((steps <= -RESTART_SECONDS) & ~wrapped)
        late = np.flatnonzero((steps < 0) & (steps > -RESTART_SECONDS) & ~wrapped)
        if back.size:
            found.append(_restart(stream, back))
        if late.size:
            found.append(_late(stream, late, clean=not back.size and not wrapped.any()))
    twice = np.flatnonzero(steps == 0)
    if twice.size and not stream.commanded:
        found.append(_twice(stream, twice))
    return found


def _wrap(stream: Stream, rows: NDArray[np.int64], span: float, words: str, period: float) -> Finding:
    last = stream.time[rows - 1]
    step = float(np.median(stream.time[rows] - last)) + span
    text = f"{stream.name}: the clock overflows {len(rows)} times and starts again from zero: a counter of {words}."
    evidence = {"wraps": len(rows), "wrap_s": span, "step_across_s": step, "period_s": period}
    fix = Fix("unwrap", stream.names, factor=(span,) * len(rows), rows=rows)
    spans = longest(zip(last, last))
    return Finding("clocks", Grade.DEGRADES, text, sole(stream.names), spans, evidence, "Unwrap it (--fix).", fix)


def _restart(stream: Stream, rows: NDArray[np.int64]) -> Finding:
    back = stream.time[rows] - stream.time[rows + 1]
    text = (
        f"{stream.name}: the clock goes back {len(rows)} times, by up to {back.max():.3f} s: "
        "it was set, or the drone restarted."
    )
    evidence = {"jumps": len(rows), "largest_s": float(back.max()), "first_row": int(rows[0]) + 1}
    advice = "Write a file for each part and use these as recordings of their own."
    spans = longest(zip(stream.time[rows + 1], stream.time[rows]))
    return Finding("clocks", Grade.UNUSABLE, text, sole(stream.names), spans, evidence, advice)


def _late(stream: Stream, rows: NDArray[np.int64], *, clean: bool) -> Finding:
    back = stream.time[rows] - stream.time[rows + 1]
    share = rows.size / stream.time.size
    text = (
        f"{stream.name}: {rows.size} records ({percent(share)}) are out of order, by up to {1000 * back.max():.1f} ms."
    )
    evidence = {"records": int(rows.size), "share": share, "largest_s": float(back.max())}
    advice = "Sort by stamp (--fix)." if clean else "Deal with the jumps of the clock first."
    spans = longest(zip(stream.time[rows + 1], stream.time[rows]))
    fix = Fix("sort", stream.names) if clean else None
    return Finding("clocks", Grade.DEGRADES, text, sole(stream.names), spans, evidence, advice, fix)


def _twice(stream: Stream, rows: NDArray[np.int64]) -> Finding:
    alike = np.ones(rows.size, bool)
    for array in stream.arrays:
        before, after = array.value[rows], array.value[rows + 1]
        alike &= ((before == after) | (np.isnan(before) & np.isnan(after))).all(axis=1)
    share = rows.size / stream.time.size
    copies = int(alike.sum())
    values = "with the same values" if copies == rows.size else f"{rows.size - copies} of them with other values"
    text = f"{stream.name}: {rows.size} records ({percent(share)}) carry the stamp of the record before, {values}."
    spans = longest(zip(stream.time[rows], stream.time[rows]))
    evidence = {"records": int(rows.size), "share": share, "copies": copies}
    advice = "Mark the copies as missing (--fix)." if copies else "Their time is known to one step of the clock only."
    fix = Fix("mark", stream.names, rows=rows[alike] + 1) if copies else None
    grade = Grade.DEGRADES if share > 0.01 else Grade.HARMLESS
    return Finding("clocks", grade, text, sole(stream.names), spans, evidence, advice, fix)


# -- rate -------------------------------------------------------------------------------------------------------------


def _rate(
    stream: Stream, metadata: Mapping[str, Mapping[str, str]], rates: dict[tuple[float, float], list[str]]
) -> None:
    """Add to `rates` a stream whose rate differs from the claimed rate, or slightly from a usual one."""
    time = stream.time
    if (np.diff(time) < 0).any():
        return
    rhythm = cadence(time)
    if not rhythm.regular or time.size < 100 or stream.commanded or stream.slow:
        return
    real = 1.0 / rhythm.period
    claimed = _claimed(metadata, stream.name, real)
    nominal = claimed if claimed is not None else min(_USUAL_RATES, key=lambda rate: abs(math.log(real / rate)))
    deviation = real / nominal - 1.0
    limit = WRONG_RATE_DEVIATION if claimed is None else math.inf
    # relative error of the period: windows of sixteen samples, each as uncertain as the jitter
    uncertainty = rhythm.jitter / (rhythm.period * 16.0 * math.sqrt(max(time.size / 16.0, 1.0)))
    if max(RATE_DEVIATION, 4.0 * uncertainty) < abs(deviation) < limit:
        key = next((k for k in rates if k[0] == nominal and abs(k[1] / real - 1.0) < 5e-4), (nominal, real))
        rates.setdefault(key, []).append(stream.name)


def _claimed(metadata: Mapping[str, Mapping[str, str]], stream: str, real: float) -> float | None:
    """The rate [Hz] that the source claims for the stream, or for the whole table if it is within 40 % of `real`."""
    claims = metadata.get("claims", {})
    for key, near in ((f"{stream}.rate_hz", math.inf), ("rate_hz", 0.4)):
        try:
            rate = float(claims[key])
        except (KeyError, TypeError, ValueError):
            continue
        if math.isfinite(rate) and rate > 0 and abs(real / rate - 1.0) < near:
            return rate
    return None


def _rate_finding(nominal: float, real: float, names: list[str]) -> Finding:
    percent = 100.0 * (real / nominal - 1.0)
    grade = Grade.DEGRADES if abs(percent) > 100.0 * WRONG_RATE_DEVIATION else Grade.HARMLESS
    text = (
        f"{listed(names)}: really {real:.4g} Hz, {abs(percent):.2f} % {'faster' if percent > 0 else 'slower'} than "
        f"{nominal:g} Hz."
    )
    evidence = {"nominal_hz": nominal, "real_hz": real, "deviation_percent": percent}
    return Finding("clocks", grade, text, "", (), evidence, "Use the stamps; never count rows as time.")


# -- against the host -------------------------------------------------------------------------------------------------


def _arrivals(stream: Stream) -> tuple[Array, Array, NDArray[np.int64]] | None:
    """Stamps, arrival times less stamps, and rows of the samples with arrival times; None if they cannot be used."""
    array = stream.arrays[0]
    known = np.isfinite(array.host_time)
    if stream.clock == "host" or stream.commanded or known.sum() < 100:
        return None
    time, host = stream.time[known], array.host_time[known]
    offset = (host - host[0]) - (time - time[0])
    if np.abs(offset).max() < 1e-6 or (np.diff(time) < 0).any():
        return None
    return time, offset, np.flatnonzero(known)


def _jumps(stream: Stream, time: Array, offset: Array, rows: NDArray[np.int64]) -> Iterator[Finding]:
    # the delay of a late packet passes, a jump of the clock stays: so samples before and after are compared
    candidates = np.flatnonzero(np.abs(np.diff(offset)) > CLOCK_JUMP)[:1000]
    # packets in a queue arrive late, never early: so the earliest arrivals show the clocks
    sizes = np.array([offset[i + 1 : i + 41].min() - offset[max(0, i - 20) : i + 1].min() for i in candidates])
    jumps = np.abs(sizes) > CLOCK_JUMP
    if not jumps.any():
        return
    at, sizes = candidates[jumps], sizes[jumps]
    worst = float(sizes[np.argmax(np.abs(sizes))])
    text = (
        f"{stream.name}: the drone's clock jumps {at.size} times against the host's, at most by "
        f"{abs(worst):.3f} s {'ahead' if worst < 0 else 'back'}."
    )
    advice = "Take the jumps out (--fix), or use a part between them (--from, --to)."
    spans = longest(zip(time[at], time[at + 1]))
    fix = Fix("unwrap", stream.names, tuple(sizes.tolist()), rows[at + 1])
    yield Finding("clocks", Grade.DEGRADES, text, "", spans, {"jumps": at.size, "largest_s": -worst}, advice, fix)


def _drift(time: Array, offset: Array, *, several: bool) -> Iterator[Finding]:
    """Drift from a line through the earliest arrival of each of twenty spans, because delays are never negative."""
    duration = float(time[-1] - time[0])
    if duration < 5.0 or np.abs(np.diff(offset)).max() > CLOCK_JUMP:
        return
    edges = np.searchsorted(time, np.linspace(time[0], time[-1], 21))
    picks = [a + int(np.argmin(offset[a:b])) for a, b in itertools.pairwise(edges.tolist()) if b > a]
    if len(picks) < 8:
        return
    x, y = time[picks], offset[picks]
    line, covariance = np.polyfit(x - x.mean(), y, 1, cov=True)
    slope = float(line[0])
    deviation = 2.1 * math.sqrt(covariance[0, 0])  # 95 % of Student's t at 18 degrees of freedom
    apart = abs(slope) * duration
    if abs(slope) < 2.0 * deviation or apart < 0.005 or abs(slope) < 2e-5:
        return
    ppm = -1e6 * slope
    yield Finding(
        "clocks",
        Grade.DEGRADES if several and apart > 0.02 else Grade.HARMLESS,
        f"The drone's clock runs {abs(ppm):.0f} ppm {'fast' if ppm > 0 else 'slow'} against the host's: "
        f"{1000 * apart:.1f} ms over the recording.",
        evidence={"drift_ppm": ppm, "ci95_ppm": 1e6 * deviation, "apart_s": apart, "duration_s": duration},
        advice="Compare streams of the two clocks only after a fit of offset and drift.",
    )
