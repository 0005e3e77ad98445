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
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))  # to run as a file and as a module

import reference
import running
from flight import simulate
from running import e_step, full_pass, timed
from window import Window

from crazyem.estimation import kernels
from crazyem.estimation.em import WindowEM
from crazyem.estimation.in_step import corrected
from crazyem.estimation.model import Parameters
from crazyem.estimation.online import OnlineEstimator


@dataclass
class Contender:
    """A timed call: the function, the number of rounds without it between two calls, and its times [s]."""

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


def scored_pass(em: WindowEM, first: int, last: int, *, in_step: bool = False) -> Parameters:
    """A full pass that also gets score and information; `in_step`: of a log sampled in phase with predictions."""
    em.refill_inputs(first, last)
    em.forward(first, last, restart=True)
    em.backward(first, last)
    information = em.information(first, last)
    if in_step:
        corrected(em, first, last, information)
    return em.maximise(first, last)


def textbook(window: Window) -> float:
    """Run the estimator's reference: dense matrices, textbook formulas, plain numpy."""
    x = reference.state_of(window.prior)
    filtered = reference.extended_kalman_filter(
        window.time, window.y, window.thrust, window.torque, prior=x, prior_cov=window.prior_cov, mass=window.mass,
        inertia=window.inertia, q=window.q, r=window.r,
    )  # fmt: skip
    reference.rauch_tung_striebel(window.time, filtered, q=window.q)
    return filtered.log_likelihood


class Incremental:
    """A second running estimator: each call feeds it until an update is due; only the incremental pass is timed.

    Full passes of the estimator are not timed.
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
        em.incremental = timed(em.incremental, self.seconds)  # type: ignore[method-assign]

    def __call__(self) -> None:
        """Up to and including the next update."""
        while self._estimator.feed(next(self._samples)) is None:
            pass


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
        em.forward = timed(before, seconds)  # type: ignore[method-assign]
        em.converge(self._first, self._last, passes=200)
        em.forward = before  # type: ignore[method-assign]
        self.passes = len(seconds)
        return em.parameters


def peers(window: Window, nominal: Window, *, slow_stride: int) -> tuple[list[Contender], list[str]]:
    """The installed peers, ready to run, and the names of the missing ones.

    Smoothers get the window with converged parameters, the moving-horizon estimate the one with nominal parameters.
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
        Contender("crazyem: the same, commands in step", lambda: scored_pass(em, first, last, in_step=True)),
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
    incremental = Contender("crazyem: incremental update (4 new, 20 again)", live, seconds=live.seconds)
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


def table(result: dict[str, Any]) -> str:
    """The measurement as Markdown."""
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
        result["online"] = running.measure_online(seed=arguments.seed, **common)
    if "accuracy" in parts:
        seeds = range(arguments.seed, arguments.seed + arguments.seeds)
        result["accuracy"] = running.measure_accuracy(seeds=list(seeds), **common)
    print("\n\n".join(t.strip() for t in (table(result), running.table(result)) if t))
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
