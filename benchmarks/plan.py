"""Plans beside other manoeuvres: intervals reached over drawn drones, expected widths over reached, boxes, crashes.

    python -m benchmarks.plan fly --seeds 100 --out out/plan     # goes on where it stopped
    python -m benchmarks.plan report --out out/plan

Each seed draws a drone and a day: mass, inertia, rotor lag, gains of the loop, noise of sensors, process and pose, drag
and gusts (the ranges of `benchmarks/concealed/conditions.py`). It flies 10 s each of every manoeuvre, through the wire
format in one process (`wire_flight.py`). The plan is made once for the preset cf2, which knows nothing of the draw.
"""

import argparse
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from benchmarks.concealed import conditions
from benchmarks.wire_flight import HEIGHT, Log, fly
from crazyem.control.harmonics import Harmonics
from crazyem.control.plan_file import read_plan
from crazyem.control.trajectories import Reference, Trajectory, excite, figure8, hover, window
from crazyem.estimation.em import WindowEM
from crazyem.estimation.in_step import PERIOD
from crazyem.estimation.online import ATTITUDE_PERIOD, OnlineEstimator
from crazyem.planning import closed_loop
from crazyem.planning.information import Expectation
from crazyem.planning.limits import Limits
from crazyem.planning.plan import plan_parameters
from crazyem.vehicle import Vehicle, load_vehicle
from firmware_sim.controllers import parameters
from firmware_sim.scenario import Scenario, parse_scenario

NAMES = ("mass", "Ixx", "Iyy", "Izz")
PLACE = (0.0, 0.0, HEIGHT)
DURATION = 10.0  # s
LIMITS = Limits(box=(1.0, 1.0, 1.0), tilt=math.radians(20.0))
KINDS = ("figure 8", "excite", "excite, scaled", "chirp", "plan", "plan, a third of the time")
FACTORS = {"mass": (0.9, 1.25), "inertia": (0.8, 1.3)}  # of the preset's
LAGS = (0.03, 0.07)  # s


