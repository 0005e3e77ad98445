"""Impossible stamps: of messages never published, of other clocks, of erased or damaged bytes.

All readers use the same rule. A stamp is impossible if

- the format uses its value for "no stamp" (0 of a latched message; the reader passes the value), or
- its distance from the other stamps is longer than any recording, or
- it breaks the order of its neighbours, which are in order without it. The running median of a clock that runs forward
  is the clock itself, so this rule is the filter of Hampel (1974) with a fixed limit.

If all stamps of a stream are far from the others but run at the same speed, the stream has another clock: a constant
shift corrects it. Other disorder (swapped records, a clock that was set) is left to the doctor.
"""

import bisect
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.finding import Finding, Fix, Grade
from crazyem.recordings.ordering import Array, Flags
from crazyem.recordings.recording import Recording, SignalArray

LONGEST_RECORDING = 86_400.0  # s; no recording of a flight is longer than a day
RESTART_SECONDS = 1.0  # s; a larger step back is a clock that was set or restarted, a smaller one a late record
_NEIGHBOURS = 3  # records before and after a record that show where its stamp should be
STAMP_CHECK = "stamps"


@dataclass(frozen=True, slots=True)
class Fault:
    """Impossible stamps of one stream."""

    stream: str  # its name
    count: int  # number of records with such stamps
    total: int  # number of records of the stream
    what: str  # treatment of these records: "left out", "placed by arrival" or "shifted"
    example: float  # one of the stamps [s], as in the file; for "shifted": the shift [s]


