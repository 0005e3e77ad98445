"""Check: gaps and dropped records, each stream against its own period; pauses of the whole recording apart."""

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor.streams import Cadence, Intervals, Stream, cadence, graded, listed, longest, streams
from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.recording import Recording

PAUSE = 1.0  # s of silence of everything: the recorder stood still, or the link was gone
NOTED = 0.05  # share of records lost from which results suffer
LONG = 0.1  # s: longer than a drone's attitude lasts without measurement
_AROUND = 3  # neighbouring intervals over which a late record may catch up


def check(recording: Recording) -> list[Finding]:
    """Records missing within streams, streams that stop early or start late, and silence of everything."""
    groups = [stream for stream in streams(recording) if stream.time.size > 1]
    if not groups:
        return []
    pauses = _pauses(groups)
    found = []
    if pauses:
        found.append(_pause_finding(pauses))
    begin = min(float(s.time.min()) for s in groups)
    end = max(float(s.time.max()) for s in groups)
    for stream in groups:
        time = np.sort(stream.time) if (np.diff(stream.time) < 0).any() else stream.time
        rhythm = cadence(time)
        if not rhythm.regular or stream.commanded:
            continue
        found += _drops(stream, time, rhythm, pauses)
        found += _ends(stream, time, rhythm, begin, end)
    return found


def lost_records(time: NDArray[np.float64], period: float) -> NDArray[np.int64]:
    """(n - 1,) records missing between neighbours in (n,) increasing stamps.

    A late record is followed by short intervals; a lost one is not. So each long interval is judged together with its
    neighbours, and the least number that any such window needs is what was lost.
    """
    alone = np.maximum(np.round(np.diff(time) / period).astype(np.int64) - 1, 0)
    # what neighbours lost must not be charged to a gap; the second round knows which of them only came late
    return _least(time, period, alone, _least(time, period, alone, alone))


def _least(
    time: NDArray[np.float64], period: float, alone: NDArray[np.int64], others: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The least number of records missing at each long interval over windows of up to `_AROUND` neighbours a side."""
    lost = alone.copy()
    rows = np.flatnonzero(alone)
    before = np.concatenate([[0], np.cumsum(others)])
    for left in range(_AROUND + 1):
        for right in range(_AROUND + 1):
            first = np.maximum(rows - left, 0)
            last = np.minimum(rows + 1 + right, time.size - 1)
            elsewhere = before[last] - before[first] - others[rows]
            needed = np.round((time[last] - time[first]) / period).astype(np.int64) - (last - first) - elsewhere
            lost[rows] = np.minimum(lost[rows], needed)
    return np.maximum(lost, 0)


def _pauses(groups: list[Stream]) -> Intervals:
    """Silence of every stream at once for at least `PAUSE`, and for much longer than the slowest of them is silent."""
    merged = np.sort(np.concatenate([stream.time for stream in groups]))
    steps = np.diff(merged)
    rows = np.flatnonzero(steps >= PAUSE)
    usual = max(min(cadence(np.sort(s.time)).period for s in groups), 0.0) if rows.size else 0.0
    return tuple((float(merged[i]), float(merged[i + 1])) for i in rows if not steps[i] < 20.0 * usual)


def _pause_finding(pauses: Intervals) -> Finding:
    total = sum(b - a for a, b in pauses)
    lasting = max(b - a for a, b in pauses)
    times = "once" if len(pauses) == 1 else f"{len(pauses)} times"
    return Finding(
        "gaps",
        Grade.DEGRADES,
        f"Everything falls silent {times}, for {total:.2f} s in all (the longest {lasting:.2f} s).",
        intervals=longest(pauses),
        evidence={"pauses": len(pauses), "silent_s": total, "longest_s": lasting},
        advice="Treat the parts before and after as flights of their own.",
    )


def _drops(stream: Stream, time: NDArray[np.float64], rhythm: Cadence, pauses: Intervals) -> list[Finding]:
    lost = lost_records(time, rhythm.period)
    if pauses:
        starts = np.array([a for a, _ in pauses])
        ends = np.array([b for _, b in pauses])
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
    grade = graded(share, degrades=NOTED, unusable=0.6)
    if grade is Grade.HARMLESS and lasting > max(LONG, 3.0 * rhythm.period):
        grade = Grade.DEGRADES
    return [
        Finding(
            "gaps",
            grade,
            f"{stream.name}: {_number(count, 'record')} ({100 * share:.2g} %) missing in "
            f"{_number(rows.size, 'place')}, the longest gap {1000 * lasting:.0f} ms.",
            signal=stream.names[0] if len(stream.names) == 1 else "",
            intervals=longest((float(time[i]), float(time[i + 1])) for i in rows),
            evidence={
                "lost": count,
                "share": share,
                "gaps": int(rows.size),
                "longest_s": lasting,
                "period_s": rhythm.period,
            },
            advice="Nothing to repair: use the stamps, never the row number, and look at the link or the log rate.",
        )
    ]


def _number(count: int, word: str) -> str:
    return f"{count} {word}" if count == 1 else f"{count} {word}s"


def _ends(stream: Stream, time: NDArray[np.float64], rhythm: Cadence, begin: float, end: float) -> list[Finding]:
    """A stream that covers less than the recording, or whose values are missing from some time on."""
    spans: dict[tuple[float, float], list[str]] = {}
    for name, array in zip(stream.names, stream.arrays, strict=True):
        there = np.isfinite(array.value).any(axis=1)
        if there.any():
            when = array.time[there]
            spans.setdefault((float(when.min()), float(when.max())), []).append(name)
    found = []
    for (first, last), names in spans.items():
        least = max(1.0, 20.0 * rhythm.period)
        for silent, (a, b), words in (
            (end - last, (last, end), f"no values in the last {end - last:.1f} s of the recording"),
            (first - begin, (begin, first), f"no values in the first {first - begin:.1f} s of the recording"),
        ):
            if silent > least:
                share = silent / max(end - begin, 1e-9)
                found.append(
                    Finding(
                        "gaps",
                        graded(share, degrades=0.1),
                        f"{listed(names)}: {words}.",
                        signal=names[0] if len(names) == 1 else "",
                        intervals=((a, b),),
                        evidence={"silent_s": silent, "share": share},
                        advice="Use only the part of the flight in which all needed signals are there.",
                    )
                )
    return found
