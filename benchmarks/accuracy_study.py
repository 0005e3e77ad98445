"""How close the product's estimator comes to the Cramer-Rao bound on the paper's flights, in figures with errors.

A part is one kind of case (`PARTS`); a record is one estimate on one stretch of one flight beside its bound; a summary
combines records. Errors and bounds are of logarithms: relative, and symmetric for a factor up or down.

Every record also holds the error of an efficient estimator on the same data (`Bound.efficient`). Both share the noise,
and the scatter of the efficient one is known: so the loss of the estimator is separated from chance. Stretches of one
flight are dependent: standard errors are jackknifed over flights.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import UsageError
from crazyem.paper.bound import bound
from crazyem.paper.flight import Flight, fly
from crazyem.paper.product import PARAMETERS, ProductOnline, known_noise, product_offline
from crazyem.paper.settings import LITERAL, P5, Settings

RATIO_AIM = 1.10  # aim: rms error over the bound
BIAS_AIM = 0.20  # aim: mean error over the bound
COVERAGE_AIM = (0.92, 0.98)  # aim: of the 95 % intervals
MASS_BIAS_AIM = 5e-4  # aim: sensor C, relative


@dataclass(frozen=True)
class Part:
    """One kind of case.

    Attributes:
        title: of the part.
        sensors: used in the part.
        span: window (disjoint windows of each flight), flight (whole) or online (the running estimator at those rows).
        settings: of the simulation; P5 is the default reading.
        start: factors on the true mass and inertia to start from; None is the paper's cold start.
        known: whether the estimator is told the intensities of the process noise.
        accelerometer: whether A's is used.
    """

    title: str
    sensors: str = "ABC"
    span: str = "window"
    settings: Settings = P5
    start: tuple[float, float, float, float] | None = None
    known: bool = False
    accelerometer: bool = True


P3 = replace(P5, smooth=True, angle_gain=40.0, rate_gain=25.0)  # another reading of the paper, with a smooth reference
QUIET_SETTINGS = replace(P3, force_noise=5e-4, torque_noise=2e-5)
START_FACTORS = (1.2, 0.7, 1.3, 0.7)
PARTS = {
    "windows": Part("windows of 800 samples, one estimate each"),
    "flights": Part("whole flights of 4001 samples, one estimate each", span="flight"),
    "online": Part("the running estimator, an update every 4 samples, when a window is full", span="online"),
    "known": Part("windows of 800 samples, intensities of the process noise known", known=True),
    "literal": Part("windows of 800 samples, the paper read literally (s_M 5e-3, gains 40 and 20)", settings=LITERAL),
    "quiet": Part(
        "windows of 800 samples, settings P3 with little process noise (s_F 5e-4, s_M 2e-5), no accelerometer, start "
        "off by +20, -30, +30, -30 %",
        sensors="A", settings=QUIET_SETTINGS, start=START_FACTORS, accelerometer=False,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Record:
    """One estimate beside its bound; logarithms, relative.

    Attributes:
        part, sensor, seed, first, last: which stretch of which flight.
        error: (4) of mass, Ixx, Iyy, Izz.
        sd: (4) standard deviations of the estimator.
        inside: (4) whether the 95 % interval contains the truth.
        bound: (4) Cramer-Rao bound of the standard deviation.
        efficient: (4) error of an efficient estimator on the same data, first order.
        converged: as the estimator reports.
        passes: full passes, 0 if unknown.
        seconds: of the estimate; online the median of the last window's updates.
    """

    part: str
    sensor: str
    seed: int
    first: int
    last: int
    error: tuple[float, ...]
    sd: tuple[float, ...]
    inside: tuple[bool, ...]
    bound: tuple[float, ...]
    efficient: tuple[float, ...]
    converged: bool
    passes: int
    seconds: float


def settings_of(part: str) -> Settings:
    """The settings of the flights of a part.

    Raises:
        UsageError: there is no such part.
    """
    if part not in PARTS:
        raise UsageError(f"unknown part '{part}' (known: {', '.join(PARTS)})")
    return PARTS[part].settings


def stretches(settings: Settings, span: str) -> list[tuple[int, int]]:
    """Rows (first, last) of the data of each estimate: the whole flight, or disjoint windows from its start."""
    if span == "flight":
        return [(0, settings.steps + 1)]
    n = settings.window
    return [(a, a + n) for a in range(0, settings.steps + 2 - n, n)]


def study(part: str, sensor: str, seed: int) -> list[Record]:
    """Fly one seed with the true parameters in the controller and estimate from every stretch of it.

    Raises:
        UsageError: there is no such part, or it has no such sensor.
    """
    settings = settings_of(part)
    p = PARTS[part]
    if sensor not in p.sensors:
        raise UsageError(f"part '{part}' has no sensor '{sensor}' (it has {', '.join(p.sensors)})")
    run: Callable[..., Iterator[_Said]] = _online if p.span == "online" else _offline
    records = []
    for flight, first, last, value, sd, ci95, converged, passes, seconds in run(p, settings, sensor, seed):
        truth = np.array([settings.mass, *settings.inertia])
        best = bound(flight, sensor, first, last, accelerometer=p.accelerometer)
        if p.known:
            best = best.under("known")
        inside = (ci95[:, 0] <= truth) & (truth <= ci95[:, 1])
        records.append(
            Record(
                part, sensor, seed, first, last, _short(np.log(value / truth)), _short(sd / value),
                tuple(bool(i) for i in inside), _short(best.sd), _short(best.efficient), bool(converged), passes,
                round(seconds, 4),
            )
        )  # fmt: skip
    return records


_Said = tuple[Flight, int, int, NDArray, NDArray, NDArray, bool, int, float]


def _offline(part: Part, settings: Settings, sensor: str, seed: int) -> Iterator[_Said]:
    flight = fly(settings, seed)
    if part.start is not None:
        mass, *inertia = (v * f for v, f in zip((settings.mass, *settings.inertia), part.start))
        flight.settings = replace(settings, mass_start=mass, inertia_start=tuple(inertia))
    for first, last in stretches(settings, part.span):
        fit = product_offline(
            flight, sensor, first, last, known=known_noise(settings) if part.known else None,
            accelerometer=part.accelerometer,
        )  # fmt: skip
        yield flight, first, last, fit.value, fit.sd, fit.ci95, fit.converged, fit.passes, fit.seconds


def _online(part: Part, settings: Settings, sensor: str, seed: int) -> Iterator[_Said]:
    """Run the estimator online; the controller keeps the true parameters, so the flights are those of other parts.

    The newest update is a few rows older than the flight; the bound uses the rows of this update.
    """
    flight = Flight(settings, seed)
    product = ProductOnline(settings, sensor, accelerometer=part.accelerometer)
    ends = {last for _, last in stretches(settings, part.span)}
    while flight.size <= settings.steps:
        flight.advance(settings.every, mass=settings.mass, inertia=settings.inertia)
        value = product.update(flight)
        if flight.size - 1 not in ends or product.estimate is None:
            continue
        used = settings.every * len(product.update_seconds)
        said = [product.estimate[name] for name in PARAMETERS]
        sd, ci95 = np.array([s.sd for s in said]), np.array([s.ci95 for s in said])
        theta, converged = np.array([value[0], *value[1]]), product.estimate.converged
        seconds = float(np.median(product.update_seconds[-settings.window // settings.every :]))
        yield flight, max(0, used - settings.window), used, theta, sd, ci95, converged, 0, seconds


def _short(values: NDArray) -> tuple[float, ...]:
    return tuple(float(f"{v:.6g}") for v in values)


# what the records say together --------------------------------------------------------------------------------------


def summary(records: Sequence[Record]) -> dict[str, Any]:
    """Summary of the records of one part and sensor; every figure as [value, standard error] of the four parameters.

    Returns:
        n, flights, seeds (first and last); ratio: rms error over the bound; paired: the same with the luck of the draw
        taken out; bias: mean error over the bound, bias_paired; excess: rms difference from the efficient estimator
        over the bound; coverage of the 95 % intervals; claimed: rms of claimed sd over the bound; bound: rms relative;
        mass_bias: mean relative error of the mass; converged: share; passes, seconds: median; worst: largest error
        over the bound.

    Raises:
        UsageError: there are no records.
    """
    if not records:
        raise UsageError("no records to sum up")
    seeds = np.array([r.seed for r in records])
    best = np.array([r.bound for r in records])
    error = np.array([r.error for r in records])
    z, efficient = error / best, np.array([r.efficient for r in records]) / best
    inside = np.array([r.inside for r in records], float)
    claimed = np.array([r.sd for r in records]) / best

    def figure(function: Callable[[NDArray], NDArray]) -> list[list[float]]:
        return _jackknife(function, seeds)

    return {
        "n": len(records),
        "flights": len(set(seeds.tolist())),
        "seeds": [int(seeds.min()), int(seeds.max())],
        "ratio": figure(lambda at: _rms(z[at])),
        "paired": figure(lambda at: np.sqrt(np.maximum(1 + np.mean(z[at] ** 2 - efficient[at] ** 2, 0), 0))),
        "bias": figure(lambda at: z[at].mean(0)),
        "bias_paired": figure(lambda at: (z - efficient)[at].mean(0)),
        "excess": figure(lambda at: _rms((z - efficient)[at])),
        "coverage": figure(lambda at: inside[at].mean(0)),
        "claimed": figure(lambda at: _rms(claimed[at])),
        "bound": figure(lambda at: _rms(best[at])),
        "mass_bias": figure(lambda at: error[at, :1].mean(0)),
        "converged": round(float(np.mean([r.converged for r in records])), 4),
        "passes": float(np.median([r.passes for r in records])),
        "seconds": round(float(np.median([r.seconds for r in records])), 4),
        "worst": np.max(np.abs(z), 0).round(2).tolist(),
    }


def _rms(values: NDArray) -> NDArray:
    result: NDArray = np.sqrt(np.mean(values**2, axis=0))
    return result


def _jackknife(function: Callable[[NDArray], NDArray], groups: NDArray) -> list[list[float]]:
    """Value and standard error of a figure, leaving out one group at a time; NaN error with a single group."""
    everyone = np.arange(len(groups))
    value = function(everyone)
    names = np.unique(groups)
    error = np.full(value.shape, math.nan)
    if len(names) > 1:
        left_out = np.array([function(everyone[groups != name]) for name in names])
        error = np.sqrt((len(names) - 1) * left_out.var(axis=0))
    return [[float(f"{v:.5g}"), float(f"{e:.2g}")] for v, e in zip(value, error)]


def missed(part: str, sensor: str, figures: dict[str, Any]) -> list[str]:
    """The aims that a summary misses, each as a short sentence; empty if it meets all."""
    out = []
    for i, name in enumerate(PARAMETERS):
        ratio, bias, coverage = (figures[key][i][0] for key in ("ratio", "bias", "coverage"))
        low, high = COVERAGE_AIM
        if ratio > RATIO_AIM:
            out.append(f"{name}: rms error {ratio:.2f} of the bound")
        if abs(bias) > BIAS_AIM:
            out.append(f"{name}: bias {bias:+.2f} of the bound")
        if not low <= coverage <= high:
            out.append(f"{name}: intervals cover {100 * coverage:.1f} %")
    if sensor == "C" and abs(figures["mass_bias"][0][0]) > MASS_BIAS_AIM:
        out.append(f"mass: bias {100 * figures['mass_bias'][0][0]:+.3f} %")
    if figures["converged"] < 1:
        out.append(f"{part}: converged in {100 * figures['converged']:.1f} %")
    return out


def table(summaries: Iterable[tuple[str, dict[str, Any]]]) -> str:
    """Markdown: a line per sensor and parameter; figures as value ± standard error."""
    head = ["sensor", "parameter", "n", "bound %", "rms / bound", "paired", "bias / bound", "excess / bound",
            "coverage %", "claimed / bound"]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for sensor, s in summaries:
        for i, name in enumerate(PARAMETERS):
            cells = [
                sensor, name, f"{s['n']} ({s['flights']})", f"{100 * s['bound'][i][0]:.3g}",
                _plus_minus(s["ratio"][i]), _plus_minus(s["paired"][i]), _plus_minus(s["bias"][i], "+"),
                _plus_minus(s["excess"][i]), _plus_minus([100 * v for v in s["coverage"][i]], digits=1),
                _plus_minus(s["claimed"][i]),
            ]  # fmt: skip
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _plus_minus(figure: Sequence[float], sign: str = "", digits: int = 2) -> str:
    value, error = figure
    spread = "" if math.isnan(error) else f" ± {error:.{digits}f}"
    return f"{value:{sign}.{digits}f}{spread}"
