"""Intervals of mass and inertia over many simulated flights: how often they hold the truth, and on which side they err.

    python -m benchmarks.inertia_intervals fly --flights 216 --seed 1 --out out/intervals   # once; goes on
    python -m benchmarks.inertia_intervals score --out out/intervals --json intervals.json  # the estimator, any time

Flights: three vehicles, each hovering, in figure 8 and excited, quiet (no disturbance, exact poses) and noisy, rotor
lag 30 to 70 ms where the vehicle file says 50. They go through the wire format in one process (`wire_flight.py`), are
kept as log packets, and the estimator sees nothing else. A line is what is said once a second of firmware time. Truth
is here only.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.wire_flight import Log, fly
from crazyem.control.trajectories import Trajectory, excite, figure8, hover
from crazyem.estimation.in_step import PERIOD
from crazyem.estimation.online import ATTITUDE_PERIOD, OnlineEstimator
from crazyem.vehicle import load_vehicle
from firmware_sim.scenario import Scenario, parse_scenario

NAMES = ("mass", "Ixx", "Iyy", "Izz")
FILE_LAG = 0.05  # s, in the vehicle file
LAGS = (0.03, 0.07)  # s, range of the true lag
DURATION = 20.0  # s of trajectory
SETTLING = 1.0  # s of trajectory before the first line

# platform, mass [kg], inertia [kg m^2]: of a Crazyflie with a payload, a light one, and a brushless one
VEHICLES: dict[str, tuple[str, float, tuple[float, float, float]]] = {
    "payload": ("cf2", 0.034, (1.9e-5, 1.95e-5, 3.4e-5)),
    "light": ("cf2", 0.0262, (1.45e-5, 1.4e-5, 2.5e-5)),
    "brushless": ("cf21bl", 0.044, (2.75e-5, 2.65e-5, 3.7e-5)),
}
KINDS = ("hover", "figure8", "excite")
NOISES: dict[str, dict[str, dict[str, float]]] = {
    "noisy": {},
    "quiet": {
        "noise": {"thrust": 0.0, "torque": 0.0},
        "estimator": {"position_noise": 0.0, "attitude_noise": 0.0},
    },
}


@dataclass(frozen=True)
class Case:
    """One flight: which vehicle, trajectory and noise; its true lag [s]; the seed of its noise."""

    vehicle: str
    kind: str
    noise: str
    lag: float
    seed: int

    @property
    def file(self) -> str:
        """Name of its log."""
        return f"{self.vehicle}-{self.kind}-{self.noise}-{self.seed}.npz"

    def scenario(self) -> Scenario:
        """The scenario with the true values."""
        platform, mass, inertia = VEHICLES[self.vehicle]
        body = {"mass": mass, "inertia": list(inertia), "motor_time_constant": self.lag}
        return parse_scenario({"platform": platform, "vehicle": body, **NOISES[self.noise]}, "interval study")

    def trajectory(self) -> Trajectory:
        """The trajectory of the flight."""
        make = {"hover": hover, "figure8": figure8, "excite": excite}[self.kind]
        return make(position=(0.0, 0.0, 1.0), duration=DURATION)


def draw(flights: int, seed: int) -> list[Case]:
    """Cases that alternate over vehicles, trajectories and noises, with lags drawn uniformly."""
    cells = [(v, k, n) for v in VEHICLES for k in KINDS for n in NOISES]
    rng = np.random.default_rng(seed)
    lags = rng.uniform(*LAGS, flights)
    return [Case(*cells[i % len(cells)], float(lags[i]), 1000 * seed + i) for i in range(flights)]


def truth(case: Case) -> dict[str, float]:
    """True values of the scored parameters."""
    _, mass, inertia = VEHICLES[case.vehicle]
    return dict(zip(NAMES, (mass, *inertia)))


def fly_all(cases: Iterable[Case], folder: Path) -> None:
    """Fly the missing flights."""
    folder.mkdir(parents=True, exist_ok=True)
    for case in cases:
        if (folder / case.file).exists():
            continue
        values = truth(case)
        beliefs = {"ctrlLee.mass": values["mass"]}
        beliefs |= {f"ctrlLee.J_{axis}": values[f"I{axis}{axis}"] for axis in "xyz"}
        log = fly(case.scenario(), case.seed, case.trajectory(), beliefs=beliefs)
        log.save(folder / "part.npz")
        (folder / "part.npz").rename(folder / case.file)


def lines(case: Case, log: Log, *, every: int = 4) -> list[dict[str, Any]]:
    """Estimates, one for each second of the trajectory."""
    vehicle = replace(load_vehicle(VEHICLES[case.vehicle][0]), motor_time_constant=FILE_LAG)
    estimator = OnlineEstimator(vehicle, attitude_period=ATTITUDE_PERIOD, prediction_period=PERIOD, every=every)
    said: list[dict[str, Any]] = []
    due = log.start + SETTLING + 2.0
    values = truth(case)
    for sample in log.samples():
        if sample.time > log.end:
            break
        estimate = estimator.feed(sample)
        if estimate is None or estimate.time < due:
            continue
        due += 1.0
        for name in NAMES:
            p = estimate[name]
            if not (p.value > 0 and math.isfinite(p.sd)):
                continue
            said.append(
                {
                    "vehicle": case.vehicle, "kind": case.kind, "noise": case.noise, "seed": case.seed, "name": name,
                    "identifiable": p.identifiable, "sd": p.sd / p.value,
                    "held": p.ci95[0] <= values[name] <= p.ci95[1], "error": math.log(p.value / values[name]),
                    "t": round(estimate.time - log.start, 2),
                }
            )  # fmt: skip
    return said


def table(said: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Of identifiable estimates: share held, mean signed error in sd, its rms; median sd; share identifiable.

    The standard error of a share is over flights, because the lines of a flight are dependent.
    """
    good = [s for s in said if s["identifiable"]]
    if not good:
        return {"lines": len(said), "identifiable": 0.0}
    z = np.array([s["error"] / s["sd"] for s in good])
    flights: dict[int, list[bool]] = {}
    for s in good:
        flights.setdefault(s["seed"], []).append(s["held"])
    total = sum(map(len, flights.values()))
    share = sum(map(sum, flights.values())) / total
    spread = math.sqrt(sum((sum(h) - share * len(h)) ** 2 for h in flights.values())) / total
    return {
        "lines": len(said),
        "identifiable": len(good) / len(said),
        "held": share,
        "held_se": spread,
        "signed": float(z.mean()),
        "rms": float(np.sqrt(np.mean(z**2))),
        "sd": float(np.median([s["sd"] for s in good])),
        "error": float(np.mean([s["error"] for s in good])),
    }


