"""What pushing INDI's effectiveness, the filter's drag and Mellinger's massThrust does, in random worlds with payloads.

    python -m benchmarks.controller_parameters fly --seeds 200 --out out/controllers.jsonl   # goes on where it stopped
    python -m benchmarks.controller_parameters table --out out/controllers.jsonl [--docs]

A seed is nine flights (20 s of processor time): INDI with the true g1, with 0.5 and 1.5 times the true one and the
guard; INDI with an estimate of inertia that is wrong by a drawn factor and certain of it, with the guard and without;
figure 8 at 1.5 m/s under Lee with and without kalman.dragB_* pushed; Mellinger on a brushless drone, whose
massThrust is 1.61 times what it should be, with and without pushing. Judged by the simulator's truth.
"""

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.indi_flight import GuardedFlight, scaled
from crazyem.control.command_units import effectiveness_torque, lag_share
from crazyem.control.indi import IndiGains
from crazyem.control.trajectories import Reference, Trajectory, excite, figure8, hover
from crazyem.vehicle import GRAVITY, Vehicle, load_vehicle
from firmware_sim.plant import layout as at
from firmware_sim.scenario import Scenario, parse_scenario

MELLINGER, INDI, LEE = 2, 3, 5  # stabilizer.controller
AXES = "pqr"
EXCITED, REST, STEP, AFTER = 4.0, 1.0, 0.5, 2.0  # s, s, m, s: excitation, hover, step of the place, hover
STEP_TILT = math.atan(IndiGains().place[0] * IndiGains().velocity[0] * STEP / GRAVITY)  # rad, wanted at the step
WITHIN = 0.05  # of the true g1
SPEED = 1.5  # m/s, the highest of the figure
MARKS = ("<!-- controllers: table -->", "<!-- /controllers -->")
DOCS = Path(__file__).resolve().parents[1] / "docs" / "results" / "controller_parameters.md"


class Excitation(NamedTuple):
    """rms accelerations [m/s^2, m/s^2, rad/s^2], ramp [s], and posCtrlIndi.pq_clamping [deg]."""

    lateral: float
    vertical: float
    angular: float
    ramp: float
    tilt_limit: float


STRONG = Excitation(lateral=1.25, vertical=0.0, angular=5.5, ramp=0.25, tilt_limit=25.0)
USUAL = Excitation(lateral=0.9, vertical=0.5, angular=9.0, ramp=0.5, tilt_limit=10.0)  # twice that of `crazyem fly`


@dataclass(frozen=True)
class World:
    """World of a seed, SI. `inertia_factor`: estimated over true inertia in the flights with a wrong estimate."""

    mass: float
    inertia: tuple[float, float, float]
    lag: float
    payload: float
    place: tuple[float, float, float]
    drag: tuple[float, float]
    inertia_factor: float

    def table(self, platform: str = "cf2") -> dict[str, Any]:
        """The scenario's keys."""
        payload = {"mass": self.payload, "x": self.place[0], "y": self.place[1], "z": self.place[2]}
        scale = 1.35 if platform == "cf21bl" else 1.0
        body = {
            "mass": scale * self.mass,
            "inertia": [scale * j for j in self.inertia],
            "motor_time_constant": self.lag,
        }
        return {"platform": platform, "vehicle": body, "effects": {"payload": payload}}


def draw(seed: int) -> World:
    """The world of a seed."""
    r = np.random.default_rng([seed, 44])
    spread = np.exp(r.normal(0.0, 0.08, 3)) * math.exp(r.normal(0.0, 0.1))
    inertia = np.array([1.657e-5, 1.666e-5, 2.926e-5]) * spread
    inertia[2] = min(inertia[2], 0.97 * (inertia[0] + inertia[1]))
    return World(
        mass=0.029 * r.uniform(0.95, 1.08),
        inertia=(float(inertia[0]), float(inertia[1]), float(inertia[2])),
        lag=r.uniform(0.035, 0.065),
        payload=r.uniform(0.001, 0.006),
        place=(r.uniform(-0.004, 0.004), r.uniform(-0.004, 0.004), r.uniform(-0.02, 0.01)),
        drag=(r.uniform(0.006, 0.018), r.uniform(0.006, 0.018)),
        inertia_factor=math.exp(r.choice((-1, 1)) * r.uniform(math.log(1.4), math.log(5.0))),
    )


