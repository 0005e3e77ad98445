"""Lossless repairs of a recording, one finding at a time; a repair is kept only if its check then reports no fault.

A repair makes a new recording. The section "fixes" of its metadata says what was done, in enough detail to undo it.
"""

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor import CHECKS, Check
from crazyem.doctor.kinematics import continuous
from crazyem.physics.rotations import rotation_matrix
from crazyem.recordings.finding import Finding, Fix, runs_of
from crazyem.recordings.ordering import Array, sound_rows, sound_samples
from crazyem.recordings.recording import Recording, SignalArray

Signals = dict[str, SignalArray]

# Times come first, because comparisons of signals need them. Then units: a rate in deg/s looks like impossible samples
# in rad/s, and these must not be marked as missing. Then frames, which need a correct attitude. Marking comes last.
FIX_ORDER = ("unwrap", "sort", "shift", "scale", "world_to_body", "mark")
_TIME_FIXES = ("unwrap", "sort", "shift")
_ATTITUDE_REACH = 0.1  # s, largest time between an attitude and the sample that it rotates


def apply_fixes(recording: Recording, findings: Iterable[Finding]) -> tuple[Recording, tuple[Finding, ...]]:
    """Apply the lossless repairs of findings.

    For a finding of the doctor, its check runs again before and after the repair. If another repair has already removed
    the finding, nothing is done. If the finding is still there after its own repair, the repair is dropped. Findings of
    readers cannot be checked again; their repairs are applied directly.

    Args:
        recording: never changed.
        findings: of `examine`, or some of them; those without a fix are skipped.

    Returns: the repaired recording (the same if nothing was applied), and the findings whose repairs are in it.
    """
    wanted = sorted((f for f in findings if _possible(recording, f.fix)), key=_rank)
    applied: list[Finding] = []
    for finding in wanted:
        current = _again(recording, finding)
        if current is None or not _possible(recording, current.fix):
            continue
        repaired = repair(recording, current)
        if _check_of(finding) is not None and _again(repaired, finding) is not None:
            continue
        recording = repaired
        applied.append(finding)
    if applied:
        done = {id(f) for f in applied}
        recording = replace(recording, findings=tuple(f for f in recording.findings if id(f) not in done))
    return recording, tuple(applied)


def _rank(finding: Finding) -> int:
    """Rank of a repair in the order of application: repairs of readers first, while their row numbers still hold."""
    assert finding.fix is not None
    return -1 if _check_of(finding) is None else FIX_ORDER.index(finding.fix.kind)


def repair(recording: Recording, finding: Finding) -> Recording:
    """The recording with the fix of one finding applied and recorded in the metadata, not verified."""
    fix = finding.fix
    assert fix is not None
    signals: Signals = dict(recording.signals)
    for name in fix.signals:
        signals[name] = _REPAIRS[fix.kind](signals[name], fix, recording)
    if fix.kind in _TIME_FIXES:
        signals = _merged(_separate_streams(signals, recording.signals, fix))
    return replace(recording, signals=signals, metadata=_noted(recording.metadata, finding))


def _again(recording: Recording, finding: Finding) -> Finding | None:
    """The finding by a new run of its check: None if it is gone, the finding itself if no check can run again."""
    check = _check_of(finding)
    if check is None:
        return finding
    return next((f for f in check.run(recording) if _wish(f) == _wish(finding)), None)


def _wish(finding: Finding) -> object:
    """Equal for findings that ask for a repair of one kind of the same signals."""
    fix = finding.fix
    return finding.check, finding.signal, fix and (fix.kind, frozenset(fix.signals))


def _check_of(finding: Finding) -> Check | None:
    return next((check for check in CHECKS if check.module == finding.check), None)


def _possible(recording: Recording, fix: Fix | None) -> bool:
    """Whether a fix is well formed and can be undone."""
    if fix is None or fix.kind not in _REPAIRS or not fix.signals or not all(map(math.isfinite, fix.factor)):
        return False
    arrays, rows, count = [recording.signals.get(name) for name in fix.signals], fix.rows, len(fix.factor)
    for array in arrays:
        if array is None or (rows is not None and rows.size and not 0 <= rows.min() <= rows.max() < array.time.size):
            return False
        width = array.value.shape[1]
        if fix.kind == "scale" and (count not in (1, width) or 0.0 in fix.factor):
            return False
        if fix.kind == "world_to_body" and (width != 3 or "attitude" not in recording.signals):
            return False
    if fix.kind == "unwrap":
        return rows is not None and count == rows.size
    return (fix.kind != "shift" or count == 1) and (fix.kind != "mark" or rows is not None)


# kinds ---------------------------------------------------------------------------------------------------------


def _scale(array: SignalArray, fix: Fix, recording: Recording) -> SignalArray:
    return replace(array, value=_on_rows(array.value, array.value * np.array(fix.factor), fix.rows))