@dataclass(frozen=True)
class Course:
    """A trajectory made of samples, in the form of the manoeuvres of `closed_loop.fly`."""

    duration: float
    sampled: Callable[[NDArray[np.float64]], NDArray[np.float64]]  # (n,) s -> (4 orders, n, 4 axes)

    def derivatives(self, time: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.sampled(np.clip(time, 0.0, self.duration))

    def scaled(self, share: float) -> "Course":
        return Course(self.duration, lambda t: share * self.sampled(t))

    def trajectory(self, name: str) -> Trajectory:
        def at(t: float) -> Reference:
            p, v, a, j = (tuple(row) for row in self.derivatives(np.array([t]))[:, 0].tolist())
            place = tuple(c + d for c, d in zip(PLACE, p))
            return Reference(place, v[:3], a[:3], j[:3], p[3], v[3])  # type: ignore[arg-type]

        return Trajectory(name, self.duration, at)


def chirp(duration: float, low: float = 0.5, high: float = 5.0) -> Course:
    """All four axes sweep linearly from low to high [Hz] with constant acceleration, a quarter of a cycle apart."""
    grid = np.arange(0.0, duration + 5e-4, 1e-3)
    rate = 2 * math.pi * (low + (high - low) * grid / duration)
    phase = 2 * math.pi * (low * grid + (high - low) * grid**2 / (2 * duration))
    weight = np.array([window(t, duration=duration, ramp=1.0)[0] for t in grid])
    rows = [weight * size / rate**2 * np.sin(phase + 0.5 * math.pi * i) for i, size in enumerate((1.0, 1.0, 0.5, 6.0))]
    splines = [make_interp_spline(grid, np.array(rows).T, k=5)]
    splines += [splines[0].derivative(k) for k in (1, 2, 3)]
    return Course(duration, lambda t: np.array([s(t) for s in splines]))


def of_trajectory(made: Trajectory) -> Course:
    """A trajectory about `PLACE` as a course."""

    def sampled(time: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = [made.at(float(t)) for t in time]
        place = [[*(a - b for a, b in zip(r.position, PLACE)), r.yaw] for r in rows]
        zero = [0.0] * len(rows)
        orders = [[[*r.velocity, r.yaw_rate] for r in rows], [[*r.acceleration, 0.0] for r in rows]]
        jerk = [[*r.jerk, z] for r, z in zip(rows, zero)]
        return np.array([place, *orders, jerk])

    return Course(made.duration, sampled)


def to_limits(course: Course, vehicle: Vehicle) -> Course:
    """The course scaled to the limits, by the model."""
    for _ in range(4):
        used = LIMITS.used(course, closed_loop.fly(course, vehicle), vehicle).max()  # type: ignore[arg-type]
        course = course.scaled(0.99 / float(used))
    return course


def manoeuvres(vehicle: Vehicle, folder: Path, *, seed: int) -> tuple[dict[str, Trajectory], dict[str, Harmonics]]:
    """All manoeuvres, and the plans among them, which are kept in the folder."""
    known = {}
    for kind, seconds in (("plan", DURATION), ("plan, a third of the time", DURATION / 3)):
        file = folder / f"{seconds:.0f}s.toml"
        if not file.exists():
            plan = plan_parameters(NAMES, vehicle, LIMITS, duration=seconds, seed=seed, starts=2)
            print(plan, flush=True)
            file.write_text(plan.to_toml())
        known[kind] = read_plan(file).manoeuvre
    made = {
        "figure 8": figure8(position=PLACE, duration=DURATION, size=(0.45, 0.25), period=4.0, ramp=2.0),
        "excite": excite(position=PLACE, duration=DURATION),
        "excite, scaled": to_limits(of_trajectory(excite(position=PLACE, duration=DURATION)), vehicle).trajectory("e"),
        "chirp": to_limits(chirp(DURATION), vehicle).trajectory("chirp"),
    }
    return made | {kind: plan.trajectory(PLACE, 0.0) for kind, plan in known.items()}, known


def world(seed: int) -> tuple[Scenario, dict[str, float]]:
    """A drone on a day, and the true values of the scored parameters."""
    random = np.random.default_rng([seed, 43])
    vehicle = load_vehicle("cf2")
    mass = vehicle.mass * float(random.uniform(*FACTORS["mass"]))
    inertia = [v * float(f) for v, f in zip(vehicle.inertia, random.uniform(*FACTORS["inertia"], 3))]
    inertia[2] = min(inertia[2], 0.98 * (inertia[0] + inertia[1]))
    table: dict[str, Any] = {
        "platform": "cf2",
        "vehicle": {"mass": mass, "inertia": inertia, "motor_time_constant": float(random.uniform(*LAGS))},
        **conditions.sensors(random, ()),
    }
    table["integration"]["step"] = 1e-3
    gains = conditions.GAINS["lee"]
    usual, told = parameters.defaults("cf2"), {}
    for names in gains.values():
        together = random.uniform(-conditions.GAIN, conditions.GAIN)
        for name in names:
            told[name] = usual[name] * float(1.0 + together + random.uniform(-conditions.EACH, conditions.EACH))
    drag = conditions.factor(random, conditions.DRAG)
    table["effects"] = {
        "linear_drag": {"x": drag, "y": drag, "z": 0.5 * drag},
        "gusts": {
            "standard_deviation": conditions.factor(random, conditions.DRAUGHT),
            "correlation_time": float(random.uniform(0.3, 2.0)),
        },
    }
    table["parameters"] = told
    return parse_scenario(table, "plan study"), dict(zip(NAMES, (mass, *inertia)))


def estimated(log: Log, vehicle: Vehicle) -> tuple[dict[str, Any], WindowEM]:
    """The estimate from the manoeuvre alone, and the estimator's window."""
    estimator = OnlineEstimator(
        vehicle, attitude_period=ATTITUDE_PERIOD, prediction_period=PERIOD, every=3000, window=2000
    )
    for sample in log.samples():
        if log.start + 2.0 <= sample.time <= log.end or sample.signal == "voltage":
            estimator.feed(sample)
    estimate, em = estimator.finish(), estimator._em
    assert em is not None
    said = {
        n: {"value": estimate[n].value, "sd": estimate[n].sd / estimate[n].value, "ok": estimate[n].identifiable,
            "ci": list(estimate[n].ci95)}
        for n in NAMES
    }  # fmt: skip
    return said, em


def flown(log: Log) -> dict[str, float]:
    """Largest distance from the hover point [m] and largest tilt [deg], by the onboard estimate."""
    far, tilt = np.zeros(3), 0.0
    for s in log.samples():
        if not log.start + 2.0 <= s.time <= log.end:
            continue
        if s.signal == "position":
            far = np.maximum(far, np.abs(np.array(s.value) - PLACE))
        elif s.signal == "attitude":
            x, y = s.value[:2]
            tilt = max(tilt, math.degrees(math.acos(min(1.0, max(-1.0, 1 - 2 * (x * x + y * y))))))
    return {"x": float(far[0]), "y": float(far[1]), "z": float(far[2]), "tilt": tilt}


def one_seed(seed: int, made: dict[str, Trajectory], plans: dict[str, Harmonics]) -> dict[str, Any]:
    """All manoeuvres on one drawn drone."""
    scenario, truth = world(seed)
    vehicle = load_vehicle("cf2")
    random = np.random.default_rng([seed, 44])
    # the mass of the controller after earlier pushes
    beliefs = {"ctrlLee.mass": truth["mass"] * float(1.0 + 0.003 * random.standard_normal())}
    out: dict[str, Any] = {"seed": seed, "truth": truth, "flights": {}}
    quiet = fly(scenario, 10 * seed, hover(position=PLACE, duration=8.0), beliefs=beliefs, correction=-2.0)
    said, em = estimated(quiet, vehicle)
    known = replace(vehicle, mass=said["mass"]["value"])
    expectation = Expectation(known, em.parameters.noise)
    usual = Expectation(vehicle)
    for count, (kind, trajectory) in enumerate(made.items()):
        try:
            log = fly(scenario, 10 * seed + 1 + count, trajectory, beliefs=beliefs, correction=-2.0)
        except RuntimeError as error:
            out["flights"][kind] = {"crashed": str(error)}
            continue
        said, _ = estimated(log, vehicle)
        out["flights"][kind] = {"said": said, **flown(log)}
        if kind in plans:
            for word, by in (("expected", expectation), ("expected_unknown_noise", usual)):
                out["flights"][kind][word] = dict(zip(NAMES, by.reached(plans[kind], seeds=3)[:4].tolist()))
    return out


def fly_all(seeds: int, first: int, folder: Path) -> None:
    """Fly the missing flights."""
    folder.mkdir(parents=True, exist_ok=True)
    begun = time.process_time()
    made, plans = manoeuvres(load_vehicle("cf2"), folder, seed=0)
    print(f"planned in {time.process_time() - begun:.1f} s of processor time", flush=True)
    for seed in range(first, first + seeds):
        file = folder / f"{seed}.json"
        if not file.exists():
            file.write_text(json.dumps(one_seed(seed, made, plans)))
            print(f"seed {seed}, {time.process_time() - begun:.1f} s of processor time", flush=True)


def report(folder: Path) -> str:
    """The tables as Markdown."""
    rows = [json.loads(f.read_text()) for f in sorted(folder.glob("*.json"), key=lambda f: int(f.stem))]
    lines = [f"n = {len(rows)} drawn drones", "", "| | Ixx | Iyy | Izz | mass | held | over excite | tilt | left box |",
             "|---|---|---|---|---|---|---|---|---|"]  # fmt: skip
    flights = {k: [r["flights"].get(k, {}) for r in rows] for k in KINDS}
    base = {n: np.array([f["said"][n]["sd"] for f in flights["excite"] if "said" in f]) for n in NAMES}
    for kind in KINDS:
        good = [(r, f) for r, f in zip(rows, flights[kind]) if "said" in f]
        if not good:
            continue
        sd = {n: np.array([f["said"][n]["sd"] for _, f in good]) for n in NAMES}
        held = [f["said"][n]["ci"][0] <= r["truth"][n] <= f["said"][n]["ci"][1] for r, f in good for n in NAMES]
        half = np.array(LIMITS.box) / 2
        left = sum(max(f[a] / h for a, h in zip("xyz", half)) > 1.1 for _, f in good)
        crashed = sum("crashed" in f for f in flights[kind])
        ratio = [float(np.median(base[n]) / np.median(sd[n])) for n in NAMES[1:]]
        widths = " | ".join(f"{196 * np.median(sd[n]):.2g} %" for n in (*NAMES[1:], "mass"))
        steepest = max(f["tilt"] for _, f in good)
        factor = float(np.exp(np.mean(np.log(ratio))))
        lines.append(
            f"| {kind} | {widths} | {100 * np.mean(held):.0f} % | {factor:.2g} | {steepest:.0f} deg "
            f"| {left}, crashed {crashed} |"
        )
    lines += ["", "| expected over reached | Ixx | Iyy | Izz | mass |", "|---|---|---|---|---|"]
    for kind in KINDS:
        for word in ("expected", "expected_unknown_noise"):
            good = [f for f in flights[kind] if word in f]
            if good:
                cells = []
                for n in (*NAMES[1:], "mass"):
                    ratio = np.array([f[word][n] / f["said"][n]["sd"] for f in good])
                    low, middle, high = np.quantile(ratio, (0.16, 0.5, 0.84))
                    cells.append(f"{middle:.2f} ({low:.2f} to {high:.2f})")
                lines.append(f"| {kind}, {word.replace('_', ' ')} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description="plans beside other manoeuvres")
    parser.add_argument("action", choices=("fly", "report"))
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/plan"))
    arguments = parser.parse_args()
    if arguments.action == "fly":
        fly_all(arguments.seeds, arguments.first, arguments.out)
    print(report(arguments.out))


if __name__ == "__main__":
    main()