def true_effectiveness(scenario: Scenario, vehicle: Vehicle) -> tuple[float, ...]:
    """g1 of the body with its payload [rad/s^2 a unit]."""
    inertia = scenario.truth()[at.INERTIA : at.INERTIA + 9 : 4]
    return tuple(t / float(j) for t, j in zip(effectiveness_torque(vehicle), inertia))


def excite_and_step(e: Excitation) -> Trajectory:
    """Excitation, hover, then a step of the position by half a metre along x."""
    shaken = excite(
        position=(0.0, 0.0, 1.0), duration=EXCITED, lateral=e.lateral, vertical=e.vertical, angular=e.angular,
        ramp=e.ramp,
    )  # fmt: skip

    def at_time(t: float) -> Reference:
        if t < EXCITED:
            return shaken.at(t)
        return Reference((0.0 if t < EXCITED + REST else STEP, 0.0, 1.0))

    return Trajectory("excite and step", EXCITED + REST + AFTER, at_time)


def pitch(row: Sequence[float]) -> float:
    """Pitch [rad] of a row of `GuardedFlight.rows`."""
    w, x, y, z = row[7:11]
    return math.asin(max(-1.0, min(1.0, 2.0 * (w * y - x * z))))


def overshoot(flight: GuardedFlight) -> float:
    """Overshoot of the pitch after a step of the position, relative to the wanted one; NaN after a crash."""
    begun = EXCITED + REST
    seen = [pitch(row) for row in flight.rows if begun <= row[0] <= begun + 0.6]
    return max(seen) / STEP_TILT - 1.0 if seen and not flight.crashed else math.nan


def indi(
    seed: int, start: float, *, push: bool = True, inertia_factor: float | None = None, guard: bool = True
) -> dict[str, Any]:
    """Result of one flight of INDI whose g1 at take-off is `start` times the true one."""
    excitation = STRONG if inertia_factor is None else USUAL
    world, vehicle = draw(seed), load_vehicle("cf2")
    scenario = parse_scenario(world.table(), f"seed {seed}")
    true = true_effectiveness(scenario, vehicle)
    boot = {f"ctrlINDI.g1_{a}": start * g for a, g in zip(AXES, true)} | {
        "posCtrlIndi.pq_clamping": excitation.tilt_limit
    }
    if not push:
        boot |= {f"ctrlINDI.act_dyn_{a}": lag_share(world.lag) for a in AXES}
    tamper = None if inertia_factor is None else lambda e: scaled(e, ("Ixx", "Iyy", "Izz"), inertia_factor)
    flight = GuardedFlight(scenario, seed, vehicle, INDI, boot, push=push and guard, tamper=tamper)
    errors: list[tuple[float, float]] = []  # s, largest error of the three
    at_once: list[float] = []

    def look(f: GuardedFlight) -> None:
        if inertia_factor is not None and not guard and not at_once and f.seconds > 1.0:
            at_once.append(f.seconds)
            for a, g in zip(AXES, true):
                f.client.set(f"ctrlINDI.g1_{a}", g / inertia_factor)
        errors.append((f.seconds, max(abs(f.read(f"ctrlINDI.g1_{a}") / g - 1.0) for a, g in zip(AXES, true))))

    flight.fly(excite_and_step(excitation), each=look, push_for=EXCITED + 0.9 * REST)
    far = [t for t, error in errors if error > WITHIN]
    return {
        "crashed": flight.crashed,
        "reverted": flight.reverted,
        "writes": len(flight.writes),
        "within_s": max(far, default=-math.inf) if far and far[-1] < errors[-1][0] - 0.1 else (None if far else 0.0),
        "error_2s": next((e for t, e in errors if t >= 2.0), None),
        "error": errors[-1][1],
        "worst_error": max(e for _, e in errors),
        "overshoot": overshoot(flight),
        "oscillation": float(np.sqrt(np.mean([np.square(r[11:13]).sum() for r in flight.rows[-150:]]))),
    }