def report(said: Sequence[Mapping[str, Any]], by: Sequence[str] = ("kind", "noise")) -> dict[str, Any]:
    """Print and return the tables: each parameter over all flights, and by `by`."""
    groups: dict[str, Any] = {}
    for name in NAMES:
        of_name = [s for s in said if s["name"] == name]
        groups[name] = table(of_name)
        for key in by:
            for value in sorted({s[key] for s in of_name}):
                groups[f"{name} {value}"] = table([s for s in of_name if s[key] == value])
    for kind in KINDS:
        groups[f"all {kind}"] = table([s for s in said if s["kind"] == kind])
    print(f"{'':<18}{'lines':>7}{'ident.':>8}{'held':>8}{'+-':>6}{'signed':>8}{'rms':>7}{'sd':>8}{'error':>8}")
    for name, g in groups.items():
        if "held" in g:
            print(
                f"{name:<18}{g['lines']:>7}{100 * g['identifiable']:>7.0f}%{100 * g['held']:>7.1f}%"
                f"{100 * g['held_se']:>5.1f}%{g['signed']:>+8.2f}{g['rms']:>7.2f}{100 * g['sd']:>7.2f}%"
                f"{100 * g['error']:>+7.2f}%"
            )
        else:
            print(f"{name:<18}{g['lines']:>7}{0:>7.0f}%")
    return groups


def main(argv: Sequence[str] | None = None) -> int:
    """Fly or score."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("fly", "score"))
    parser.add_argument("--flights", type=int, default=216, metavar="N", help="18 cells in turn (default: 216)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the draw (default: 1)")
    parser.add_argument("--out", type=Path, default=Path("out/intervals"), metavar="DIR", help="of the logs")
    parser.add_argument("--every", type=int, default=4, metavar="N", help="samples between updates (default: 4)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="tables, for programs")
    given = parser.parse_args(argv)
    cases, begun = draw(given.flights, given.seed), time.monotonic()
    if given.what == "fly":
        fly_all(cases, given.out)
        return 0
    said: list[dict[str, Any]] = []
    for case in cases:
        said += lines(case, Log.load(given.out / case.file), every=given.every)
    print(f"{given.flights} flights, seed {given.seed}, {time.monotonic() - begun:.0f} s")
    groups = report(said)
    if given.json:
        given.json.write_text(json.dumps({"flights": given.flights, "seed": given.seed, "tables": groups}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
