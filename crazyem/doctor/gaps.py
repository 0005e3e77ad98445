"""Check: gaps and dropped records, each stream against its own period; pauses of the whole recording separately."""

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor.streams import Cadence, Stream, cadence, graded, listed, longest, sole, streams
from crazyem.recordings.finding import Finding, Grade, note, percent
from crazyem.recordings.ordering import Intervals
from crazyem.recordings.recording import Recording

PAUSE_SECONDS = 1.0  # s without any record: the recorder stopped, or the link was lost
DEGRADING_LOST_SHARE = 0.05  # share of lost records that degrades results
LONG_GAP_SECONDS = 0.1  # s; an attitude is not known for longer without a measurement
SIMULTANEOUS_SECONDS = 0.6  # s, largest difference between ends that count as simultaneous
_CATCH_UP_INTERVALS = 3  # neighbouring intervals that may be shorter after a late record
# A stretch has a slower rate if most of nine intervals in a row are equal and 1.5 times the stream's period. Random
# loss makes unequal intervals: if half of the records are lost, only a quarter are equal.
_RATE_WINDOW, _SLOWER_RATIO, _INTERVAL_TOLERANCE, _EQUAL_INTERVAL_SHARE = 9, 1.5, 0.2, 0.8


def check(recording: Recording) -> list[Finding]:
    """Findings about missing records, streams that stop early or start late, and pauses of all streams."""
    groups = [stream for stream in streams(recording) if stream.time.size > 1]
    if not groups:
        return []
    pauses = _pauses(groups)
    found = [_pause_finding(pauses)] if pauses else []
    begin = min(float(s.time.min()) for s in groups)
    end = max(float(s.time.max()) for s in groups)
    axes: dict[tuple[str, int, float, float, float], list[Stream]] = {}
    for stream in groups:
        if not all(array.quantity.startswith("setpoint") for array in stream.arrays):  # setpoints come at any time
            axes.setdefault(stream.axis, []).append(stream)
    ends: list[_End] = []
    unused: list[str] = []
    for sharing in axes.values():
        time = np.sort(sharing[0].time)
        rhythm = cadence(time)
        if rhythm.regular:
            drops = _drops(sharing, time, rhythm, pauses, _known_losses(recording, sharing))
            if any(stream.used for stream in sharing):
                found += drops
            elif drops:
                unused += [stream.name for stream in sharing]
            for stream in sharing:
                ends += _ends(stream, rhythm, begin, end)
    if unused:
        text = f"{listed(unused)}: records missing, or published on change; nothing here uses them."
        found.append(note("gaps", text, advice="Nothing to do.", streams=len(unused)))
    return found + _end_findings(ends, end - begin)


def _known_losses(recording: Recording, sharing: list[Stream]) -> Intervals | None:
    """Intervals with missing records by the sequence numbers of the source; None if there are no such numbers."""
    counts = recording.metadata.get("lost_records", {})
    if not all(stream.name in counts for stream in sharing):
        return None
    return tuple(span for f in recording.findings if f.check == "gaps" and "lost" in f.evidence for span in f.intervals)


def lost_records(time: NDArray[np.float64], period: float) -> NDArray[np.int64]:
    """(n - 1,) records missing between neighbours in (n,) increasing stamps.

    Short intervals follow a late record, but not a lost one. So each long interval is judged together with its
    neighbours: the smallest number of missing records over all such windows is the number of lost ones.
    """
    alone = np.maximum(np.round(np.diff(time) / period).astype(np.int64) - 1, 0)
    # losses of neighbours must not count twice; the second pass knows which neighbours were only late
    return _fewest_lost(time, period, alone, _fewest_lost(time, period, alone, alone))


