"""Comparison of a measurement with predictions from other streams; the checks of rates, velocities and forces use it.

Each prediction belongs to a hypothesis about the measurement's frame, axes or meaning. A slope near a known factor is
another unit, another slope is a scale fault.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor.kinematics import Grid, Track, Window, delay, track
from crazyem.doctor.regression import Choice, Slope, blocks, choose, slope
from crazyem.recordings.finding import Finding, Fix, Grade
from crazyem.recordings.ordering import Array
from crazyem.recordings.recording import SignalArray

SLOPE_WINDOW = 0.5  # s, window for slopes: filters of streams do not change motion this slow
ROW_STRIDE = 3  # grid steps between rows; more in recordings of more than a few minutes
MOST_COMPARED_ROWS = 6000  # most rows of a comparison
LEAST_SCALE_COVERAGE = 0.5  # least share of the time that the data of a scale fault cover
SCALE_TOLERANCE = 0.02  # relative; sensors and filters in good order differ by this much
FEWEST_SCALE_BLOCKS = 5.0  # least number of blocks (of 1.5 s or more) of motion for a scale fault
_AXIS_NAMES = "xyz"
_FACTOR_TOLERANCE = math.log(1.2)  # largest |log| of a slope over a known factor


def signed(label: str, vector: Array, names: Sequence[str] = _AXIS_NAMES) -> dict[str, tuple[int, Array]]:
    """All 48 signed orders of the components of (n, 3): name -> (cost, values); the unchanged order is first.

    The cost is lower for simpler hypotheses: 1 for a sign (2 for all three), 2 more for another order. Names: "body",
    "body x, -y, z", "body y, x, z".
    """
    out: dict[str, tuple[int, Array]] = {}
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            flipped = sum(s < 0 for s in signs)
            cost = (2 if flipped == 3 else flipped) + (0 if order == (0, 1, 2) else 2)
            parts = ("-" * (s < 0) + names[i] for s, i in zip(signs, order, strict=True))
            name = label if cost == 0 else f"{label} " + ", ".join(parts)
            out[name] = (cost, vector[:, order] * np.array(signs))
    return out


def sign_factor(name: str, names: Sequence[str] = _AXIS_NAMES) -> tuple[float, ...] | None:
    """Factors that undo signs named by `signed` ("x, -y, z"), None if the order changed."""
    parts = name.split(", ")
    if [part.lstrip("-") for part in parts] != list(names):
        return None
    return tuple(-1.0 if part.startswith("-") else 1.0 for part in parts)


def known_factor(found: Slope, known: Mapping[str, float]) -> tuple[str, float] | None:
    """Name and value of the known factor within 20 % of a slope; None if there is none."""
    if found.value <= 0.0:
        return None
    for name, factor in known.items():
        if abs(math.log(found.value / factor)) < _FACTOR_TOLERANCE:
            return name, factor
    return None


@dataclass(frozen=True, slots=True)
class ScaleFault:
    """A scale that is not 1. `text` names the scales and intervals; `repair` has the factors to multiply with."""

    text: str
    repair: tuple[float, ...]


def scale_fault(whole: Slope | None, single: Sequence[Slope | None], least: float) -> ScaleFault | None:
    """A scale fault of all or some components; None if no slope is at least `least` from 1 with certainty.

    Args:
        whole: slope of all components together.
        single: of each component.
        least: deviation from 1 that matters.
    """
    known = [s for s in single if s is not None]
    # one factor for all, if no component contradicts it
    if whole is not None and _off(whole, least) and all(s.low <= whole.high and s.high >= whole.low for s in known):
        return ScaleFault(f"its scale is {_said(whole)}", (1.0 / whole.value,) * len(single))
    off = {i: s for i, s in enumerate(single) if s is not None and _off(s, least)}
    if not off:
        return None
    said = [f"{_AXIS_NAMES[i]} {_said(s)}" for i, s in off.items()]
    repair = tuple(1.0 / off[i].value if i in off else 1.0 for i in range(len(single)))
    return ScaleFault("its scale is " + ", ".join(said), repair)


def slope_numbers(single: Sequence[Slope | None]) -> dict[str, float]:
    """Slopes of the components with their intervals, as evidence."""
    out: dict[str, float] = {}
    for axis, s in zip(_AXIS_NAMES, single, strict=False):
        if s is not None:
            out |= {f"slope_{axis}": s.value, f"slope_{axis}_low": s.low, f"slope_{axis}_high": s.high}
    return out


def _off(s: Slope, least: float) -> bool:
    certain = s.far_low > 1.0 + SCALE_TOLERANCE or s.far_high < 1.0 - SCALE_TOLERANCE
    return abs(s.value - 1.0) >= least and certain and s.explained > 0.8 and s.blocks >= FEWEST_SCALE_BLOCKS


def _said(s: Slope) -> str:
    return f"{s.value:.3f} ({s.low:.3f} to {s.high:.3f})"


@dataclass(frozen=True, eq=False)
class Comparison:
    """Result of the comparison of one measurement with its predictions."""

    against: str  # name of the signal that the predictions come from
    choice: Choice  # which hypothesis holds
    lag: float  # s by which the measurement is late; already removed
    whole: Slope | None  # slope of the measurement against the chosen prediction, all components together
    single: tuple[Slope | None, ...]  # the same for each component
    offset: Array  # (3,) median of measurement minus slope times prediction
    offset_error: Array  # (3,) its standard error
    covered: float  # share of the common time that the windows of the slope cover
    mean: Array  # (3,) of the measurement
    predicted: Array  # (3,) mean of the declared prediction
    mean_error: Array  # (3,) standard error of `mean`, without the part that the prediction explains

    @property
    def declared(self) -> str:
        return next(iter(self.choice.explained))

    @property
    def explained(self) -> float:
        """Share of the variance that the best hypothesis explains."""
        return self.choice.explained[self.choice.best]

    def evidence(self) -> dict[str, float]:
        """The numbers that every finding of the comparing checks carries."""
        out = {
            "explained": self.choice.explained[self.choice.name or self.choice.best],
            "explained_as_declared": self.choice.explained[self.declared],
            "unexplained_ratio": self.choice.ratio,
            "lag_ms": 1e3 * self.lag,
        }
        if self.whole is not None:
            out |= {"slope": self.whole.value, "slope_low": self.whole.low, "slope_high": self.whole.high}
            out["samples"] = float(self.whole.samples)
        return out


def compare_hypotheses(
    array: SignalArray,
    grid: Grid,
    against: str,
    candidates: Mapping[str, tuple[int, Track]],
    *,
    width: float,
    least: float,
    offset: bool = True,
) -> Comparison | None:
    """Compare a measurement with predictions; None with too little motion or data.

    Args:
        array: the measurement, three components.
        grid: of the predictions.
        against: name of the signal that the predictions come from.
        candidates: name -> (cost, lower for simpler hypotheses; prediction before smoothing); the declared one first.
        width: s, of the window.
        least: least rms about the mean of the declared prediction.
        offset: compare after the means are removed.
    """
    window = Window(width)
    stride = max(ROW_STRIDE, grid.size // MOST_COMPARED_ROWS)
    smooth = {name: window.mean(given) for name, (_, given) in candidates.items()}
    declared = next(iter(smooth.values()))
    raw = track(array, grid)
    late = delay(declared, window.mean(raw))
    lag = 0.0 if late is None or late.at_edge or late.explained < 0.3 else late.value
    raw = track(array, grid, shift=lag) if lag else raw
    measured = window.mean(raw)
    rows = np.flatnonzero(measured.valid & np.logical_and.reduce([s.valid for s in smooth.values()]))[::stride]
    if rows.size < 100 or float(declared.value[rows].std(axis=0).max()) < least:
        return None
    y = measured.value[rows]
    block = blocks(grid.time[rows])
    chosen = {name: (cost, smooth[name].value[rows]) for name, (cost, _) in candidates.items()}
    for name, (cost, value) in signed(next(iter(chosen)), chosen[next(iter(chosen))][1]).items():
        chosen.setdefault(name, (cost, value))
    choice = choose(y, chosen, block, offset=offset)
    if choice is None:
        return None
    name = choice.name or choice.best
    x = chosen[name][1]
    at = declared.value[rows]
    if name in candidates:  # slow motion gives better slopes
        wide = Window(max(SLOPE_WINDOW, width))
        far_x, far_y = wide.mean(candidates[name][1]), wide.mean(raw)
        keep = np.flatnonzero(far_x.valid & far_y.valid)[::stride]
        if keep.size > 200:
            at = at if keep.size == len(rows) else wide.mean(next(iter(candidates.values()))[1]).value[keep]
            x, y, block = far_x.value[keep], far_y.value[keep], blocks(grid.time[keep])
    return _comparison(against, choice, lag, x, y, at, block, covered=len(y) * stride / grid.size)


def _comparison(
    against: str, choice: Choice, lag: float, x: Array, y: Array, at: Array, block: NDArray[np.int64], *, covered: float
) -> Comparison:
    """Slopes, offset and means of (n, 3) measurements `y`, the chosen prediction `x` and the declared one `at`."""
    whole = slope(x, y, block)
    single = tuple(slope(x[:, i], y[:, i], block) for i in range(3))
    factor = 1.0 if whole is None or whole.far_low <= 1.0 <= whole.far_high else whole.value
    rest = y - factor * x
    square = float((at * at).sum())
    ratio = float((at * y).sum()) / square if square > 0 else 1.0
    return Comparison(
        against=against,
        choice=choice,
        lag=lag,
        whole=whole,
        single=single,
        offset=np.median(rest, axis=0),
        offset_error=_error(rest, block),
        covered=covered,
        mean=y.mean(axis=0),
        predicted=at.mean(axis=0),
        mean_error=_error(y - at * ratio, block),
    )


def agreed_scale(looks: Sequence[Comparison], least: float) -> tuple[Comparison, ScaleFault, int] | None:
    """A scale fault on which all comparisons agree; None if a precise comparison does not show it.

    The reference may be wrong itself (an onboard attitude follows its own filter), so all references must show the
    fault. Stretches between lost packets are a biased sample, so the comparison must cover half of the time.
    Returns the comparison with the narrowest interval, its fault, and the number of comparisons that show the fault.
    """
    found = []
    for one in looks:
        if one.whole is None or one.choice.denied:
            continue
        fault = scale_fault(one.whole, one.single, least) if one.covered >= LEAST_SCALE_COVERAGE else None
        if fault is not None and one.explained >= 0.8:
            found.append((one, fault))
        elif one.whole.far_high - one.whole.far_low < 0.3:
            return None
    if not found:
        return None
    directions = {tuple(np.sign(np.round(np.log(fault.repair), 9))) for _, fault in found}
    best = min(found, key=lambda pair: pair[0].whole.high - pair[0].whole.low if pair[0].whole else math.inf)
    return (*best, len(found)) if len(directions) == 1 else None


def misread(
    check: str,
    name: str,
    seen: Comparison,
    known: Mapping[str, tuple[str, str]],
    *,
    noun: str,
    what: str = "the derivative of ",
    fix: Fix | None = None,
) -> Finding:
    """The finding that a vector is in another frame or has other axes than declared.

    Args:
        check: name of the check. name: signal. noun: quantity of the components ("body rate").
        known: hypothesis -> its description and advice.
        what: operation on the reference, as text before its name.
        fix: the repair for the first entry of `known`.
    """
    choice, frame = seen.choice.name, seen.declared
    advice = "Correct its frame, axes or signs where it is read."
    if choice in known:
        text, advice = known[choice]
        fix = fix if choice == next(iter(known)) else None
    elif choice.startswith(f"{frame} "):
        signs = choice.removeprefix(f"{frame} ")
        text = f"its components are {signs} of the {noun}"
        factor = sign_factor(signs)
        fix = Fix("scale", (name,), factor) if factor else None
    else:
        text, fix = "it is not what it is declared to be, but which axes or frame it has cannot be told", None
    share, declared = 100.0 * seen.evidence()["explained"], 100.0 * seen.choice.explained[frame]
    tail = f" ({share:.2f} % of its variance explained, as declared {declared:.2f} %)."
    text = f"{name} against {what}{seen.against}: {text}{tail}"
    return Finding(check, Grade.UNUSABLE, text, name, (), seen.evidence(), advice, fix)


def wrong_unit(
    check: str, name: str, text: str, factor: float, evidence: Mapping[str, float], advice: str = "Correct its unit."
) -> Finding:
    """The finding that a vector is `factor` times its value in SI units."""
    fix = Fix("scale", (name,), (1.0 / factor,) * 3)
    return Finding(check, Grade.UNUSABLE, text, name, (), evidence, advice, fix)


def wrong_scale(
    check: str, name: str, looks: Sequence[Comparison], least: float, *, alone: str, agreed: str
) -> list[Finding]:
    """The finding that a signal differs by a factor from the derivative of its reference; empty if it does not.

    Args:
        check: name of the check. name: signal. looks, least: as for `agreed_scale`.
        alone, agreed: advice if one comparison, or several, show the factor.
    """
    found = agreed_scale(looks, least)
    if found is None:
        return []
    seen, fault, witnesses = found
    numbers = {**seen.evidence(), **slope_numbers(seen.single)}
    text = f"{name} is not the derivative of {seen.against}: {fault.text}."
    if witnesses < 2:
        return [Finding(check, Grade.DEGRADES, text, name, (), numbers, alone)]
    return [Finding(check, Grade.DEGRADES, text, name, (), numbers, agreed, Fix("scale", (name,), fault.repair))]


def _error(value: Array, block: NDArray[np.int64]) -> Array:
    means = np.array([value[block == b].mean(axis=0) for b in np.unique(block)])
    return np.asarray(means.std(axis=0, ddof=1) / math.sqrt(len(means)), float)