def onboard_drag(seed: int, *, push: bool) -> dict[str, Any]:
    """Figure 8 at 1.5 m/s under Lee: rms error of the onboard velocity along x and y in the last 10 s."""
    world, vehicle = draw(seed), load_vehicle("cf2")
    table = world.table()
    table["effects"]["linear_drag"] = {"x": world.drag[0], "y": world.drag[1], "z": 0.0}
    mass = world.mass + world.payload
    period = 2.0 * math.pi * math.hypot(1.0, 1.0) / SPEED  # speed at the crossing: 2 pi/T sqrt(sx^2 + (2 sy)^2)
    flight = GuardedFlight(parse_scenario(table, f"seed {seed}"), seed, vehicle, LEE, {"ctrlLee.mass": mass}, push=push)
    path = figure8(position=(0.0, 0.0, 1.0), duration=25.0, size=(1.0, 0.5), period=period)
    flight.fly(path)
    late = [r for r in flight.rows if r[0] >= path.duration - 12.0 and r[0] <= path.duration - 2.0]
    errors = [(r[14] - r[4], r[15] - r[5]) for r in late]
    found = [flight.read(f"kalman.dragB_{a}") for a in "xy"]
    return {
        "crashed": flight.crashed,
        "reverted": flight.reverted,
        "error_m_s": float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1)))),
        "speed_m_s": float(max(math.hypot(r[4], r[5]) for r in flight.rows)),
        "found": [f * mass / d - 1.0 for f, d in zip(found, world.drag)] if push else None,
    }


def mass_thrust(seed: int, *, push: bool) -> dict[str, Any]:
    """Mellinger on a brushless drone that knows its mass: mean height error of the last 3 s of 20 s of hover."""
    world, vehicle = draw(seed), load_vehicle("cf21bl")
    scenario = parse_scenario(world.table("cf21bl"), f"seed {seed}")
    mass = float(scenario.truth()[at.MASS])
    flight = GuardedFlight(scenario, seed, vehicle, MELLINGER, {"ctrlMel.mass": mass}, push=push)
    flight.fly(hover(position=(0.0, 0.0, 1.0), duration=20.0))
    return {
        "crashed": flight.crashed,
        "reverted": flight.reverted,
        "height_m": float(np.mean([r[3] for r in flight.rows if r[0] > 17.0]) - 1.0),
        "first_m": float(np.mean([r[3] for r in flight.rows if -0.5 < r[0] < 0.0]) - 1.0),
        "mass_error": flight.read("ctrlMel.mass") / mass - 1.0,
        "mass_thrust": flight.read("ctrlMel.massThrust"),
    }


def flights(seed: int) -> dict[str, Callable[[], dict[str, Any]]]:
    """Name -> flight."""
    inertia_factor = draw(seed).inertia_factor
    return {
        "ideal": lambda: indi(seed, 1.0, push=False),
        "low": lambda: indi(seed, 0.5),
        "high": lambda: indi(seed, 1.5),
        "wrong inertia guarded": lambda: indi(seed, 1.0, inertia_factor=inertia_factor),
        "wrong inertia unguarded": lambda: indi(seed, 1.0, inertia_factor=inertia_factor, guard=False),
        "drag": lambda: onboard_drag(seed, push=True),
        "no drag": lambda: onboard_drag(seed, push=False),
        "massThrust": lambda: mass_thrust(seed, push=True),
        "no massThrust": lambda: mass_thrust(seed, push=False),
    }


