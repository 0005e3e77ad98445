"""How fast is the estimator, against named peers, on one window of one synthetic flight? And is the fast path right?

    python benchmarks/speed.py                      # everything; peers that are not installed are left out
    python benchmarks/speed.py --only speed --rounds 60
    python benchmarks/speed.py --only accuracy --seeds 10

speed: every contender gets the same window (800 samples, 12 error states, 13 numbers), the same parameters and the same
prior, in interleaved rounds in one process on one core; medians, ranges and ratios. online: cost of each kind of update
of a running OnlineEstimator, and of a sample that brings none. accuracy: how far the incremental update is from the
converged full-window estimate, at the moments when it is stalest. Install the peers with `pip install -e '.[bench]'`.
"""

import argparse
import copy
import json
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parent))  # so that it runs as a file and as a module

from flight import simulate
from window import Window

from crazyem.estimation import kernels, reference
from crazyem.estimation.em import WindowEM
from crazyem.estimation.model import Parameters
from crazyem.estimation.online import REFRESH, OnlineEstimator

BUDGET = 0.04  # s: four samples at 100 Hz
NAMES = ("mass", "Ixx", "Iyy", "Izz")


@dataclass
class Contender:
    """Something to time: a call, how many rounds it sits out between two, and what it took [s]."""

    name: str
    call: Callable[[], Any]
    stride: int = 1
    seconds: list[float] = field(default_factory=list)
    result: Any = None

    def run(self) -> None:
        """One timed call."""
        begin = time.perf_counter()
        self.result = self.call()
        self.seconds.append(time.perf_counter() - begin)


def settled(*, seed: int, window: int, seconds: float) -> WindowEM:
    """A WindowEM whose tape holds a whole flight and whose parameters are converged on the newest window."""
    flight = simulate(seed=seed, seconds=seconds)
    estimator = OnlineEstimator(flight.vehicle, window=window)
    for sample in flight.samples():
        estimator.feed(sample)
    estimator.finish()
    em = estimator._em
    assert em is not None
    return em


def window_of(em: WindowEM, first: int, last: int) -> Window:
    """The arrays of a window, for peers."""
    t, p = em.tape, em.parameters
    rows = slice(first, last)
    return Window(
        time=t.time[rows].copy(), y=t.y[rows].copy(), thrust=t.thrust[rows].copy(), torque=t.torque[rows].copy(),
        prior=t.xp[first].copy(), prior_cov=t.pp[first].copy(), mass=float(p.theta[0]), inertia=p.inertia,
        q=p.noise.q, r=p.noise.r,
    )  # fmt: skip


def e_step(em: WindowEM, first: int, last: int) -> float:
    """Filter, smoother and statistics of the window; log-likelihood."""
    likelihood = em.forward(first, last, restart=True)
    em.backward(first, last)
    return likelihood


def full_pass(em: WindowEM, first: int, last: int) -> Parameters:
    """One whole EM iteration: inputs for the present lag, E-step, M-step. The parameters stay as they are."""
    em.refill_inputs(first, last)
    e_step(em, first, last)
    return em.maximise(first, last)


def scored_pass(em: WindowEM, first: int, last: int) -> Parameters:
    """The same with the Fisher information of all parameters and the score of the noise scales."""
    em.refill_inputs(first, last)
    em.forward(first, last, restart=True)
    em.information(first, last)
    em.backward(first, last)
    em._noise_score(first, last)
    return em.maximise(first, last)


def textbook(window: Window) -> float:
    """The estimator's own oracle: dense matrices, textbook formulas, plain numpy."""
    x = reference.state_of(window.prior)
    filtered = reference.extended_kalman_filter(
        window.time, window.y, window.thrust, window.torque, prior=x, prior_cov=window.prior_cov, mass=window.mass,
        inertia=window.inertia, q=window.q, r=window.r,
    )  # fmt: skip
    reference.rauch_tung_striebel(window.time, filtered, q=window.q)
    return filtered.log_likelihood