def _fewest_lost(
    time: NDArray[np.float64], period: float, alone: NDArray[np.int64], others: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Fewest missing records at each long interval, over windows of up to `_CATCH_UP_INTERVALS` on either side."""
    lost = alone.copy()
    rows = np.flatnonzero(alone)
    before = np.concatenate([[0], np.cumsum(others)])
    for left in range(_CATCH_UP_INTERVALS + 1):
        for right in range(_CATCH_UP_INTERVALS + 1):
            first = np.maximum(rows - left, 0)
            last = np.minimum(rows + 1 + right, time.size - 1)
            elsewhere = before[last] - before[first] - others[rows]
            needed = np.round((time[last] - time[first]) / period).astype(np.int64) - (last - first) - elsewhere
            lost[rows] = np.minimum(lost[rows], needed)
    return np.maximum(lost, 0)


def _pauses(groups: list[Stream]) -> Intervals:
    """Intervals without any record: at least `PAUSE_SECONDS` and 20 times the shortest period of the streams."""
    merged = np.sort(np.concatenate([stream.time for stream in groups]))
    steps = np.diff(merged)
    rows = np.flatnonzero(steps >= PAUSE_SECONDS)
    usual = max(min(cadence(np.sort(s.time)).period for s in groups), 0.0) if rows.size else 0.0
    return tuple((float(merged[i]), float(merged[i + 1])) for i in rows if not steps[i] < 20.0 * usual)


def _pause_finding(pauses: Intervals) -> Finding:
    total = sum(b - a for a, b in pauses)
    lasting = max(b - a for a, b in pauses)
    times = "once" if len(pauses) == 1 else f"{len(pauses)} times"
    text = f"Everything falls silent {times}, for {total:.2f} s in all (the longest {lasting:.2f} s)."
    evidence = {"pauses": len(pauses), "silent_s": total, "longest_s": lasting}
    advice = "Treat the parts before and after as flights of their own (--from, --to)."
    return Finding("gaps", Grade.DEGRADES, text, "", longest(pauses), evidence, advice)


def local_periods(time: NDArray[np.float64], period: float) -> NDArray[np.float64]:
    """(n - 1,) s, the period that holds at each interval of increasing stamps (n,).

    It is larger where a stream runs at a slower rate: there no records are missing.
    """
    steps = np.diff(time)
    local = np.full(steps.size, period)
    if steps.size < _RATE_WINDOW:
        return local
    windows = np.lib.stride_tricks.sliding_window_view(steps, _RATE_WINDOW)
    middle = np.median(windows, axis=1)
    alike = np.abs(windows - middle[:, None]) <= _INTERVAL_TOLERANCE * middle[:, None]
    slower = (alike.mean(axis=1) >= _EQUAL_INTERVAL_SHARE) & (middle > _SLOWER_RATIO * period)
    for first in np.flatnonzero(slower):
        local[first : first + _RATE_WINDOW] = np.maximum(local[first : first + _RATE_WINDOW], middle[first])
    # a window may contain the change of rate: short intervals in it belong to the faster rate
    return np.where(steps < 0.5 * local, period, local)


def _drops(
    sharing: list[Stream], time: NDArray[np.float64], rhythm: Cadence, pauses: Intervals, known: Intervals | None
) -> list[Finding]:
    lost = lost_records(time, rhythm.period)
    local = local_periods(time, rhythm.period)
    slowed = local > rhythm.period
    lost[slowed] = np.maximum(np.round(np.diff(time)[slowed] / local[slowed]).astype(np.int64) - 1, 0)
    if known is not None:  # the source numbers its records
        overlap = np.zeros(lost.size, bool)
        for start, end in known:
            overlap |= (time[1:] > start) & (time[:-1] < end)
        lost[~overlap] = 0
    if pauses:
        starts, ends = np.array(pauses).T
        for row in np.flatnonzero(lost):
            covered = np.minimum(ends, time[row + 1]) - np.maximum(starts, time[row])
            if (covered >= 0.9 * (time[row + 1] - time[row])).any():
                lost[row] = 0
    rows = np.flatnonzero(lost)
    if rows.size == 0:
        return []
    count = int(lost.sum())
    share = count / (time.size + count)
    lasting = float((time[rows + 1] - time[rows]).max())
    grade = graded(share, degrades=DEGRADING_LOST_SHARE, unusable=0.6)
    if grade is Grade.HARMLESS and lasting > max(LONG_GAP_SECONDS, 3.0 * rhythm.period):
        grade = Grade.DEGRADES
    names = [name for stream in sharing for name in stream.names]
    if all(stream.slow for stream in sharing):
        grade = Grade.HARMLESS
    text = (
        f"{listed([stream.name for stream in sharing])}: {_number(count, 'record')} ({percent(share)}) missing "
        f"in {_number(rows.size, 'place')}, the longest gap {1000 * lasting:.0f} ms."
    )
    evidence = {"lost": count, "share": share, "gaps": rows.size, "longest_s": lasting, "period_s": rhythm.period}
    advice = "Nothing to repair: use the stamps, never the row number, and look at the link or the log rate."
    spans = longest(zip(time[rows], time[rows + 1]))
    return [Finding("gaps", grade, text, sole(names), spans, evidence, advice)]


def _number(count: int, word: str) -> str:
    return f"{count} {word}" if count == 1 else f"{count} {word}s"


# signal; whether at the end of the recording; start and end [s] of the interval without values
_End = tuple[str, bool, float, float]


def _ends(stream: Stream, rhythm: Cadence, begin: float, end: float) -> list[_End]:
    """The ends of the recording at which signals of a stream have no values."""
    least = max(1.0, 20.0 * rhythm.period)
    found = []
    for name, array in zip(stream.names, stream.arrays, strict=True):
        if not array.quantity:
            continue
        there = np.flatnonzero(np.isfinite(array.value[:, 0]))
        if there.size:
            first, last = float(array.time[there[0]]), float(array.time[there[-1]])
            if end - last > least:
                found.append((name, True, last, end))
            if first - begin > least:
                found.append((name, False, begin, first))
    return found


def _end_findings(ends: list[_End], duration: float) -> list[Finding]:
    """One finding for all signals that end, or begin, at about the same time."""
    found = []
    while ends:
        _, last, start, end = ends[0]
        alike = [e for e in ends if e[1] == last]
        close = [e for e in alike if abs(e[2] - start) + abs(e[3] - end) < SIMULTANEOUS_SECONDS]
        ends = [e for e in ends if e not in close]
        names = [e[0] for e in close]
        silent = max(e[3] - e[2] for e in close)
        share = silent / max(duration, 1e-9)
        text = f"{listed(names)}: no values in the {'last' if last else 'first'} {silent:.1f} s of the recording."
        evidence = {"silent_s": silent, "share": share, "signals": len(names)}
        advice = "Use only the part of the flight in which all needed signals are there (--from, --to)."
        spans = ((min(e[2] for e in close), max(e[3] for e in close)),)
        found.append(Finding("gaps", graded(share, degrades=0.1), text, sole(names), spans, evidence, advice))
    return found