def impossible(time: Array, *, centre: float | None = None, absent: float | None = None) -> Flags:
    """(n,) True for impossible stamps.

    Args:
        time: (n,) s, of one clock, in the order of the file.
        centre: s, middle of the stamps of all streams on the clock; None: the median of these stamps.
        absent: the value for "no stamp"; None if the format has none.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        bad = ~np.isfinite(time)
        if absent is not None:
            bad |= time == absent
        rest = time[~bad]
        if not rest.size or (centre is None and absent is None and _sound(time)):
            return bad
        middle = float(np.median(rest)) if centre is None else centre
        bad |= ~(np.abs(time - middle) <= LONGEST_RECORDING)
    keep = np.flatnonzero(~bad)
    bad[keep[out_of_order(time[keep])]] = True
    return bad


def _sound(time: Array) -> bool:
    """Whether all stamps are possible: in order, and no longer than a recording can be."""
    return time.size < 2 or bool((np.diff(time) >= 0).all() and time[-1] - time[0] <= LONGEST_RECORDING)


def out_of_order(time: Array) -> Flags:
    """(n,) True where a stamp breaks the order of those around it and is far from their median."""
    if time.size < 3 or bool((np.diff(time) >= 0).all()):
        return np.zeros(time.size, bool)
    # near a restart of the clock the median may come from the other side of the restart: the limit covers its window
    limit = max(RESTART_SECONDS, 2 * _NEIGHBOURS * float(np.median(np.abs(np.diff(time)))))
    away = np.abs(time - _running_median(time))
    far = ~(away <= limit)
    broken = np.zeros(time.size, bool)
    for step in range(1, _NEIGHBOURS + 1):
        back = time[step:] < time[:-step]
        broken[step:] |= back
        broken[:-step] |= back
    return _without_those_in_order(time, far & broken, away)


def _without_those_in_order(time: Array, odd: Flags, away: Array) -> Flags:
    """Clear the flags of stamps that fit between the unflagged ones, in the order of their distance to the median."""
    kept = np.flatnonzero(~odd).tolist()
    for row in sorted(np.flatnonzero(odd).tolist(), key=lambda row: away[row]):
        place = bisect.bisect(kept, row)
        before = time[kept[place - 1]] if place > 0 else -np.inf
        after = time[kept[place]] if place < len(kept) else np.inf
        if before <= time[row] <= after:
            kept.insert(place, row)
    found = np.ones(time.size, bool)
    found[kept] = False
    return found


def _running_median(time: Array) -> Array:
    from scipy.ndimage import median_filter  # slow to import and rarely needed

    return np.asarray(median_filter(time, 2 * _NEIGHBOURS + 1, mode="mirror"), float)


def restarts(time: Array) -> NDArray[np.int64]:
    """Rows (k,) at which a clock restarts, from (n,) stamps [s] of one or more streams in order of arrival.

    The running median shows a restart; a few late or impossible stamps do not change the median.
    """
    if time.size < 2 * _NEIGHBOURS + 1:
        return np.flatnonzero(np.diff(time) < -RESTART_SECONDS) + 1
    middle = _running_median(time)
    rows = []
    for row in np.flatnonzero(np.diff(middle) < -RESTART_SECONDS).tolist():
        # the median steps back when most of its window is past the restart; the step of the stamps is nearby
        window = np.arange(max(0, row - _NEIGHBOURS), min(time.size - 1, row + _NEIGHBOURS + 1))
        rows.append(int(window[np.argmin(np.diff(time)[window])]) + 1)
    return np.unique(np.array(rows, np.int64))


def clock_offset(time: Array, place: Array, others: Array, places: Array) -> float | None:
    """Seconds to add to the stamps of another clock; None if this clock does not run like that of the others.

    Args:
        time, place: (n,) stamps of one stream [s], and places of its records in the file, ascending.
        others, places: (m,) the same for the streams on the clock of the recording.
    """
    if time.size < _NEIGHBOURS or others.size < 2:
        return None
    lead = np.interp(place, places, others) - time
    shift = float(np.median(lead))
    return shift if float(np.median(np.abs(lead - shift))) <= RESTART_SECONDS else None


def believed(
    names: Sequence[str], times: Sequence[Array], places: Sequence[Array], *, absent: float | None = None
) -> tuple[list[Flags], list[float], list[Fault]]:
    """Bring all streams to one clock, that of most records.

    Args:
        names: of the streams.
        times: (n,) s of each, in the order of the file.
        places: (n,) places (or times of arrival) of the records among those of all streams; NaN if unknown.
        absent: as in `impossible`.

    Returns: the records of each stream to keep, the seconds to add to their stamps, and the faults.
    """
    pooled = np.concatenate(times) if times else np.empty(0)
    pooled = pooled[np.isfinite(pooled) & (pooled != absent)]
    if not pooled.size:
        return [np.ones(t.size, bool) for t in times], [0.0] * len(times), []
    centre = float(np.median(pooled))
    keep = [~impossible(time, centre=centre, absent=absent) for time in times]
    beside = [k & np.isfinite(p) for k, p in zip(keep, places, strict=True)]
    known = np.concatenate([p[k] for p, k in zip(places, beside, strict=True)])
    order = np.argsort(known, kind="stable")
    known, others = known[order], np.concatenate([t[k] for t, k in zip(times, beside, strict=True)])[order]
    shifts, faults = [0.0] * len(times), []
    for i, (name, time, place) in enumerate(zip(names, times, places, strict=True)):
        own = ~impossible(time, absent=absent) & np.isfinite(place)
        shift = clock_offset(time[own], place[own], others, known) if not keep[i].any() and own.any() else None
        if shift is not None:
            keep[i], shifts[i] = ~impossible(time, absent=absent), shift
            faults.append(Fault(name, int(keep[i].sum()), time.size, "shifted", shift))
        if not keep[i].all():
            lost = np.flatnonzero(~keep[i])
            faults.append(Fault(name, lost.size, time.size, "left out", float(time[lost[0]])))
    return keep, shifts, faults


def finding(faults: Sequence[Fault], signals: Iterable[str] | Mapping[str, SignalArray] = ()) -> list[Finding]:
    """One finding for all faults of a recording; none without faults.

    Args:
        signals: names of the affected signals that the recording still has, or all its signals.
    """
    if not faults:
        return []
    count = sum(fault.count for fault in faults)
    moved = [fault for fault in faults if fault.what == "shifted"]
    said = [_words(fault) for fault in faults[:5]]
    if len(faults) > len(said):
        said.append(f"and so on in {len(faults) - len(said)} more streams")
    grave = bool(moved) or any(fault.count > 1 and 2 * fault.count >= fault.total for fault in faults)
    if isinstance(signals, Mapping):
        streams = {fault.stream for fault in faults}
        signals = [name for name, array in signals.items() if array.stream in streams]
    names = tuple(dict.fromkeys(signals))
    advice = "Look for what wrote these stamps: much of the recording has no time." if grave else ""
    if moved:
        advice = "Compare the shifted stream with others only as exactly as the file's order tells."
    evidence = {"records": float(count), "streams": float(len(faults))}
    if moved:
        evidence["shift_s"] = moved[0].example
    text = f"Stamps that cannot be: {'; '.join(said)}."
    fix = Fix(STAMP_CHECK, names) if names else None
    found = Finding(STAMP_CHECK, Grade.DEGRADES if grave else Grade.HARMLESS, text, "", (), evidence, advice, fix)
    return [found]


def _words(fault: Fault) -> str:
    name = fault.stream or "a stream without a name"
    if fault.what == "shifted":
        side = "ahead of" if fault.example < 0 else "behind"
        return f"{name} is stamped by another clock, {abs(fault.example):.6g} s {side} the others, and was shifted"
    stamp = f"{fault.example:.3f}".rstrip("0").rstrip(".") if abs(fault.example) < 1e6 else f"{fault.example:.4g}"
    if fault.count == fault.total and fault.what == "left out":
        records = "its only record" if fault.count == 1 else f"all of its {fault.count} records"
        return f"{name} has no stamps ({records}: stamp {stamp} s), so it has no place in time and was left out"
    verb = "was" if fault.count == 1 else "were"
    return f"{fault.count} of {fault.total} records of {name} (stamp {stamp} s) {verb} {fault.what}"


def screened(recording: Recording) -> Recording:
    """The recording without samples that have impossible stamps, with a finding about them."""
    return next(screened_parts(iter([recording])))


def screened_parts(parts: Iterator[Recording]) -> Iterator[Recording]:
    """As `screened`, of a recording in parts; the last part has the finding, which counts the stamps of all parts.

    The neighbours of a stamp include those in the parts before and after.
    """
    before: dict[str, Array] = {}
    faults: dict[str, Fault] = {}
    totals: dict[str, int] = {}
    names: list[str] = []
    current = next(parts, None)
    while current is not None:
        after = next(parts, None)
        kept = _kept(current, before, after)
        streams: dict[str, SignalArray] = {}
        for stream, array in _streams(current):
            streams.setdefault(stream, array)
        for stream, array in streams.items():
            totals[stream] = totals.get(stream, 0) + array.time.size
            lost = array.time.size - kept[id(array.time)].size if id(array.time) in kept else 0
            if lost:
                example = float(np.delete(array.time, kept[id(array.time)])[0]) + current.origin
                known = faults.get(stream, Fault(stream, 0, 0, "left out", example))
                faults[stream] = replace(known, count=known.count + lost)
        screened_one = _without(current, kept, whole=after is None and not before)
        names += [n for n, a in current.signals.items() if id(a.time) in kept and n in screened_one.signals]
        if after is None and faults:
            counted = [replace(fault, total=totals[stream]) for stream, fault in faults.items()]
            findings = _together(screened_one.findings, finding(counted, names))
            screened_one = replace(screened_one, findings=findings)
        yield screened_one
        before = {s: np.concatenate([before.get(s, np.empty(0)), a.time])[-_NEIGHBOURS:] for s, a in _streams(current)}
        current = after


def _together(found: tuple[Finding, ...], more: Sequence[Finding]) -> tuple[Finding, ...]:
    """The findings with one more about stamps, which is joined with that of the reader, if there is one."""
    said = next((i for i, f in enumerate(found) if f.check == STAMP_CHECK and "records" in f.evidence), None)
    if said is None:
        return (*found, *more)
    first, (second,) = found[said], more
    fixes = [f.fix.signals for f in (first, second) if f.fix is not None]
    both = replace(
        second if second.grade is Grade.DEGRADES else first,
        text=f"{first.text[:-1]}; {second.text.partition(': ')[2]}",
        evidence={**first.evidence, **{k: first.evidence[k] + v for k, v in second.evidence.items()}},
        fix=Fix(STAMP_CHECK, tuple(dict.fromkeys(sum(fixes, ())))) if fixes else None,
    )
    return (*found[:said], both, *found[said + 1 :])


def _streams(recording: Recording) -> Iterator[tuple[str, SignalArray]]:
    """(name of the stream, one array) for each set of signals that share their stamps."""
    seen: set[int] = set()
    for name, array in recording.signals.items():
        if id(array.time) not in seen:
            seen.add(id(array.time))
            yield array.stream or name, array


def _kept(recording: Recording, before: Mapping[str, Array], after: Recording | None) -> dict[int, NDArray[np.int64]]:
    """Rows to keep, by the id of the array of stamps; only for streams that lose rows."""
    later = {s: a.time[:_NEIGHBOURS] for s, a in _streams(after)} if after is not None else {}
    streams = list(_streams(recording))
    times = [np.concatenate([before.get(s, np.empty(0)), a.time, later.get(s, np.empty(0))]) for s, a in streams]
    ends = np.concatenate([time[[0, -1]] for time in times if time.size] or [np.zeros(1)])
    if all(_sound(time) for time in times) and ends.max() - ends.min() <= LONGEST_RECORDING:
        return {}
    pooled = np.concatenate(times)
    pooled = pooled[np.isfinite(pooled)]
    centre = float(np.median(pooled)) if pooled.size else None
    kept: dict[int, NDArray[np.int64]] = {}
    for (stream, array), time in zip(streams, times, strict=True):
        start = before[stream].size if stream in before else 0
        bad = impossible(time, centre=centre)[start : start + array.time.size]
        if bad.any():
            kept[id(array.time)] = np.flatnonzero(~bad)
    return kept


def _without(recording: Recording, kept: Mapping[int, NDArray[np.int64]], *, whole: bool) -> Recording:
    """The recording with only the rows in `kept`; if `whole`, also without signals that have no rows left."""
    if not kept:
        return recording
    signals = {}
    for name, array in recording.signals.items():
        rows = kept.get(id(array.time))
        if rows is None or rows.size or not whole:
            signals[name] = array if rows is None else array.rows(rows)
    return replace(recording, signals=signals)
