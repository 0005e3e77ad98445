"""Cost of the updates of a running estimator, and accuracy of its incremental updates."""

import copy
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from flight import simulate
from numpy.typing import NDArray

from crazyem.estimation.em import WindowEM
from crazyem.estimation.model import Parameters
from crazyem.estimation.online import REFRESH, OnlineEstimator

BUDGET = 0.04  # s: four samples at 100 Hz
NAMES = ("mass", "Ixx", "Iyy", "Izz")


def timed(function: Callable[..., Any], seconds: list[float]) -> Callable[..., Any]:
    def wrapper(*arguments: Any, **options: Any) -> Any:
        begin = time.perf_counter()
        result = function(*arguments, **options)
        seconds.append(time.perf_counter() - begin)
        return result

    return wrapper


def e_step(em: WindowEM, first: int, last: int) -> float:
    """Filter, smoother and statistics of the window; log-likelihood."""
    likelihood = em.forward(first, last, restart=True)
    em.backward(first, last)
    return likelihood


def full_pass(em: WindowEM, first: int, last: int) -> Parameters:
    """One whole EM iteration: inputs for the present lag, E-step, M-step. The parameters of `em` stay unchanged."""
    em.refill_inputs(first, last)
    e_step(em, first, last)
    return em.maximise(first, last)


def measure_online(*, seed: int, window: int, seconds: float) -> dict[str, Any]:
    """Cost of a running estimator by kind of work: updates with and without full passes, samples without an update."""
    flight = simulate(seed=seed, seconds=seconds)
    estimator = OnlineEstimator(flight.vehicle, window=window)
    samples = list(flight.samples())
    incremental: list[float] = []
    converge: list[float] = []
    whole: list[tuple[float, bool]] = []
    other: list[float] = []
    hooked = False
    for sample in samples:
        if not hooked and estimator._em is not None:
            estimator._em.incremental = timed(estimator._em.incremental, incremental)  # type: ignore[method-assign]
            estimator._em.converge = timed(estimator._em.converge, converge)  # type: ignore[method-assign]
            hooked = True
        passes = len(converge)
        begin = time.perf_counter()
        estimate = estimator.feed(sample)
        spent = time.perf_counter() - begin
        if estimator.counters.nodes <= window:  # the window is not full yet
            incremental.clear()
            converge.clear()
        elif estimate is None:
            other.append(spent)
        else:
            whole.append((spent, len(converge) > passes))
    per_node = 1e3 * sum(other) / max(1, len(whole) * estimator.every)
    result: dict[str, Any] = {"samples_per_s": 100, "python_per_sample_without_update_ms": per_node}
    for name, values in (
        ("incremental pass alone", incremental),
        ("converge (full passes) alone", converge),
        ("update without full pass, estimate included", [s for s, full in whole if not full]),
        ("update with full passes", [s for s, full in whole if full]),
        ("all updates", [s for s, _ in whole]),
    ):
        ms = 1e3 * np.array(values) if values else np.array([math.nan])
        result[name] = {
            "n": len(values), "median_ms": float(np.median(ms)), "p99_ms": float(np.percentile(ms, 99)),
            "max_ms": float(ms.max()), "share_of_budget": float(np.median(ms)) * 1e-3 / BUDGET,
        }  # fmt: skip
    busy = sum(s for s, _ in whole) + sum(other)
    result["load_of_one_core_at_100_Hz"] = busy / (max(1, len(whole)) * BUDGET)
    return result


def measure_accuracy(*, seeds: Sequence[int], window: int, seconds: float, passes: int = 100) -> dict[str, Any]:
    """Relative difference (n, 4) of the running parameters from two full-window estimates.

    The first is a single full pass from the running parameters: it shows the loss of the incremental E-step. The second
    is iterated until the score test is passed (or `passes`): it adds the lack of convergence. The comparison is just
    before each periodic full pass, after the longest time of incremental updates.
    """
    references: dict[str, list[NDArray]] = {"one full pass": [], "converged": []}
    widths: list[NDArray] = []
    stale: list[int] = []
    for seed in seeds:
        flight = simulate(seed=seed, seconds=seconds)
        estimator = OnlineEstimator(flight.vehicle, window=window)
        since = updates = full = 0
        for sample in flight.samples():
            if estimator.feed(sample) is None:
                continue
            updates += 1
            since = since + 1 if estimator.full_updates == full else 0
            full = estimator.full_updates
            em = estimator._em
            assert em is not None
            if updates % REFRESH != REFRESH - 1 or em.tape.size < window:
                continue
            other = copy.deepcopy(em)
            first, last = other.tape.size - window, other.tape.size
            once = full_pass(other, first, last)
            information = other.converge(first, last, passes=passes)
            references["one full pass"].append(em.parameters.theta[:4] / once.theta[:4] - 1.0)
            references["converged"].append(em.parameters.theta[:4] / other.parameters.theta[:4] - 1.0)
            widths.append(np.sqrt(np.diag(information.covariance))[:4])
            stale.append(since)
    sd = np.array(widths)
    out: dict[str, Any] = {"seeds": list(seeds), "n": len(sd), "updates_since_full_pass": [min(stale), max(stale)]}
    for name, rows in references.items():
        d = np.array(rows)
        out[name] = {
            "max_percent": (100 * np.abs(d).max(0)).tolist(),
            "rms_percent": (100 * np.sqrt(np.mean(d**2, 0))).tolist(),
            "max_in_standard_deviations": np.abs(d / sd).max(0).tolist(),
        }
    return out


def table(result: dict[str, Any]) -> str:
    """The measurements of this file as Markdown."""
    lines: list[str] = []
    if "online" in result:
        r = result["online"]
        lines += ["", "| online | n | median ms | p99 ms | max ms | share of 40 ms |", "|---|---|---|---|---|---|"]
        for name, row in r.items():
            if isinstance(row, dict):
                lines.append(
                    f"| {name} | {row['n']} | {row['median_ms']:.3g} | {row['p99_ms']:.3g} | {row['max_ms']:.3g} "
                    f"| {100 * row['share_of_budget']:.2g} % |"
                )
        lines.append(f"\nPython per sample that brings no update: {r['python_per_sample_without_update_ms']:.3f} ms")
        lines.append(f"load of one core at 100 Hz: {100 * r['load_of_one_core_at_100_Hz']:.1f} %")
    if "accuracy" in result:
        r = result["accuracy"]
        stale = "..".join(str(u) for u in r["updates_since_full_pass"])
        lines += ["", f"incremental updates against full passes: {r['n']} comparisons, {len(r['seeds'])} seeds, "
                  f"{stale} updates after the last full pass", "",
                  "| against | | " + " | ".join(NAMES) + " |", "|---|---|---|---|---|---|"]  # fmt: skip
        for name in ("one full pass", "converged"):
            for kind, label in (
                ("max_percent", "max %"), ("rms_percent", "rms %"), ("max_in_standard_deviations", "max in sd"),
            ):  # fmt: skip
                lines.append(f"| {name} | {label} | " + " | ".join(f"{v:.4f}" for v in r[name][kind]) + " |")
    return "\n".join(lines)
