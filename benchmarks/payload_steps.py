"""Payloads attached and released in hover: how soon the estimator has the new mass, and how soon the controller has it.

    python -m benchmarks.payload_steps run --seeds 20 --out out/steps              # goes on where it was stopped
    python -m benchmarks.payload_steps run --out out/steps --minutes 3             # a piece of it
    python -m benchmarks.payload_steps score --out out/steps --docs               # docs: payload_steps.md, .json, .png

The simulated firmware's plant and Lee controller, its log values rounded as its packets round them, the estimator and
the guard of `crazyem fly`; no sockets and no clock, so a seed always gives the same flight.
"""

import argparse
import json
import math
import random
import struct
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from crazyem.control.trajectories import Trajectory, after_hover, excite, figure8, hover
from crazyem.estimation.online import OnlineEstimator
from crazyem.estimation.steps import StepAwareEstimator
from crazyem.live.controllers import LEE
from crazyem.live.guard import Decision, Guard
from crazyem.live.history import History, Push
from crazyem.live.pipeline import Pipeline
from crazyem.live.policy import WriteRules, load_policy
from crazyem.live.telemetry import CAN_FLY, FLYING, Telemetry
from crazyem.live.write_gate import WriteGate
from crazyem.live.write_supervisor import WriteSupervisor
from crazyem.signals.sample import Block, Packet, Sample, Variable
from crazyem.signals.vocabulary import STATE_VARIABLES, decoders
from crazyem.vehicle import load_vehicle
from firmware_sim.commander import setpoint as sp
from firmware_sim.flight import Flight
from firmware_sim.scenario import parse_scenario

DOCS = Path(__file__).resolve().parents[1] / "docs" / "results"
MASS = 0.029  # kg, of the bare drone
HEIGHT, RISE = 1.0, 2.0  # m, s
EVENT, AFTER = 10.0, 4.0  # s: the event after boot; flight after the event
PUSH_FROM = RISE + 1.5  # s
MARKS = ("<!-- steps: tables -->", "<!-- /steps -->")
WITHIN = 0.02  # of the mass: the aim, one second after the event
MOTORS = (*(f"motor.m{i}" for i in range(1, 5)), "pm.vbatMV")
SETPOINT = tuple(f"ctrltargetZ.{a}" for a in "xyz")
TYPES = {"motor": "uint16_t", "pm": "uint16_t", "stateEstimateZ": "int16_t", "ctrltargetZ": "int16_t"}
FORMS = {"uint16_t": "<H", "int16_t": "<h", "uint32_t": "<I"}
SIZES = (0.03, 0.05, 0.1, 0.2)  # of the bare mass
CALM = ("hover", "figure8", "excite", "gusts 0.5", "gusts 1.0")


@dataclass(frozen=True)
class Case:
    """A case: `kind` attach or release with a share `size` of the bare mass, or one of CALM."""

    kind: str
    size: float = 0.0

    @property
    def name(self) -> str:
        """Name in the table."""
        return f"{self.kind} {100 * self.size:.0f} %" if self.size else self.kind

    @property
    def before(self) -> float:
        """Mass before the event [kg]."""
        return MASS * (1.0 + self.size) if self.kind == "release" else MASS

    @property
    def after(self) -> float:
        """Mass after the event [kg]."""
        return MASS * (1.0 + self.size) if self.kind.endswith("attach") else MASS

    def scenario(self, r: random.Random) -> dict[str, Any]:
        """The simulator's scenario; place and time of the payload are drawn."""
        place = (r.uniform(-0.003, 0.003), r.uniform(-0.003, 0.003), r.uniform(-0.025, 0.01))
        when = EVENT + r.uniform(0.0, 0.1)
        table: dict[str, Any] = {"vehicle": {"mass": MASS}}
        if self.kind.endswith("attach"):
            event = {"action": "attach", "time": when, "mass": self.size * MASS, "position": list(place)}
            table["payload"] = {"events": [event]}
        elif self.kind == "release":
            table["effects"] = {"payload": {"mass": self.size * MASS, **dict(zip("xyz", place))}}
            table["payload"] = {"events": [{"action": "release", "time": when}]}
        elif self.kind.startswith("gusts"):
            gusts = {"standard_deviation": float(self.kind.split()[1]), "correlation_time": 0.5}
            table["effects"] = {"gusts": gusts}
        return table

    def trajectory(self) -> Trajectory:
        """The trajectory after the take-off."""
        make: Any = {"figure8": figure8, "excite": excite}.get(self.kind, hover)
        path = make(position=(0.0, 0.0, HEIGHT), duration=EVENT + AFTER - RISE - 1.0)
        return after_hover(path, seconds=1.0)


