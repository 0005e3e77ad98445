"""Findings of a reader as exact JSON text in an MCAP file of crazyem, from which they are read back."""

import json
from collections.abc import Iterable
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.mcap.scan import Loss, Problem

IMPORT_METADATA = "crazyem.signals"  # metadata record that crazyem adds to an imported recording
_MOST_ROWS = 100_000_000  # rows of a fix; guards against damaged runs


def findings_to_json(findings: Iterable[Finding]) -> str:
    """The findings as one text; the sample numbers of fixes as runs."""
    return json.dumps([finding.to_dict(rows=_runs) for finding in findings])


def findings_from_json(text: str) -> tuple[Finding, ...]:
    """Inverse of `findings_to_json`. Raises ValueError or RecursionError on anything else."""
    return msgspec.convert(json.loads(text), tuple[Finding, ...], dec_hook=_rows_of_runs)


def _rows_of_runs(kind: type, value: Any) -> NDArray[np.int64]:
    """Rows of a fix: the only numpy array in a finding."""
    runs = msgspec.convert(value, list[tuple[int, int]])
    if any(a < 0 or b < a for a, b in runs) or sum(b - a for a, b in runs) > _MOST_ROWS:
        raise ValueError("not rows")
    return np.concatenate([np.empty(0, np.int64), *(np.arange(a, b) for a, b in runs)]).astype(np.int64)


def _runs(rows: NDArray[np.int64]) -> list[list[int]]:
    """[first, last + 1] of each run of consecutive numbers, in the given order."""
    if not rows.size:
        return []
    breaks = np.flatnonzero(np.diff(rows) != 1) + 1
    starts, ends = rows[np.r_[0, breaks]], rows[np.r_[breaks - 1, rows.size - 1]] + 1
    return [[int(a), int(b)] for a, b in zip(starts, ends, strict=True)]


def finding_of(problem: Problem, *, lost_messages: int | None = None) -> Finding:
    """The finding about bytes that a reader could not use."""
    where = f"byte {problem.offset}"
    evidence = {"offset_byte": float(problem.offset), "lost_byte": float(problem.end - problem.offset)}
    lost = ""
    if lost_messages is not None:
        evidence["lost_messages"] = float(lost_messages)
        lost = f", {lost_messages} messages are lost"
    if problem.loss is Loss.OPEN:
        text = "The recording was not closed; every complete chunk was read, at most the last second is missing."
        return Finding("integrity", Grade.HARMLESS, text, evidence=evidence)
    if problem.loss is Loss.CUT:
        text = f"The file ends in the middle of a record ({where}); everything before it was read."
        return Finding("integrity", Grade.HARMLESS, text, evidence=evidence)
    text = f"The file is damaged at {where}: {problem.why}; {problem.end - problem.offset} bytes were left out{lost}."
    advice = "Look for another copy of the file; what is between the last sample before and the first after is gone."
    return Finding("integrity", Grade.DEGRADES, text, evidence=evidence, advice=advice)