class Incremental:
    """A second estimator flying along: each call feeds it until an update is due and does only the incremental pass.

    Full passes happen where the estimator wants them, outside the clock.
    """

    def __init__(self, *, seed: int, window: int, seconds: float) -> None:
        flight = simulate(seed=seed, seconds=seconds)
        self._samples = flight.samples()
        self._estimator = OnlineEstimator(flight.vehicle, window=window)
        self.seconds: list[float] = []
        while self._estimator.counters.nodes < window + 2 * self._estimator.every:
            self._estimator.feed(next(self._samples))
        em = self._estimator._em
        assert em is not None
        em.incremental = _timed(em.incremental, self.seconds)  # type: ignore[method-assign]

    def __call__(self) -> None:
        """Up to and including the next update."""
        while self._estimator.feed(next(self._samples)) is None:
            pass


def _timed(function: Callable[..., Any], seconds: list[float]) -> Callable[..., Any]:
    def wrapper(*arguments: Any, **options: Any) -> Any:
        begin = time.perf_counter()
        result = function(*arguments, **options)
        seconds.append(time.perf_counter() - begin)
        return result

    return wrapper


class FromNominal:
    """Full passes from the vehicle file's constants (mass and inertia some 20 % off) until the score test is passed."""

    def __init__(self, em: WindowEM, first: int, last: int) -> None:
        self._em, self._first, self._last = copy.deepcopy(em), first, last
        self.passes = 0

    def __call__(self) -> Parameters:
        """One solve; mass, inertia, rotor lag, delay and ten noise scales are free."""
        em, before = self._em, self._em.forward
        em.parameters = em.setup.start
        seconds: list[float] = []
        em.forward = _timed(before, seconds)  # type: ignore[method-assign]
        em.converge(self._first, self._last, passes=200)
        em.forward = before  # type: ignore[method-assign]
        self.passes = len(seconds)
        return em.parameters


