"""Merge the results for the parts of a recording too large for memory: one inventory, one list of findings."""

import functools
import math
from collections.abc import Callable, Iterable
from dataclasses import fields, replace
from typing import Any, TypeVar

from crazyem.doctor.identifiability import Verdict
from crazyem.doctor.inventory import ClockRow, Envelope, Inventory, SignalRow
from crazyem.recordings.finding import Finding, Grade

Row = TypeVar("Row", SignalRow, ClockRow, Verdict)

_VERDICT_RANK = {"yes": 0, "weak": 1, "no": 2}


def merge_inventories(parts: Iterable[Inventory]) -> Inventory:
    """Merge the inventories of consecutive parts.

    Counts and extremes are exact. The median period comes from the part with the most samples. Identifiability comes
    from the best part; the whole recording is at least as informative.
    """
    return functools.reduce(_add, parts)


def _add(a: Inventory, b: Inventory) -> Inventory:
    rows = _united(a.signals, b.signals, _add_rows)
    starts = [row.start_s for row in rows if row.start_s is not None]
    ends = [row.end_s for row in rows if row.end_s is not None]
    return replace(
        a,
        duration_s=max(ends) - min(starts) if starts and ends else 0.0,
        samples=a.samples + b.samples,
        signals=rows,
        clocks=_united(a.clocks, b.clocks, _add_clocks),
        metadata={**a.metadata, **b.metadata},
        events={kind: a.events.get(kind, 0) + b.events.get(kind, 0) for kind in (*a.events, *b.events)},
        envelope=_add_envelopes(a.envelope, b.envelope),
        verdicts=_united(a.verdicts, b.verdicts, lambda a, b: b if _order(b) < _order(a) else a),
        # an objection holds for the recording only if it holds for all parts
        on_the_ground=a.on_the_ground and b.on_the_ground,
        no_replay=a.no_replay and b.no_replay,
        unlike=a.unlike and b.unlike,
    )


def _united(a: Iterable[Row], b: Iterable[Row], add: Callable[[Row, Row], Row]) -> tuple[Row, ...]:
    """Rows of both; rows with the same name are added."""
    rows = {row.name: row for row in a}
    for row in b:
        rows[row.name] = add(rows[row.name], row) if row.name in rows else row
    return tuple(rows.values())


def _add_rows(a: SignalRow, b: SignalRow) -> SignalRow:
    samples = a.samples + b.samples
    start = _reduced(min, a.start_s, b.start_s)
    end = _reduced(max, a.end_s, b.end_s)
    span = end - start if start is not None and end is not None else 0.0
    between = b.start_s - a.end_s if a.end_s is not None and b.start_s is not None else None
    longest = _reduced(max, a.longest_gap_s, b.longest_gap_s)
    more = a if a.samples >= b.samples else b
    return replace(
        a,
        samples=samples,
        start_s=start,
        end_s=end,
        rate_hz=(samples - 1) / span if span > 0.0 else None,
        period_s=more.period_s,
        missing_share=_weighted(a.missing_share, a.samples, b.missing_share, b.samples),
        marked_share=_weighted(a.marked_share, a.samples, b.marked_share, b.samples),
        longest_gap_s=_reduced(max, longest, between),
    )


def _add_clocks(a: ClockRow, b: ClockRow) -> ClockRow:
    longer = a if a.end_s - a.start_s >= b.end_s - b.start_s else b
    return replace(
        longer, signals=max(a.signals, b.signals), start_s=min(a.start_s, b.start_s), end_s=max(a.end_s, b.end_s)
    )


