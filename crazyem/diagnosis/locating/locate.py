"""Differences of a flight from a model: which force, torque or sensor error is missing, when, and in which regime.

A disturbance on one axis is a column like any other. Its score and information by blocks give the disturbance of each
block with its error. By bins of a regime (speed, height, tilt ...) they give its dependence on the regime.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.gram import bounded
from crazyem.diagnosis.fitting.model import Column, Model, Point, Swept
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.settings import LOCATION
from crazyem.diagnosis.workers import Workers
from crazyem.physics.rotations import rotation_matrix

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Finding:
    """A place where the model fails.

    Attributes:
        signal: "force", "torque", "attitude", "velocity" or "body_rate".
        axis: x, y or z of the body (velocity: of the world); "world x" or "world y" of a force that is more constant
            along axes of the world than of the body.
        regime: in words, "always" for a constant.
        variable: the variable of the regime; "" for a constant.
        interval: s, time of the finding.
        effect_size: in `unit`, with sd.
        nats: gain of log-likelihood by a disturbance there over the dispersion, less its number of parameters.
        p_value: corrected for the number of tests.
    """

    signal: str
    axis: str
    regime: str
    variable: str
    interval: tuple[float, float]
    effect_size: float
    sd: float
    unit: str
    nats: float
    p_value: float


@dataclass(frozen=True)
class Disturbance:
    """Missing disturbances over time.

    Attributes:
        time: (b,) s, of the blocks.
        names: of k series, signal and axis as in findings: "force x", "force world x", "attitude z".
        units: of the k series.
        value, sd: (b, k).
    """

    time: NDArray
    names: tuple[str, ...]
    units: tuple[str, ...]
    value: NDArray
    sd: NDArray


@dataclass(frozen=True)
class Located:
    """All findings, strongest first; disturbances of each flight; p-values of white innovations by channel."""

    findings: tuple[Finding, ...]
    disturbances: tuple[Disturbance, ...]
    whiteness: dict[str, float]


def units_of(point: Point) -> NDArray:
    """(6,) mass and inertias: N per m/s^2 and N m per rad/s^2."""
    return np.array([point.vehicle.mass] * 3 + list(point.vehicle.inertia))


def axis_columns(flight: Flight, weights: NDArray | None = None) -> list[Column]:
    """Columns of a unit acceleration on each of the six axes, times weights (n,)."""
    return [Column(f"axis{i}", acting=acting) for i, acting in enumerate(_units(flight, weights, 6))]


def shown_columns(flight: Flight, weights: NDArray | None = None) -> list[Column]:
    """Columns of a unit error of measured velocity, attitude and rate, times weights (n,)."""
    return [Column(f"shown{i}", showing=showing) for i, showing in enumerate(_units(flight, weights, 12)[3:], 3)]


def _units(flight: Flight, weights: NDArray | None, axes: int) -> list[NDArray]:
    """For each axis an array (n, axes) with the weights (n,), or ones, on this axis alone."""
    found = np.zeros((axes, flight.time.size, axes))
    found[np.arange(axes), :, np.arange(axes)] = 1.0 if weights is None else weights
    return list(found)


def world_columns(rotation: NDArray) -> list[Column]:
    """Columns of a unit acceleration along world x and y, for attitudes (n, 3, 3)."""
    none = np.zeros((len(rotation), 3))
    return [Column(f"world {AXES[k]}", acting=np.concatenate([rotation[:, k], none], axis=1)) for k in range(2)]


def regimes(flight: Flight, path: NDArray, thrust: NDArray) -> dict[str, tuple[NDArray, str]]:
    """Variables that a mismatch may depend on: name -> ((n,) values, unit)."""
    up = rotation_matrix(path[:, 6:10])[:, 2, 2]
    speed = np.linalg.norm(path[:, 3:6], axis=1)
    found = {
        "time": (flight.time, "s"),
        "x": (path[:, 0], "m"),
        "y": (path[:, 1], "m"),
        "height": (path[:, 2] - flight.ground, "m"),
        "speed": (speed, "m/s"),
        "velocity x": (path[:, 3], "m/s"),
        "velocity y": (path[:, 4], "m/s"),
        "velocity z": (path[:, 5], "m/s"),
        "tilt": (np.degrees(np.arccos(np.clip(up, -1, 1))), "deg"),
        "rate": (np.linalg.norm(path[:, 10:13], axis=1), "rad/s"),
        "thrust": (thrust.sum(1), "N"),
        **{f"rotor {i + 1}": (thrust[:, i], "N") for i in range(4)},
    }
    if np.isfinite(flight.voltage).all():
        found["voltage"] = (flight.voltage, "V")
    if not np.isfinite(flight.y[:, 0]).any():
        for name in ("x", "y", "height"):
            del found[name]
    return found


def locate(data: Data, point: Point) -> Located:
    """The differences of flights from a model."""
    findings: list[Finding] = []
    disturbances = []
    whiteness: dict[str, list[float]] = {}
    for model in data.models:
        found, disturbance, white = _one(model, point, data.workers)
        findings += found
        disturbances.append(disturbance)
        for name, p in white.items():
            whiteness.setdefault(name, []).append(p)
    kept = [f for f in findings if f.p_value < LOCATION.finding_p]
    kept.sort(key=lambda f: -f.nats)
    return Located(
        tuple(kept), tuple(disturbances), {n: float(min(1.0, min(p) * len(p))) for n, p in whiteness.items()}
    )


def _one(model: Model, point: Point, workers: Workers) -> tuple[list[Finding], Disturbance, dict[str, float]]:
    flight = model.flight
    unit = np.concatenate([units_of(point), np.ones(9)])
    constant = [*axis_columns(flight), *shown_columns(flight)[:6]]
    swept = model.sweep(point, constant)
    b, a = swept.score, np.einsum("bii->bi", swept.information)
    dispersion = _dispersion(b, a)
    times = np.array([flight.time[flight.block == i].mean() for i in range(flight.blocks)])
    findings = []
    for i in (*range(6), 9, 10, 11):
        findings += _constant_and_change(i, b[:, i], a[:, i], dispersion[i], flight, times, unit[i])
    path = model.rows_path if model.rows_path is not None else swept.filtered
    room = model.sweep(point, world_columns(rotation_matrix(path[:, 6:10])))
    findings += _of_the_world(model, point, room, times, findings)
    in_time = _in_time(point, times, (b, a), (room.score, np.einsum("bii->bi", room.information)))
    thrust = model.thrusts(point.vehicle, point.effects)[0]
    for found in workers.map(
        lambda regime: _by_regime(model.twin(), point, regime[0], *regime[1], unit),
        regimes(flight, path, thrust).items(),
    ):
        findings += found
    return findings, in_time, _whiteness(swept.innovation, swept.variance)


def _in_time(
    point: Point, times: NDArray, body: tuple[NDArray, NDArray], world: tuple[NDArray, NDArray]
) -> Disturbance:
    """The disturbance of each axis in every block, from scores and informations (b, k) by axes of body and world."""
    b, a = (np.concatenate(pair, axis=1) for pair in zip(body, world, strict=True))
    signals = [_signal(i) for i in range(body[0].shape[1])]
    signals += [("force", f"world {axis}", "N") for axis in AXES[:2]]
    size = np.array([*units_of(point), *np.ones(len(signals) - 8), *[point.vehicle.mass] * 2])
    value, sd = np.zeros_like(b), np.sqrt(_dispersion(b, a) / np.maximum(a, 1e-30))
    np.divide(b, a, out=value, where=a > 0)
    names, units = tuple(f"{signal} {axis}" for signal, axis, _ in signals), tuple(unit for *_, unit in signals)
    return Disturbance(times, names, units, value * size, np.minimum(sd * size, 1e3))


def _of_the_world(
    model: Model, point: Point, swept: Swept, times: NDArray, of_the_body: Sequence[Finding]
) -> list[Finding]:
    """Constant or changing forces along horizontal axes of the world that gain more than forces along axes of the body:
    a wind on a drone that turns."""
    flight = model.flight
    b, a = swept.score, np.einsum("bii->bi", swept.information)
    dispersion = _dispersion(b, a)
    found = []
    for k in range(2):
        found += _constant_and_change(k, b[:, k], a[:, k], dispersion[k], flight, times, point.vehicle.mass)
    body = [f for f in of_the_body if f.signal == "force" and f.axis in AXES[:2]]
    better = [f for f in found if all(f.nats > g.nats for g in body if g.variable == f.variable)]
    return [replace(f, axis=f"world {f.axis}") for f in better]


def _dispersion(b: NDArray, a: NDArray) -> NDArray:
    """Variance of the scores of blocks about their mean, over the information; at least 1."""
    total = np.maximum(a.sum(0), 1e-300)
    centred = b - a * (b.sum(0) / total)
    return np.maximum(1.0, (centred**2).sum(0) / total * len(b) / max(len(b) - 1, 1))


def _signal(i: int) -> tuple[str, str, str]:
    signal, unit = (("force", "N"), ("torque", "N m"), ("velocity", "m/s"), ("attitude", "rad"))[i // 3]
    return signal, AXES[i % 3], unit


def _constant_and_change(
    i: int, b: NDArray, a: NDArray, dispersion: float, flight: Flight, times: NDArray, unit: float
) -> list[Finding]:
    signal, axis, name = _signal(i)
    total_b, total_a = b.sum(), a.sum()
    if total_a <= 0:
        return []
    span = (float(flight.time[0]), float(flight.time[-1]))
    found = []
    mean, sd = total_b / total_a, np.sqrt(dispersion / total_a)
    p = float(stats.t.sf(abs(mean / sd), max(len(b) - 1, 1)) * 2)
    if p < LOCATION.finding_p:
        found.append(Finding(signal, axis, "always", "", span, mean * unit, sd * unit, name,
                             0.5 * total_b * mean / dispersion - 1, p))  # fmt: skip
    # one change in flight: the split that gains most; the dispersion is about the means of both sides
    best = (0.0, 0)
    cb, ca = np.cumsum(b), np.cumsum(a)
    for k in range(2, len(b) - 2):
        left, right = ca[k - 1], total_a - ca[k - 1]
        if left > 0 and right > 0:
            gain = 0.5 * (cb[k - 1] ** 2 / left + (total_b - cb[k - 1]) ** 2 / right - total_b**2 / total_a)
            best = max(best, (gain, k))
    gain, k = best
    if k:
        before, after = cb[k - 1] / ca[k - 1], (total_b - cb[k - 1]) / (total_a - ca[k - 1])
        level = np.where(np.arange(len(b)) < k, before, after)
        scatter = max(1.0, float(((b - a * level) ** 2).sum() / total_a * len(b) / max(len(b) - 2, 1)))
        p = float(min(1.0, stats.f.sf(2 * gain / scatter, 1, max(len(b) - 2, 1)) * len(b)))
        if p < LOCATION.finding_p:
            error = np.sqrt(scatter * (1 / ca[k - 1] + 1 / (total_a - ca[k - 1])))
            when = float(0.5 * (times[k - 1] + times[k]))
            found.append(Finding(signal, axis, f"changes at {when:.1f} s", "time", (when, span[1]),
                                 (after - before) * unit, error * unit, name, gain / scatter - 2, p))  # fmt: skip
    return found


def _by_regime(
    model: Model, point: Point, name: str, values: NDArray, regime_unit: str, unit: NDArray
) -> list[Finding]:
    """Findings of disturbances that differ between the bins of a regime."""
    flight = model.flight
    edges = np.quantile(values, np.linspace(0, 1, LOCATION.bins + 1))
    if not np.all(np.diff(edges) > 1e-9 * max(1.0, np.abs(edges).max())):
        return []
    which = np.clip(np.searchsorted(edges, values, "right") - 1, 0, LOCATION.bins - 1)
    columns: list[Column] = []
    for k in range(LOCATION.bins):
        w = (which == k).astype(float)
        columns += [*axis_columns(flight, w), *shown_columns(flight, w)[3:6]]
    per = 9
    swept = model.sweep(point, columns)
    found = []
    for i in range(per):
        index = np.arange(LOCATION.bins) * per + i
        b = swept.score[:, index]
        a = swept.information[:, index][:, :, index]
        total_b, total_a = b.sum(0), a.sum(0)
        if np.any(np.diag(total_a) <= 0):
            continue
        theta = bounded(total_a, total_b, None, None)
        whole = total_a.sum()  # 0 for what is the same in all bins if a nuisance takes that up (a sensor's bias)
        one = total_b.sum() / whole if whole > 1e-9 * np.trace(total_a) else 0.0
        gain = 0.5 * total_b @ theta - 0.5 * total_b.sum() * one
        residual = b - a @ theta
        scatter = max(1.0, float(np.sum(residual**2) / np.trace(total_a) * len(b) / max(len(b) - LOCATION.bins, 1)))
        freedom = max(len(b) - LOCATION.bins, 1)
        p = float(stats.f.sf(2 * gain / scatter / (LOCATION.bins - 1), LOCATION.bins - 1, freedom))
        if p >= LOCATION.finding_p:
            continue
        signal, axis, label = _signal(i if i < 6 else i + 3)
        size = unit[i if i < 6 else 14]
        spread = theta - one
        k = int(np.argmax(np.abs(spread)))
        rows = np.flatnonzero(which == k)
        error = np.sqrt(scatter * np.linalg.inv(total_a + 1e-12 * np.diag(np.diag(total_a)))[k, k])
        words = f"{name} {edges[k]:.3g} to {edges[k + 1]:.3g} {regime_unit}"
        found.append(Finding(signal, axis, words, name, (float(flight.time[rows[0]]), float(flight.time[rows[-1]])),
                             float(spread[k] * size), float(error * size), label,
                             float(gain / scatter - (LOCATION.bins - 1)), p))  # fmt: skip
    return found


CHANNELS = ("position", "velocity", "attitude", "body_rate")


def _whiteness(innovation: NDArray, variance: NDArray, lags: int = 10) -> dict[str, float]:
    """Ljung-Box p-value of the standardised innovations of each channel."""
    found = {}
    for c, channel in enumerate(CHANNELS):
        for i in range(3):
            seen = variance[:, 3 * c + i] > 0
            if seen.sum() < 10 * lags:
                continue
            z = innovation[seen, 3 * c + i] / np.sqrt(variance[seen, 3 * c + i])
            z = z - z.mean()
            n, power = z.size, float(z @ z)
            if power <= 0:
                continue
            q = sum((float(z[k:] @ z[:-k]) / power) ** 2 / (n - k) for k in range(1, lags + 1)) * n * (n + 2)
            found[f"{channel} {AXES[i]}"] = float(stats.chi2.sf(q, lags))
    return found


def strongest(findings: Sequence[Finding], most: int = 12) -> list[Finding]:
    """The best finding of each signal, axis and kind of regime, strongest first."""
    seen: set[tuple[str, str, str]] = set()
    chosen = []
    for f in sorted(findings, key=lambda f: -f.nats):
        key = (f.signal, f.axis, f.variable)
        if key not in seen:
            seen.add(key)
            chosen.append(f)
    return chosen[:most]