def peers(window: Window, nominal: Window, *, slow_stride: int) -> tuple[list[Contender], list[str]]:
    """Whatever of the peers is installed, ready to run, and the names of those that are not.

    Smoothers get the window with its converged parameters, the moving-horizon estimate that with the nominal ones.
    """
    import peer_numpy

    found = [
        Contender(
            "plain numpy, written for speed: EKF + RTS", peer_numpy.make(window), stride=max(1, slow_stride // 4)
        ),
        Contender("plain numpy, textbook (the test oracle): EKF + RTS", lambda: textbook(window), stride=slow_stride),
    ]
    missing = []
    try:
        import peer_dynamax

        found.append(Contender("dynamax EKF smoother (JAX, jit, float64)", peer_dynamax.make(window)))
    except ImportError:
        missing.append("dynamax")
    try:
        import mhe_casadi

        found.append(
            Contender(
                "CasADi/IPOPT moving-horizon estimate, from nominal", mhe_casadi.make(nominal), stride=slow_stride
            )
        )
    except ImportError:
        missing.append("casadi")
    return found, missing


def measure_speed(*, seed: int, window: int, rounds: int, seconds: float, with_peers: bool = True) -> dict[str, Any]:
    """All contenders, interleaved. Returns rows (name, n, median, least, most [ms], ratio), likelihoods, parameters."""
    em = settled(seed=seed, window=window, seconds=seconds)
    last = em.tape.size
    first = last - window
    plain = window_of(em, first, last)
    slow = max(1, rounds // 10)
    live = Incremental(seed=seed + 1, window=window, seconds=window / 100.0 + 1.0 + rounds * 4 / 100.0)
    ours = [
        Contender("crazyem: full EM pass", lambda: full_pass(em, first, last)),
        Contender("crazyem: its E-step alone", lambda: e_step(em, first, last)),
        Contender("crazyem: full pass with score and information", lambda: scored_pass(em, first, last)),
        Contender("crazyem: converged from the nominal vehicle", FromNominal(em, first, last), stride=slow),
    ]
    start = em.setup.prior.centre
    nominal = replace(plain, mass=float(start[0]), inertia=np.diag(start[1:4]))
    others, missing = peers(plain, nominal, slow_stride=slow) if with_peers else ([], ["peers: left out"])
    for contender in ours + others:
        contender.call()  # compiled, and caches warm
    for round_ in range(rounds):
        for contender in ours + others:
            if round_ % contender.stride == 0:
                contender.run()
        live()
    unit = float(np.median(ours[0].seconds))
    incremental = Contender("crazyem: incremental update (4 new, 40 smoothed)", live, seconds=live.seconds)
    return {
        "window": window,
        "rows": [_row(c, unit) for c in [*ours, incremental, *others]],
        "missing": missing,
        "log_likelihood": {c.name: c.result for c in [*ours, *others] if isinstance(c.result, float)},
        "theta": _thetas(em, [*ours, *others]),
    }


def _row(contender: Contender, unit: float) -> dict[str, Any]:
    ms = 1e3 * np.array(contender.seconds)
    return {
        "name": contender.name, "n": len(ms), "median_ms": float(np.median(ms)), "min_ms": float(ms.min()),
        "max_ms": float(ms.max()), "ratio": float(np.median(ms)) / (1e3 * unit),
    }  # fmt: skip


def _thetas(em: WindowEM, others: Sequence[Contender]) -> dict[str, Any]:
    """Converged EM against the moving-horizon mode, as a check that both solved the same problem."""
    out: dict[str, Any] = {"crazyem, converged": em.parameters.theta[:4].tolist()}
    for contender in others:
        if isinstance(contender.call, FromNominal):
            out[f"{contender.name} ({contender.call.passes} passes)"] = contender.result.theta[:4].tolist()
        if hasattr(contender.result, "iterations"):
            found = contender.result
            out[f"CasADi/IPOPT ({found.iterations} iterations, success {found.success})"] = found.theta.tolist()
    return out


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
            estimator._em.incremental = _timed(estimator._em.incremental, incremental)  # type: ignore[method-assign]
            estimator._em.converge = _timed(estimator._em.converge, converge)  # type: ignore[method-assign]
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

    One is a single full pass from the running parameters, which shows what the incremental E-step loses; the other is
    iterated until the score test is passed (or `passes`), which adds what had not converged before. Compared just
    before each periodic full pass, when the parameters have been updated incrementally the longest.
    """
    references: dict[str, list[NDArray]] = {"one full pass": [], "converged": []}
    widths: list[NDArray] = []
    stale: list[int] = []
    for seed in seeds:
        flight = simulate(seed=seed, seconds=seconds)
        estimator = OnlineEstimator(flight.vehicle, window=window)
        since = updates = 0
        settled_before: Any = None
        for sample in flight.samples():
            if estimator.feed(sample) is None:
                continue
            updates += 1
            since = since + 1 if estimator._settled is settled_before else 0
            settled_before = estimator._settled
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


def show(result: dict[str, Any]) -> str:
    """The measurements as Markdown tables."""
    lines: list[str] = []
    if "speed" in result:
        r = result["speed"]
        lines += [
            f"window of {r['window']} samples",
            "",
            "| | n | median ms | min..max ms | ratio |",
            "|---|---|---|---|---|",
        ]
        for row in r["rows"]:
            span = f"{row['min_ms']:.3g}..{row['max_ms']:.3g}"
            lines.append(f"| {row['name']} | {row['n']} | {row['median_ms']:.3g} | {span} | {row['ratio']:.3g} |")
        lines += [f"| {name} | | not installed | | |" for name in r["missing"]]
        lines += ["", "log-likelihood of the window:"]
        lines += [f"  {value:.4f}  {name}" for name, value in r["log_likelihood"].items()]
        lines += ["mass and inertia:"]
        lines += ["  " + " ".join(f"{v:.6g}" for v in values) + f"  {name}" for name, values in r["theta"].items()]
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


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; prints tables, optionally writes JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=("speed", "online", "accuracy"), help="one part instead of all")
    parser.add_argument("--rounds", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=10, help="flights of the accuracy part")
    parser.add_argument("--window", type=int, default=800)
    parser.add_argument("--seconds", type=float, default=25.0, help="length of the flights")
    parser.add_argument("--core", type=int, default=-1, help="core to stay on (default: the last; -2: any)")
    parser.add_argument("--json", help="write the numbers to this file")
    arguments = parser.parse_args(argv)
    if arguments.core > -2 and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[-1] if arguments.core == -1 else arguments.core})
    parts = (arguments.only,) if arguments.only else ("speed", "online", "accuracy")
    result: dict[str, Any] = {"kernel_statistics": kernels.SIZE}
    common = {"window": arguments.window, "seconds": arguments.seconds}
    if "speed" in parts:
        result["speed"] = measure_speed(seed=arguments.seed, rounds=arguments.rounds, **common)
    if "online" in parts:
        result["online"] = measure_online(seed=arguments.seed, **common)
    if "accuracy" in parts:
        seeds = range(arguments.seed, arguments.seed + arguments.seeds)
        result["accuracy"] = measure_accuracy(seeds=list(seeds), **common)
    print(show(result))
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
