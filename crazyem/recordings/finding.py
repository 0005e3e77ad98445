"""Findings, the problems of a recording: each with a name, times, a grade, evidence and advice."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Grade(StrEnum):
    """How much a finding matters to an estimate or a diagnosis made from the recording."""

    HARMLESS = "harmless"  # for information; results are not affected
    DEGRADES = "degrades"  # results are worse or partly wrong unless the problem is solved
    UNUSABLE = "unusable"  # the signal or the recording must not be used as it is

    @property
    def rank(self) -> int:
        """0 for the worst."""
        return [*reversed(Grade)].index(self)


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """A repair without loss: it can be undone, or removes only values that were never measured.

    Attributes:
        kind: "scale" multiplies the components of the signals by `factor` (unit, sign or scale); "world_to_body"
            rotates a world vector into the body frame by the attitude of the recording; "shift" adds `factor[0]`
            seconds to the stamps; "unwrap" adds `factor[i]` seconds to the stamps from sample `rows[i]` on; "mark"
            makes the samples in `rows` missing (they were never measured); "sort" brings samples into the order of
            their stamps; "stamps" changes nothing: the reader has already treated the impossible stamps.
        signals: names of the signals that change.
        factor: numbers; `kind` says what they mean; one per component for "scale".
        rows: numbers of the samples that change, None for all.
    """

    kind: str
    signals: tuple[str, ...]
    factor: tuple[float, ...] = ()
    rows: NDArray[np.int64] | None = None

    def to_dict(self, rows: Callable[[NDArray[np.int64]], object] = np.size) -> dict[str, Any]:
        """For JSON: the rows as a count, or as `rows` makes of them."""
        made = None if self.rows is None else rows(self.rows)
        return {"kind": self.kind, "signals": list(self.signals), "factor": list(self.factor), "rows": made}


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """One problem or remarkable property of a recording."""

    # which check found it, e.g. "gaps"; readers use "integrity", "interpolated", "mapping", "motor_meaning", "stamps".
    check: str
    grade: Grade  # how much it matters
    text: str  # one sentence for people
    signal: str = ""  # name of the signal concerned; "" for the whole recording
    # (start, end) in s on the recording's time axis, in order; () for the whole recording
    intervals: tuple[tuple[float, float], ...] = ()
    # numbers that support the finding, by a name that has the unit ("longest_s", "slope", "share")
    evidence: Mapping[str, float] = field(default_factory=dict)
    advice: str = ""  # what to do, one sentence
    fix: Fix | None = None  # a lossless repair, None if there is none

    def to_dict(self, rows: Callable[[NDArray[np.int64]], object] = np.size) -> dict[str, Any]:
        """For JSON; `rows` as for `Fix.to_dict`."""
        return {
            "check": self.check,
            "grade": str(self.grade),
            "signal": self.signal,
            "text": self.text,
            "intervals": [[float(a), float(b)] for a, b in self.intervals],
            "evidence": {k: float(v) for k, v in self.evidence.items()},
            "advice": self.advice,
            "fix": None if self.fix is None else self.fix.to_dict(rows),
        }


def percent(share: float) -> str:
    """A share as text, to two digits and without a power of ten: "0.43 %", "12 %", "100 %"."""
    size = abs(100.0 * share)
    if 0.0 < size < 0.01:
        return "under 0.01 %"
    return f"{100.0 * share:.0f} %" if size >= 9.95 else f"{100.0 * share:.2g} %"


def note(check: str, text: str, grade: Grade = Grade.HARMLESS, advice: str = "", **evidence: float) -> Finding:
    """A finding about a whole recording: a sentence, advice and its numbers."""
    return Finding(check, grade, text, evidence=evidence, advice=advice)


def runs_of(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(k, 2) first row, and row after the last, of each run of True."""
    return np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8))).reshape(-1, 2)


def intervals_of(time: NDArray[np.float64], rows: NDArray[np.bool_]) -> tuple[tuple[float, float], ...]:
    """(start, end) of each run of True, from (n,) times and flags."""
    return tuple((float(time[a]), float(time[b - 1])) for a, b in runs_of(rows))
