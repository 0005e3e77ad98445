"""The figures of issue 5, counted from truths and answers, with a list of all failures."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from crazyem.vehicle import Vehicle, load_vehicle

from . import judge
from .judge import DETECTABLE, STRONG, Document

QUANTITIES = ("position", "velocity", "attitude", "body_rate")
Z = 1.959964  # standard normal quantile of 97.5 %
WITHIN = 1.1  # held-out error over that of the true model
EDGES = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0 + 1e-9)  # of confidence


@dataclass(frozen=True)
class Outcome:
    """One case with all inputs of the score.

    Attributes:
        truth: see draw.draw. result: the answer's JSON without the effects `aside`, None without an answer.
        seconds: run time of the diagnosis.
        nats: of an ideal observer, None where not known. held_out: "nominal", "fitted", "true" -> quantity -> error.
        of_each: of a pair, effect -> nats of an ideal observer for it beside the other; None or absent: unknown.
        vehicle: the nominal one that the diagnosis was given; None: the platform's.
    """

    truth: Document
    result: Document | None
    seconds: float = 0.0
    nats: float | None = None
    held_out: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    of_each: Mapping[str, float | None] = field(default_factory=dict)
    vehicle: Vehicle | None = None

    def __post_init__(self) -> None:
        if self.result is not None and self.truth.get("aside"):
            object.__setattr__(self, "result", judge.without(self.result, self.truth["aside"]))

    @property
    def kind(self) -> str:
        return str(self.truth["kind"])

    @property
    def names(self) -> list[str]:
        return [*self.truth["effects"], *self.truth["hidden"]]

    @property
    def strong(self) -> bool:
        return min(self.truth["strength"].values(), default=0.0) >= STRONG

    @property
    def detectable(self) -> bool:
        """Whether an ideal observer detects the effect; True if unknown, which can only lower the figures."""
        return self.nats is None or self.nats > DETECTABLE

    @property
    def each_detectable(self) -> bool:
        """Whether an ideal observer detects every effect beside the others; True if unknown."""
        return self.detectable and all(n is None or n > DETECTABLE for n in self.of_each.values())


def _share(values: Sequence[float]) -> dict[str, Any]:
    return {"n": len(values), "share": float(np.mean(values)) if len(values) else None}


def wilson(share: float, n: int) -> tuple[float, float]:
    """95 % interval of a share of n cases (Wilson's score interval; half credits count as half a case)."""
    middle = (share + Z * Z / (2 * n)) / (1 + Z * Z / n)
    half = Z / (1 + Z * Z / n) * math.sqrt(share * (1 - share) / n + Z * Z / (4 * n * n))
    return max(0.0, middle - half), min(1.0, middle + half)


def figures(outcomes: Iterable[Outcome]) -> dict[str, Any]:
    """All figures; "share" None where no case counts."""
    cases = list(outcomes)
    kinds = {k: [c for c in cases if c.kind == k] for k in ("nothing", "single", "pair", "outside")}
    seen = [c for c in kinds["single"] if c.detectable]
    pairs = [c for c in kinds["pair"] if c.detectable]
    return {
        "cases": {k: len(v) for k, v in kinds.items()},
        "ideal_observer_known": sum(c.nats is not None for c in cases),
        "no_answer": sum(c.result is None for c in cases),
        "nothing": {"false_alarms": _share([float(_alarm(c)) for c in kinds["nothing"]])},
        "single": {
            "detectable": {"n": len(seen), "of": len(kinds["single"])},
            "named_first_strong": _share([_credit(c) for c in seen if c.strong]),
            "named_first_all": _share([_credit(c) for c in seen]),
            "first_whatever_groups": _share([float(judge.named(c.result)[:1] == c.names) for c in seen]),
            "right_rotor": _share(_rotors(seen)),
            "undetectable_named_first": _share([_credit(c) for c in kinds["single"] if not c.detectable]),
        },
        "parameters": _parameters([*seen, *pairs]),
        "pairs": {
            "both_and_only_both": _share([float(judge.right_pair(c.names, c.result)) for c in pairs]),
            "up_to_declared_groups": _share([float(_loose(c)) for c in pairs]),
            "each_detectable": _share([float(judge.right_pair(c.names, c.result)) for c in pairs if c.each_detectable]),
            "each_known": sum(any(n is not None for n in c.of_each.values()) for c in pairs),
        },
        "outside": _outside(kinds["outside"]),
        "held_out": _held_out(cases),
        "confidence": _confidence(cases),
        "seconds": _seconds(cases),
        "by_effect": _by_effect(seen),
        "failures": failures(cases),
    }


def _alarm(case: Outcome) -> bool:
    return bool(case.result and (case.result.get("mismatch") or case.result.get("effects")))


def _credit(case: Outcome) -> float:
    return judge.credit(case.names[0], case.result)


def _loose(case: Outcome) -> bool:
    return judge.right_pair(case.names, case.result) or judge.pair_up_to_groups(case.names, case.result)


def _vehicle(case: Outcome) -> Vehicle:
    return case.vehicle or load_vehicle(case.truth["platform"])


def _rotors(cases: Iterable[Outcome]) -> list[float]:
    """For each named effect with a rotor: 1.0 if the rotor is right, else 0.0."""
    out = []
    for case in cases:
        for name, table in case.truth["effects"].items():
            found = judge.entry(name, case.result)
            if found is not None and "rotor" in table:
                out.append(float(judge.same_rotor(table, found)))
    return out


def _parameters(cases: Iterable[Outcome]) -> dict[str, Any]:
    """Coverage and error over every effect that is both true and named."""
    held: list[bool] = []
    without = 0
    off: list[float] = []
    onset: list[float] = []
    by_effect: dict[str, list[float]] = {}
    for case in cases:
        for name, table in case.truth["effects"].items():
            found = judge.entry(name, case.result)
            if found is None:
                continue
            for _, inside in judge.coverage(table, found):
                without += inside is None
                held += [] if inside is None else [inside]
            wrong = list(judge.errors(name, table, found, _vehicle(case)).values())
            off += wrong
            by_effect.setdefault(name, []).extend(wrong)
            seconds = judge.onset_error(table, found)
            onset += [] if seconds is None else [seconds]
    return {
        "interval_coverage": _share([float(h) for h in held]),
        "without_interval": without,
        "error": {"n": len(off), "median": float(np.median(off)) if off else None},
        "error_by_effect": {k: {"n": len(v), "median": float(np.median(v))} for k, v in sorted(by_effect.items()) if v},
        "onset_error_s": {"n": len(onset), "median": float(np.median(onset)) if onset else None},
    }


def _outside(cases: Sequence[Outcome]) -> dict[str, Any]:
    judged = [judge.outside(c.names[0], c.result) for c in cases]
    return {
        "unexplained": _share([float(j["unexplained"]) for j in judged]),
        "unexplained_right_axis": _share([float(j["axis"]) for j in judged]),
        "unexplained_right_axis_and_regime": _share([float(j["axis"] and j["regime"]) for j in judged]),
        "wrong_confident_name": _share([float(j["wrong_name"]) for j in judged]),
    }


def ratio(case: Outcome) -> float | None:
    """Fitted model's held-out error over the true model's, mean over the quantities; None where one is missing."""
    fitted, true = case.held_out.get("fitted"), case.held_out.get("true")
    if not fitted or not true:
        return None
    found = [fitted[q] / true[q] for q in QUANTITIES if true.get(q, 0.0) > 0.0]
    return float(np.mean(found)) if found and np.all(np.isfinite(found)) else None


def _held_out(cases: Iterable[Outcome]) -> dict[str, Any]:
    ratios = [r for c in cases if c.kind in ("single", "pair") and c.detectable and (r := ratio(c)) is not None]
    return {
        "within_10_percent_of_true_model": _share([float(r <= WITHIN) for r in ratios]),
        "median_ratio": float(np.median(ratios)) if ratios else None,
        "mean_ratio": float(np.mean(ratios)) if ratios else None,
    }


def _confidence(cases: Iterable[Outcome]) -> dict[str, Any]:
    """Stated confidence against the share of right names, over every name in every answer."""
    claims = [claim for c in cases for claim in judge.claims(c.names, c.result)]
    if not claims:
        return {"n": 0, "bins": [], "expected_calibration_error": None, "brier": None}
    said, right = np.array([c for c, _ in claims]), np.array([float(r) for _, r in claims])
    bins, total = [], 0.0
    for low, high in pairwise(EDGES):
        use = (said >= low) & (said < high)
        if use.any():
            bins.append({"from": low, "to": min(high, 1.0), "n": int(use.sum()), "said": float(said[use].mean()),
                         "right": float(right[use].mean())})  # fmt: skip
            total += use.sum() * abs(said[use].mean() - right[use].mean())
    return {
        "n": len(claims),
        "bins": bins,
        "expected_calibration_error": float(total / len(claims)),
        "brier": float(np.mean((said - right) ** 2)),
    }


def _seconds(cases: Sequence[Outcome]) -> dict[str, Any]:
    spent = [c.seconds for c in cases if c.result is not None]
    return {"median": float(np.median(spent)), "longest": max(spent)} if spent else {"median": None, "longest": None}


def _by_effect(seen: Sequence[Outcome]) -> dict[str, Any]:
    names = sorted({c.names[0] for c in seen})
    return {n: _share([_credit(c) for c in seen if c.names[0] == n]) for n in names}


def failures(cases: Iterable[Outcome]) -> list[dict[str, Any]]:
    """Every detectable case that is not completely right, with truth and answer."""
    out = []
    for case in cases:
        why = _why(case)
        if why:
            out.append({
                "case": case.truth["case"],
                "why": why,
                "true": {**case.truth["effects"], **case.truth["hidden"]},
                "strength": case.truth["strength"],
                "styles": [f["style"] for f in case.truth["flights"].values()],
                "nats": case.nats,
                "nats_of_each": dict(case.of_each),
                "said": [{"name": e.get("name"), "confidence": e.get("confidence")}
                         for e in (case.result or {}).get("effects") or []],
                "indistinguishable": (case.result or {}).get("indistinguishable") or [],
            })  # fmt: skip
    return out


def _why(case: Outcome) -> str:
    """The kind of failure; empty if the case is right or not detectable."""
    if case.result is None:
        return "no answer"
    if case.kind == "nothing":
        return "false alarm" if _alarm(case) else ""
    if case.kind == "outside":
        judged = judge.outside(case.names[0], case.result)
        if judged["wrong_name"]:
            return "wrong confident name"
        return "" if judged["axis"] and judged["regime"] else "not told as unexplained with axis and regime"
    if not case.detectable:
        return ""
    if case.kind == "pair":
        return "" if judge.right_pair(case.names, case.result) else "not both and only both"
    value = _credit(case)
    return (
        ""
        if value == 1.0
        else ("only within a group" if value else "wrong name" if judge.named(case.result) else "missed")
    )