UNAWARE = (Case("unaware attach", 0.1),)  # the estimator alone, for comparison
CASES = [Case(kind, size) for size in SIZES for kind in ("attach", "release")] + [Case(kind) for kind in CALM]


class Drone:
    """The simulated flight under Lee, its log blocks as packets of the session."""

    def __init__(self, case: Case, seed: int) -> None:
        r = random.Random(f"payload {case.name} {seed}")
        scenario = parse_scenario(case.scenario(r), case.name)
        self.flight = Flight(scenario, seed)
        self.write("stabilizer.controller", 5.0)
        self.write("ctrlLee.mass", case.before)  # the value pushed before the event
        self.path = case.trajectory()
        self.blocks = [
            Block(n, tuple(Variable(v, _type(v)) for v in names), 10)
            for n, names in enumerate((STATE_VARIABLES, MOTORS, SETPOINT))
        ]
        self._phase = [r.randrange(10) for _ in self.blocks]
        self._decoders = decoders(self.blocks)
        self.flight.setpoint[[sp.MODE_X, sp.MODE_Y, sp.MODE_Z, sp.MODE_QUAT]] = sp.ABSOLUTE
        self.event = math.nan

    def write(self, name: str, value: float) -> None:
        """A parameter, as the firmware keeps it: single precision."""
        array, index = self.flight.param[name]
        array[index] = float(np.float32(value))
        self.flight.parameter_written(name)

    def read(self, name: str) -> float:
        """A parameter."""
        array, index = self.flight.param[name]
        return float(array[index])

    def fly(self, seconds: float) -> Iterator[list[Any]]:
        """Samples of each packet; setpoints every 7 ms, as a session sends them."""
        for tick in range(round(1000 * seconds)):
            if tick % 7 == 0:
                self._steer(1e-3 * tick)
            mass = self.flight._truth[0]
            self.flight.step()
            if self.flight._truth[0] != mass:
                self.event = 1e-3 * tick
            for block, phase in zip(self.blocks, self._phase):
                if tick % 10 == phase:
                    values = tuple(self._logged(v) for v in block.variables)
                    yield self._decoders[block.identifier].decode(Packet(block.identifier, tick + 1, 0.0, values))

    def _steer(self, t: float) -> None:
        s = self.flight.setpoint
        if t < RISE:
            part = t / RISE
            s[sp.X : sp.Z + 1] = (0.0, 0.0, HEIGHT * (3 - 2 * part) * part * part)
            return
        r = self.path.at(t - RISE)
        s[sp.X : sp.AZ + 1] = (*r.position, *r.velocity, *r.acceleration)
        s[sp.QX : sp.QW + 1] = r.quaternion

    def _logged(self, variable: Variable) -> float:
        array, index = self.flight.log[variable.name]
        form = FORMS[variable.ctype]
        value = int(array[index])
        low, high = (0, 2 ** (8 * struct.calcsize(form)) - 1) if form.isupper() else (-32768, 32767)
        return float(min(max(value, low), high))


def _type(name: str) -> str:
    return "uint32_t" if name.endswith("quat") else TYPES[name.split(".", maxsplit=1)[0]]