def load(path: Path) -> dict[int, dict[str, Any]]:
    """Seed -> name -> result of the finished flights."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    done: dict[int, dict[str, Any]] = {}
    for line in lines:
        entry = json.loads(line)
        done.setdefault(entry["seed"], {})[entry["flight"]] = entry["result"]
    return done


def fly_all(seeds: Sequence[int], path: Path, only: Sequence[str]) -> None:
    """Fly the missing flights; writes one line for each."""
    done = load(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        for name, flight in flights(seed).items():
            if name in done.get(seed, {}) or (only and name not in only):
                continue
            entry = {"seed": seed, "flight": name, "result": flight()}
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")
            print(json.dumps(entry), flush=True)


def table(done: dict[int, dict[str, Any]]) -> str:
    """Markdown: aims and results."""

    def of(name: str, key: str) -> list[float]:
        values = [r[name][key] for r in done.values() if name in r]
        return [math.nan if v is None else float(v) for v in values]

    def said(values: Sequence[float], unit: str, scale: float = 1.0) -> str:
        v = np.array([x for x in values if math.isfinite(x)]) * scale
        return f"{np.median(v):.2f} ({np.quantile(v, 0.1):.2f} to {np.quantile(v, 0.9):.2f}) {unit}" if v.size else "-"

    def row(what: str, result: str, met: str, hits: Sequence[bool]) -> str:
        return f"|{what}|{result}|{met} {sum(hits)}/{len(hits)}|"

    lines = ["|flights|median (10 to 90 %)|met|", "|---|---|---|"]
    for name, start in (("low", 0.5), ("high", 1.5)):
        within, error, what = of(name, "within_s"), of(name, "error_2s"), f"INDI, g1 × {start}:"
        lines.append(row(f"{what} 5 % reached", said(within, "s"), "2 s", [w <= 2.0 for w in within]))
        lines.append(row(f"{what} error at 2 s", said(error, "%", 100), "5 %", [e <= WITHIN for e in error]))
        both = [r[name]["overshoot"] - r["ideal"]["overshoot"] for r in done.values() if {name, "ideal"} <= set(r)]
        lines.append(row(f"{what} overshoot less ideal", said(both, "%", 100), "10 %", [abs(b) <= 0.1 for b in both]))
    for name in ("low", "high", "wrong inertia unguarded", "wrong inertia guarded"):
        worst = said(of(name, "worst_error"), "%", 100)
        lines.append(row(f"INDI, {name}: worst g1", worst, "crashed", [bool(c) for c in of(name, "crashed")]))
    for name in ("no drag", "drag"):
        lines.append(row(f"{name} pushed: velocity error", said(of(name, "error_m_s"), "cm/s", 100), "crashed",
                         [bool(c) for c in of(name, "crashed")]))  # fmt: skip
    pairs = [r for r in done.values() if {"drag", "no drag"} <= set(r)]
    falls = [1 - r["drag"]["error_m_s"] / r["no drag"]["error_m_s"] for r in pairs]
    lines.append(row("the error falls by", said(falls, "%", 100), "a third", [f >= 1 / 3 for f in falls]))
    for name in ("no massThrust", "massThrust"):
        height = of(name, "height_m")
        lines.append(row(f"{name} pushed: height", said(height, "cm", 100), "2 cm", [abs(h) < 0.02 for h in height]))
    masses = [abs(m) <= 0.01 for m in of("massThrust", "mass_error")]
    lines.append(row("the same: mass error", said(of("massThrust", "mass_error"), "%", 100), "1 %", masses))
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Fly, or make the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("fly", "table"))
    parser.add_argument("--seeds", type=int, default=200, metavar="N", help="how many (default: 200)")
    parser.add_argument("--first", type=int, default=1, metavar="SEED", help="the first (default: 1)")
    parser.add_argument("--only", nargs="+", default=[], metavar="FLIGHT", help="these flights of a seed")
    parser.add_argument("--out", type=Path, default=Path("out/controllers.jsonl"), metavar="FILE", help="results")
    parser.add_argument("--docs", action="store_true", help="write the table into docs/controller_parameters.md")
    given = parser.parse_args(argv)
    if given.what == "fly":
        fly_all(range(given.first, given.first + given.seeds), given.out, given.only)
        return 0
    text = table(load(given.out))
    print(text)
    if given.docs:
        head, rest = DOCS.read_text(encoding="utf-8").split(MARKS[0])
        DOCS.write_text(f"{head}{MARKS[0]}\n\n{text}\n\n{MARKS[1]}{rest.split(MARKS[1])[1]}", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