def _unwrap(array: SignalArray, fix: Fix, recording: Recording) -> SignalArray:
    assert fix.rows is not None
    steps = np.zeros(array.time.size)
    np.add.at(steps, fix.rows, fix.factor)
    return replace(array, time=array.time + np.cumsum(steps))


def _mark(array: SignalArray, fix: Fix, recording: Recording) -> SignalArray:
    assert fix.rows is not None
    value, marked = array.value.copy(), array.marked.copy()
    value[fix.rows], marked[fix.rows] = np.nan, True
    return replace(array, value=value, marked=marked)


def _world_to_body(array: SignalArray, fix: Fix, recording: Recording) -> SignalArray:
    """Rotate samples by the attitude at their stamps; samples without an attitude within 0.1 s become missing."""
    attitude = sound_samples(recording.signals["attitude"])
    if attitude is None:
        return array
    matrix = rotation_matrix(_attitude_at(*attitude, array.time))
    turned = np.einsum("kji,kj->ki", matrix, array.value)
    value = _on_rows(array.value, turned, fix.rows)
    lost = ~sound_rows(value) & sound_rows(array.value)
    return replace(array, value=value, marked=array.marked | lost)


_REPAIRS: dict[str, Callable[[SignalArray, Fix, Recording], SignalArray]] = {
    "scale": _scale,
    "shift": lambda array, fix, _: replace(array, time=_on_rows(array.time, array.time + fix.factor[0], fix.rows)),
    "unwrap": _unwrap,
    "mark": _mark,
    "sort": lambda array, fix, _: array.rows(np.argsort(array.time, kind="stable")),
    "world_to_body": _world_to_body,
    "stamps": lambda array, fix, _: array,
}


def _on_rows(old: Array, new: Array, rows: NDArray[np.int64] | None) -> Array:
    if rows is None:
        return new
    result = old.copy()
    result[rows] = new[rows]
    return result


def _attitude_at(stamps: Array, attitude: Array, time: Array) -> Array:
    """Unit quaternions (n, 4) at times (n,), interpolated between neighbours; NaN where none is near."""
    mixed = np.column_stack([np.interp(time, stamps, column) for column in continuous(attitude).T])
    mixed /= np.linalg.norm(mixed, axis=1, keepdims=True)
    after = np.minimum(np.searchsorted(stamps, time), stamps.size - 1)
    before = np.maximum(after - 1, 0)
    reach = np.minimum(np.abs(stamps[after] - time), np.abs(stamps[before] - time))
    mixed[~(reach <= _ATTITUDE_REACH)] = np.nan
    return mixed


# after times have changed ----------------------------------------------------------------------------------------


def _separate_streams(signals: Signals, before: Mapping[str, SignalArray], fix: Fix) -> Signals:
    """Give signals with changed stamps a separate stream if the rest of their stream is unchanged."""
    changed = set(fix.signals)
    for stream in {before[name].stream for name in changed}:
        members = {name for name, array in before.items() if array.stream == stream}
        if stream and not members <= changed:
            for name in members & changed:
                signals[name] = replace(signals[name], stream=f"{stream} {fix.kind}")
    return signals


def _merged(signals: Signals) -> Signals:
    """Signals with the processing order by time; samples with equal times keep their order."""
    arrays = list(signals.values())
    time = np.concatenate([a.time for a in arrays])
    order = np.concatenate([a.order for a in arrays])
    rank = np.empty(time.size, np.int64)
    rank[np.lexsort((order, time))] = np.arange(time.size)
    parts = np.split(rank, np.cumsum([a.time.size for a in arrays])[:-1])
    return {name: replace(a, order=part) for (name, a), part in zip(signals.items(), parts)}


# provenance ----------------------------------------------------------------------------------------------------


def _noted(metadata: Mapping[str, Mapping[str, str]], finding: Finding) -> dict[str, Mapping[str, str]]:
    fix = finding.fix
    assert fix is not None
    fixes = dict(metadata.get("fixes", {}))
    entry = {
        "check": finding.check,
        "kind": fix.kind,
        "signals": list(fix.signals),
        "factor": [float(f) for f in fix.factor],
        "rows": None if fix.rows is None else runs(fix.rows) if fix.kind != "unwrap" else fix.rows.tolist(),
        "text": finding.text,
    }
    fixes[f"{len(fixes) + 1:03d}"] = json.dumps(entry)
    return {**metadata, "fixes": fixes}


def runs(rows: NDArray[np.int64]) -> list[list[int]]:
    """Sample numbers as [first, last] of each run of neighbours."""
    flags = np.zeros(rows.max(initial=-1) + 1, bool)
    flags[rows] = True
    return [[int(first), int(end) - 1] for first, end in runs_of(flags)]