class Now:
    """A pusher without thread and link, which writes decisions at once."""

    def __init__(self, drone: Drone, write_supervisor: WriteSupervisor, history: History) -> None:
        self.drone, self.write_supervisor, self.history = drone, write_supervisor, history
        self.known = {p: drone.read(p) for p in LEE.parameters}
        self.busy = False
        self.masses: list[tuple[float, float]] = []

    def submit(self, decision: Decision) -> None:
        """Write all values of a decision."""
        for name, value in decision.writes:
            self.drone.write(name, value)
            self.known[name] = value
            self.history.pushes.append(Push(decision.time, name, value, True, decision.kind))
            if name == LEE.mass:
                self.masses.append((decision.time, value))
        self.write_supervisor.on_written(decision, "")


def fly(case: Case, seed: int, *, aware: bool = True, push: bool = True) -> dict[str, Any]:
    """One flight; errors of the mass in estimator and controller over time."""
    drone, vehicle, history = Drone(case, seed), load_vehicle("cf2"), History()
    inner = OnlineEstimator(vehicle)
    estimator: Any = StepAwareEstimator(inner) if aware else inner
    newest, policy = [0.0], load_policy()
    gate = WriteGate(Telemetry(info=FLYING | CAN_FLY, heard=0.0), policy.health, now=lambda: 0.0)
    gate.telemetry.take(Sample("position", 0.0, (0.0, 0.0, 1.0)))  # the flight starts in the air
    originals = {p: drone.read(p) for p in LEE.parameters}
    nominal = dict(zip(("mass", "Ixx", "Iyy", "Izz"), (vehicle.mass, *vehicle.inertia)))
    write_supervisor = WriteSupervisor(
        Guard(LEE, nominal=nominal, originals=originals, limits=policy.limits),
        WriteRules(policy),
        originals=originals,
        history=history,
        gate=gate,
        now=lambda: newest[0],
        residual=lambda: inner.residual,
    )
    pusher: Any = Now(drone, write_supervisor, history)
    write_supervisor.pusher = pusher
    pipeline = Pipeline(estimator, history=history, guard=write_supervisor if push else None, push=pusher.submit)
    pipeline.push_from = PUSH_FROM
    heights = []
    begun = time.process_time()
    for samples in drone.fly(EVENT + AFTER):
        for sample in samples:
            newest[0] = sample.time
            if push:
                write_supervisor.take([sample])
            pipeline.sample(sample)
        heights.append((newest[0], float(drone.flight.state[2])))
    steps = getattr(estimator, "steps", [])
    rows = [(e.time, e["mass"].value, e["mass"].ci95) for e in history.estimates]
    result: dict[str, Any] = {
        "case": case.name, "seed": seed, "seconds": time.process_time() - begun,
        "steps": [(s.time, s.found, s.before, s.after, s.real) for s in steps],
        "called_real": sum(s.real is True for s in steps),
        "reverts": sum(p.purpose == "revert" for p in history.pushes),
        "stopped": write_supervisor.guard.stopped,
        "writes": len(history.pushes),
    }  # fmt: skip
    if case.size:
        t0 = drone.event
        result["event"] = t0
        result["found"] = next((s.found - t0 for s in steps if s.found > t0 and s.real is not False), None)
        result.update(_errors(rows, t0, case.after))
        result["in_controller"] = _settled(pusher.masses, t0, case.after)
        apart = [abs(h - HEIGHT) for t, h in heights if t > t0]
        result["furthest_m"] = max(apart)
        result["left_m"] = max(apart[-100:])
        result["curve"] = [(round(t - t0, 3), round(m / case.after - 1, 5)) for t, m, _ in rows if -1 < t - t0 < 4]
    else:
        late = [abs(m / MASS - 1) for t, m, _ in rows if t > 6.0]
        result["worst"] = max(late)
    return result