def _add_envelopes(a: Envelope, b: Envelope) -> Envelope:
    """Extremes over both; shares and rms are weighted by the time in the air."""
    values: dict[str, Any] = {}
    for field in fields(Envelope):
        name, x, y = field.name, getattr(a, field.name), getattr(b, field.name)
        if name == "airborne_s":
            values[name] = x + y
        elif name == "airborne_intervals_s":
            values[name] = (*x, *y)
        elif "_rms_" in name and x is not None and y is not None:
            values[name] = math.sqrt(_weighted(x * x, a.airborne_s, y * y, b.airborne_s))
        elif name.endswith("_share") and x is not None and y is not None:
            values[name] = _weighted(x, a.airborne_s, y, b.airborne_s)
        elif name.startswith("voltage_end"):
            values[name] = x if y is None else y
        elif "_max" in name or "_min" in name:
            values[name] = _reduced(max if "_max" in name else min, x, y)
        else:
            values[name] = y if x in (None, "", ()) else x
    return replace(a, **values)


def _reduced(function: Any, x: Any, y: Any) -> Any:
    """Extreme of two numbers, or element-wise of two tuples; None counts as missing."""
    if x is None or y is None:
        return y if x is None else x
    if isinstance(x, tuple):
        return tuple(function(p, q) for p, q in zip(x, y, strict=True))
    return function(x, y)


def _weighted(x: float, a: float, y: float, b: float) -> float:
    return (x * a + y * b) / (a + b) if a + b > 0.0 else x


def _order(verdict: Verdict) -> tuple[int, float]:
    sd = verdict.relative_sd if verdict.relative_sd is not None else verdict.sd
    return _VERDICT_RANK.get(str(verdict.verdict), 3), math.inf if sd is None else sd


def _without_edges(parts: list[tuple[Finding, ...]]) -> list[tuple[Finding, ...]]:
    """Findings of the parts without those caused by cutting: a part without a flight, running rotors at its ends."""
    grounded = [any(f.check == "flight" and f.grade is Grade.UNUSABLE for f in findings) for findings in parts]
    if len(parts) < 2 or all(grounded):
        return parts
    aloft = [f for findings in parts for f in findings if _course(f)]
    cleaned = [
        tuple(f for f in findings if not (f.check == "flight" and f.grade is Grade.UNUSABLE) and not _course(f))
        for findings in parts
    ]
    if aloft:
        seconds = sum(f.evidence["airborne_s"] for f in aloft)
        text = f"The recording holds {seconds:.1f} s in the air, counted in {len(parts)} parts."
        spans = tuple(span for f in aloft for span in f.intervals)
        course = replace(aloft[0], text=text, intervals=spans, evidence={"airborne_s": seconds})
        cleaned[-1] = (*cleaned[-1], course)
    return cleaned


def _course(finding: Finding) -> bool:
    return finding.check == "flight" and finding.grade is Grade.HARMLESS and "airborne_s" in finding.evidence


def _key(finding: Finding) -> tuple[str, ...]:
    # check "flight" gives both a description of the flight and faults; keep them separate by grade
    return (finding.check, finding.signal, str(finding.grade) if finding.check == "flight" else "")


def merge_findings(parts: Iterable[tuple[Finding, ...]]) -> tuple[Finding, ...]:
    """Merge findings of parts: one for each check and signal, from the worst part, with the intervals of all parts.

    A finding without intervals concerns its whole part; `evidence["parts"]` is the number of parts with the finding.
    """
    merged: dict[tuple[str, ...], Finding] = {}
    counts: dict[tuple[str, ...], int] = {}
    for findings in _without_edges([tuple(findings) for findings in parts]):
        for key in {_key(f) for f in findings}:
            counts[key] = counts.get(key, 0) + 1
        for finding in findings:
            key = _key(finding)
            known = merged.get(key)
            if known is None:
                merged[key] = replace(finding, fix=None)
                continue
            worse = finding if finding.grade.rank < known.grade.rank else known
            intervals = known.intervals
            if finding.intervals != known.intervals[-len(finding.intervals) :]:
                intervals = (*known.intervals, *finding.intervals)
            merged[key] = replace(worse, intervals=intervals, fix=None)
    return tuple(
        replace(finding, evidence={**finding.evidence, "parts": float(counts[key])}) if counts[key] > 1 else finding
        for key, finding in sorted(merged.items(), key=lambda item: item[1].grade.rank)
    )