def _errors(rows: Sequence[tuple[float, float, Any]], t0: float, mass: float) -> dict[str, Any]:
    """Error one second after t0, largest later error, time until it stays small, and whether intervals hold."""
    later = [(t - t0, m / mass - 1, ci) for t, m, ci in rows if t >= t0]
    out = [t for t, e, _ in later if abs(e) > WITHIN]
    from_one = [(t, e, ci) for t, e, ci in later if t >= 1.0]
    return {
        "error_1s": next((e for t, e, _ in from_one), None),
        "worst_after_1s": max((abs(e) for _, e, _ in from_one), default=None),
        "within": max(out, default=0.0),
        "covered": float(np.mean([ci[0] <= mass <= ci[1] for _, _, ci in from_one])),
    }


def _settled(masses: Sequence[tuple[float, float]], t0: float, mass: float) -> float | None:
    """Time after the event [s] from which the controller's mass stays within the aim; None if never."""
    if not masses or abs(masses[-1][1] / mass - 1) > WITHIN:
        return None
    wrong = [k for k, (_, m) in enumerate(masses) if abs(m / mass - 1) > WITHIN]
    first = masses[wrong[-1] + 1 if wrong else 0][0]
    return max(first - t0, 0.0)


# the study ---------------------------------------------------------------------------------------------------------


def run(folder: Path, *, seeds: int, minutes: float) -> None:
    """Fly the missing flights; one line of flights.jsonl for each."""
    folder.mkdir(parents=True, exist_ok=True)
    path, until = folder / "flights.jsonl", time.monotonic() + 60.0 * minutes
    done = {(r["case"], r["seed"]) for r in read(path)}
    with path.open("a", encoding="utf-8") as file:
        for seed in range(seeds):
            for case in (*CASES, *(UNAWARE if seed < 5 else ())):
                if (case.name, seed) in done:
                    continue
                if time.monotonic() > until:
                    return
                result = fly(case, seed, aware=case not in UNAWARE)
                file.write(json.dumps(result) + "\n")
                file.flush()
                print(f"{case.name}, seed {seed}: {result.get('error_1s', result.get('worst')):.4f}", flush=True)


def read(path: Path) -> list[dict[str, Any]]:
    """The flights of a file without an incomplete last line."""
    found = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            found.append(json.loads(line))
        except ValueError:
            continue
    return found


def score(flights: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The results, one row for each case."""
    table: dict[str, Any] = {}
    for case in (*CASES, *UNAWARE):
        rows = [r for r in flights if r["case"] == case.name]
        if not rows:
            continue
        row: dict[str, Any] = {"flights": len(rows), "reverts": sum(r["reverts"] for r in rows)}
        if case.size:
            row["found"] = sum(r["found"] is not None for r in rows)
            row["found_s"] = spread([r["found"] for r in rows if r["found"] is not None])
            row["within_aim_at_1s"] = sum(r["worst_after_1s"] <= WITHIN for r in rows)
            row["worst_after_1s"] = spread([r["worst_after_1s"] for r in rows])
            row["within_s"] = spread([r["within"] for r in rows])
            row["in_controller"] = sum(r["in_controller"] is not None for r in rows)
            row["in_controller_s"] = spread([r["in_controller"] for r in rows if r["in_controller"] is not None])
            row["furthest_m"] = spread([r["furthest_m"] for r in rows])
            row["false_steps"] = sum(max(r["called_real"] - 1, 0) for r in rows)
        else:
            row["noticed"] = sum(len(r["steps"]) for r in rows)
            row["false_steps"] = sum(r["called_real"] for r in rows)
            row["worst_mass_error"] = spread([r["worst"] for r in rows])
        table[case.name] = row
    return table


def spread(values: Sequence[float]) -> list[float | None]:
    """Median and largest."""
    if not values:
        return [None, None]
    return [round(float(np.median(values)), 4), round(float(max(values)), 4)]


def _seconds(pair: Sequence[float | None]) -> str:
    return "-" if pair[0] is None else f"{pair[0]:.2f}, {pair[1]:.2f}"


def tables(table: Mapping[str, Any]) -> str:
    """The two tables of the page."""
    lines = [
        "| case | flights | found | found after, s | mass within 2 % from 1 s on | in the controller after, s "
        "| furthest from the setpoint, m |",
        "|---|---|---|---|---|---|---|",
    ]
    for case in (*CASES, *UNAWARE):
        row = table.get(case.name)
        if row and case.size:
            missing = row["flights"] - row["in_controller"]
            controller = _seconds(row["in_controller_s"]) + (f" ({missing} not within {AFTER:g} s)" if missing else "")
            lines.append(
                f"| {case.name} | {row['flights']} | {row['found']} | {_seconds(row['found_s'])} "
                f"| {row['within_aim_at_1s']} of {row['flights']} | {controller} | {_seconds(row['furthest_m'])} |"
            )
    lines += ["", "| without a step | flights | noticed | taken for a step | largest error of the mass, % |"]
    lines.append("|---|---|---|---|---|")
    for case in CASES:
        row = table.get(case.name)
        if row and not case.size:
            error = "{:.2f}, {:.2f}".format(*(100 * x for x in row["worst_mass_error"]))
            lines.append(f"| {case.name} | {row['flights']} | {row['noticed']} | {row['false_steps']} | {error} |")
    return "\n".join(lines)


def plot(flights: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Plot the error of the mass around the event, one line for each flight."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 7), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    for axis, size in zip(axes, SIZES):
        for kind, colour in (("attach", "C0"), ("release", "C1"), ("unaware attach", "0.6")):
            rows = [r for r in flights if r["case"] == f"{kind} {100 * size:.0f} %"]
            for n, r in enumerate(rows):
                t, e = np.array(r["curve"]).T
                axis.plot(t, 100 * e, colour, linewidth=0.6, label=f"{kind}, {len(rows)} flights" if n == 0 else None)
        axis.axhspan(-100 * WITHIN, 100 * WITHIN, color="C2", alpha=0.15)
        axis.axvline(1.0, color="k", linewidth=0.6, linestyle=":")
        axis.set(title=f"{100 * size:.0f} % of the bare mass", xlim=(-0.5, 3.5), ylim=(-22, 22))
        axis.legend(fontsize=7)
    figure.supxlabel("s after the payload came or went")
    figure.supylabel("error of the estimated mass, % (green: the aim)")
    figure.savefig(path, dpi=110)


def write_docs(flights: Sequence[Mapping[str, Any]], table: Mapping[str, Any]) -> None:
    """Write tables, figures and plot of docs/results/payload_steps.md."""
    page = DOCS / "payload_steps.md"
    head, rest = page.read_text(encoding="utf-8").split(MARKS[0])
    tail = rest.split(MARKS[1])[1]
    page.write_text(f"{head}{MARKS[0]}\n\n{tables(table)}\n\n{MARKS[1]}{tail}", encoding="utf-8")
    (DOCS / "payload_steps.json").write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    plot(flights, DOCS / "payload_steps.png")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.payload_steps", description=__doc__)
    parser.add_argument("step", choices=("run", "score"))
    parser.add_argument("--out", type=Path, required=True, help="folder of the study")
    parser.add_argument("--seeds", type=int, default=20, help="flights of each case (default %(default)s)")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after that; run again to go on")
    parser.add_argument("--docs", action="store_true", help="write docs/results/payload_steps.md, .json and .png")
    a = parser.parse_args(argv)
    if a.step == "run":
        run(a.out, seeds=a.seeds, minutes=a.minutes)
    flights = read(a.out / "flights.jsonl")
    table = score(flights)
    print(json.dumps(table, indent=1))
    if a.docs:
        write_docs(flights, table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
