"""One flight of a script with an attachment that pushes, in one process and on the drone's own clock.

    python -m benchmarks.attached_flight --flights 200 --out out/attached.json [--docs]

A pilot flies the simulated firmware and lands it at a drawn instant; the script leaves its attachment before, during or
after that, by itself, by an exception or by Ctrl-C, or its link is lost. The estimator keeps up, is slow or hangs. The
session is the real one, with its threads. Time passes in steps of 10 ms when every thread waits for it, so a seed needs
no sockets, and a busy machine changes little. Judged by the truth of the simulator: what was written while the drone
stood on the ground?
"""

import argparse
import contextlib
import json
import math
import queue
import random
import struct
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from crazyem.control.trajectories import Trajectory, excite, hover
from crazyem.estimation.online import OnlineEstimator
from crazyem.estimation.steps import StepAwareEstimator
from crazyem.links.base import LinkLost, LinkStatistics, ParameterWrite
from crazyem.live.attach import Attachment
from crazyem.live.runner import warm_up
from crazyem.live.session import Session
from crazyem.signals.sample import Block, Packet, Variable
from crazyem.vehicle import load_vehicle
from firmware_sim.commander import setpoint as sp
from firmware_sim.commander.setpoint import CRTP
from firmware_sim.firmware import Firmware
from firmware_sim.flight import Flight as SimulatedFlight
from firmware_sim.scenario import parse_scenario

STEP = 10  # ms
RESEND = 300  # ms after which the link repeats a write that was not answered, as the real one does
PATIENCE = 0.02  # s of host time for which a step waits for threads that do not answer
STANDS = 0.01  # m above the floor below which the drone stands
HEIGHT, RISE = 1.0, 2.0  # m, s
WAYS = ("leaves", "exception", "Ctrl-C", "stays", "link lost")
CTYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "i8": "int8_t", "i16": "int16_t", "i32": "int32_t"}
DOCS = Path(__file__).resolve().parents[1] / "docs" / "results" / "fault_campaign.md"
MARKS = ("<!-- attached: table -->", "<!-- /attached -->")


@dataclass(frozen=True)
class Case:
    """The case drawn by a seed. Times in s since take-off; `left`: time at which the script leaves its attachment."""

    seed: int
    way: str
    excite: bool
    grown: float  # mass over that of the vehicle file
    land: float
    lasts: float  # of the landing
    left: float
    extra: float  # ms, additional time of the estimator for a sample
    stall_at: float
    stall_for: float
    deaf_at: float  # start of an outage of telemetry
    deaf_for: float
    delay: int  # ms, of a packet each way
    lost: float  # share of echoes

    @property
    def kinds(self) -> list[str]:
        """Names of the faults."""
        found = {"slow estimator": self.extra, "stalled estimator": self.stall_for, "deaf": self.deaf_for}
        return [self.way, *(k for k, v in found.items() if v), *(["lost echoes"] if self.lost else [])]


def draw(seed: int) -> Case:
    """The case of a seed."""
    r = random.Random(f"attached {seed}")
    land = RISE + r.uniform(3.0, 6.0)
    estimator = r.choice(("keeps up", "slow", "slow", "stalled"))
    deaf = r.random() < 0.3
    return Case(
        seed,
        way=r.choice(WAYS),
        excite=r.random() < 0.6,
        grown=r.choice((-1, 1)) * r.uniform(0.05, 0.3) + 1.0,
        land=land,
        lasts=r.uniform(0.8, 2.5),
        left=land + r.uniform(-2.0, 4.0),
        extra=r.choice((0.5, 1.2, 2.0, 4.0)) if estimator == "slow" else 0.0,
        stall_at=land - r.uniform(0.0, 4.0),
        stall_for=r.choice((0.5, 2.0, 6.0)) if estimator == "stalled" else 0.0,
        deaf_at=land + r.uniform(-1.0, 2.0),
        deaf_for=r.uniform(0.2, 1.8) if deaf else 0.0,
        delay=r.randint(1, 30),
        lost=r.choice((0.0, 0.0, r.uniform(0.1, 0.7))),
    )


class World:
    """The drone, its pilot and the time. `quiet`: whether no thread has work to do before time goes on."""

    def __init__(self, case: Case) -> None:
        self.case, self.random = case, random.Random(f"world {case.seed}")
        scenario = parse_scenario({"vehicle": {"mass": 0.029 * case.grown}}, f"seed {case.seed}")
        self.firmware = Firmware(SimulatedFlight(scenario, case.seed), platform="cf2", seed=case.seed)
        self._set("stabilizer.controller", 5.0)
        self.tick = 0
        self.quiet: Callable[[], bool] = lambda: True
        self.steps: list[Callable[[], None]] = []  # called after each step
        self.began = math.nan  # s, take-off
        self.touched = math.nan  # s, first contact after it
        self._waiting: set[int] = set()
        self._time = threading.Condition()
        self._ended = False
        make = excite if case.excite else hover
        self._path: Trajectory = make(position=(0.0, 0.0, HEIGHT), duration=case.land - RISE - 0.2)
        self._landing = False
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Start the time."""
        self._thread.start()

    def end(self) -> None:
        """Stop the time and release all waiting threads."""
        with self._time:
            self._ended = True
            self._time.notify_all()
        if self._thread.is_alive():
            self._thread.join(10.0)

    def wait(self, tick: float) -> None:
        """Wait until the drone's clock shows `tick` [ms]."""
        me = threading.get_ident()
        with self._time:
            self._waiting.add(me)
            self._time.wait_for(lambda: self._ended or self.tick >= tick)
            self._waiting.discard(me)

    def waits(self, thread: threading.Thread) -> bool:
        """Whether that thread waits for time to pass."""
        return thread.ident in self._waiting

    @property
    def seconds(self) -> float:
        """Time since take-off [s]; NaN before."""
        return self.tick / 1000.0 - self.began

    @property
    def stands(self) -> bool:
        """Whether the drone stands on the ground, by the truth."""
        return float(self.firmware.flight.truth_row()[3]) < STANDS

    def read(self, name: str) -> float:
        """A parameter."""
        array, index = self._slot(name)
        return float(array[index])

    def _slot(self, name: str) -> tuple[Any, int]:
        item = self.firmware.param.table.by_name[name]
        return item.array, item.index

    def _set(self, name: str, value: float) -> None:
        array, index = self._slot(name)
        array[index] = float(np.float32(value))
        self.firmware._written(name)

    def write(self, name: str, value: float) -> None:
        """Handle a parameter write."""
        with self._time:  # between two steps
            self._set(name, value)

    def _run(self) -> None:
        while not self._ended:
            until = time.monotonic() + PATIENCE
            while not self.quiet() and time.monotonic() < until and not self._ended:
                time.sleep(0.0001)
            with self._time:
                self._pilot()
                self.firmware.advance(STEP)
                self.tick += STEP
                if math.isnan(self.touched) and self.seconds > RISE and self.stands:
                    self.touched = self.tick / 1000.0
            for step in self.steps:
                step()
            with self._time:
                self._time.notify_all()

    def _pilot(self) -> None:
        planner, now = self.firmware.high_level.planner, self.tick / 1000.0
        if math.isnan(self.began):
            if self.tick >= 1000:
                planner.takeoff(HEIGHT, None, RISE, now)
                self.began = now
        elif self.seconds >= self.case.land:
            if not self._landing:
                self._landing = True
                self.firmware.arbiter.relax()
                planner.land(0.0, None, self.case.lasts, now)
        elif self.seconds >= RISE + 0.2:
            r, s = self._path.at(self.seconds - RISE - 0.2), sp.null_setpoint()
            s[[sp.MODE_X, sp.MODE_Y, sp.MODE_Z, sp.MODE_QUAT]] = sp.ABSOLUTE
            s[sp.X : sp.AZ + 1] = (*r.position, *r.velocity, *r.acceleration)
            s[sp.QX : sp.QW + 1] = r.quaternion
            self.firmware.arbiter.offer(s, CRTP, self.tick)


@dataclass
class WorldLink:
    """A link to the world, with the parts that a session uses."""

    world: World
    uri: str = "world://0"
    packets: queue.SimpleQueue[Any] = field(default_factory=queue.SimpleQueue)
    writes: list[tuple[float, str, bool]] = field(default_factory=list)  # s, parameter, whether the drone stood
    blocks: list[Block] = field(default_factory=list)
    put: int = 0
    _gone: bool = False
    _way: list[tuple[int, Packet]] = field(default_factory=list)  # packets under way, and when they arrive

    @property
    def log_variables(self) -> dict[str, str]:
        """Name -> C type."""
        return {name: CTYPES.get(i.kind, "float") for name, i in self.world.firmware.log.table.by_name.items()}

    @property
    def parameters(self) -> dict[str, str]:
        """Name -> C type."""
        return dict.fromkeys(self.world.firmware.param.table.by_name, "float")

    def host_clock(self) -> float:
        """s, that of `Packet.host_time`: the world's."""
        return self.world.tick / 1000.0

    def subscribe(self, variables: Sequence[str], rate: float) -> tuple[Block, ...]:
        """Make blocks of at most a packet's size, every 10 ms."""
        types = self.log_variables
        block = Block(len(self.blocks), tuple(Variable(v, types[v]) for v in variables), STEP)
        self.blocks.append(block)
        return (block,)

    def step(self) -> None:
        """Send the log packets of this step, and deliver the packets that arrive."""
        w, case = self.world, self.world.case
        if self._gone:
            return
        deaf = case.deaf_for and case.deaf_at <= w.seconds < case.deaf_at + case.deaf_for
        if case.way == "link lost" and w.seconds >= case.left:
            self._gone = True
            self.packets.put(LinkLost("the link is gone.", self.host_clock()))
            return
        for block in self.blocks if not deaf else ():
            values = tuple(self._logged(v.name) for v in block.variables)
            self._way.append((w.tick + case.delay, Packet(block.identifier, w.tick, w.tick / 1000.0, values)))
        while self._way and self._way[0][0] <= w.tick:
            _, packet = self._way.pop(0)
            self.put += 1
            self.packets.put(Packet(packet.block, packet.firmware_time_ms, self.host_clock(), packet.values))

    def _logged(self, name: str) -> float:
        item = self.world.firmware.log.table.by_name[name]
        value = float(item.array[item.index])
        if item.kind == "float":
            return float(np.float32(value))
        low, high = (-32768, 32767) if item.kind == "i16" else (0, 2**32 - 1)
        return float(min(max(int(value), low), high))

    def read_parameter(self, name: str, timeout: float = 2.0) -> float:
        """Read a parameter without delay."""
        return self.world.read(name)

    def write_parameter(self, name: str, value: float, timeout: float = 1.0) -> ParameterWrite:
        """Write a parameter; repeat every 0.3 s of the drone's time until an echo comes."""
        w, rounded = self.world, struct.unpack("<f", struct.pack("<f", value))[0]
        begun = w.tick
        sends = 0
        while w.tick < begun + 1000.0 * timeout or not sends:
            sent, sends = w.tick, sends + 1
            w.wait(sent + w.case.delay)
            w.write(name, value)
            self.writes.append((w.tick / 1000.0, name, w.stands))
            if w.random.random() >= w.case.lost:
                w.wait(sent + 2 * w.case.delay)
                return ParameterWrite(name, value, rounded, True, self.host_clock())
            w.wait(sent + RESEND)
            if w._ended:
                break
        return ParameterWrite(name, value, None, False, self.host_clock())

    def statistics(self) -> LinkStatistics:
        """None are kept."""
        return LinkStatistics()

    def close(self) -> None:
        """Nothing to do."""


@dataclass
class Result:
    """Result of a flight. `after_s`: time of the last write on the ground since touch-down, s."""

    seed: int
    kinds: list[str]
    writes: int
    on_ground: int
    after_s: float | None
    behind_s: float  # delay of the estimator when the script left
    landed: bool
    stopped: str
    fault_of_ours: str = ""


def fly(seed: int) -> Result:
    """Draw, fly and judge a case."""
    case = draw(seed)
    vehicle = load_vehicle("cf2")
    warm_up(vehicle)
    world = World(case)
    link = WorldLink(world)
    session = Session(link, vehicle=vehicle, estimator=StepAwareEstimator(OnlineEstimator(vehicle)))  # type: ignore[arg-type]
    fed, free_at = [0], [0.0]
    feed = session._feed

    def slowly(samples: Any) -> None:
        cost = case.extra * len(samples)
        if case.stall_for and world.seconds >= case.stall_at and not free_at[0]:
            cost += 1000.0 * case.stall_for
        if cost:
            free_at[0] = max(free_at[0], 1000.0 * samples[0].time + case.delay) + cost
            world.wait(free_at[0])
        feed(samples)
        fed[0] += 1

    session._feed = slowly  # type: ignore[method-assign]

    def quiet() -> bool:
        receiving, estimating = session._threads if session._threads else (None, None)
        received = session._stop.is_set() or session.lost is not None or link.packets.empty()
        estimated = fed[0] >= link.put or (estimating is not None and world.waits(estimating)) or session._stop.is_set()
        pusher = session.pusher
        pushed = pusher is None or not pusher.busy or world.waits(pusher._thread)
        return receiving is None or (received and estimated and pushed)

    behind, fault = math.nan, ""
    try:
        world.wait(0)
        session.start()
        world.quiet, world.steps = quiet, [link.step]
        session.push_to_controller()
        session.pipeline.push_from = -math.inf
        world.start()
        world.wait(1100.0)
        errors = {"exception": ValueError("of the script"), "Ctrl-C": KeyboardInterrupt()}
        with contextlib.suppress(ValueError, KeyboardInterrupt), Attachment(session):
            extra = 4.0 if case.way in ("stays", "link lost") else 0.0
            world.wait(1000.0 * (world.began + (case.left if not extra else max(case.left, case.land) + extra)))
            newest = session.history.estimates[-1].time if session.history.estimates else math.nan
            behind = world.tick / 1000.0 - newest
            if case.way in errors:
                raise errors[case.way]
        if math.isnan(world.touched):
            world.wait(1000.0 * (world.began + case.land + case.lasts + 3.0))
    except Exception as error:
        fault = repr(error)
    finally:
        world.end()
    ground = [t - world.touched for t, _, stood in link.writes if stood]
    return Result(
        seed, case.kinds, len(link.writes), len(ground), max(ground, default=None), behind,
        not math.isnan(world.touched), str(session.history.guard.get("stopped", "")), fault,
    )  # fmt: skip


def table(results: Sequence[Result]) -> str:
    """Markdown: results by way of leaving and by fault."""
    lines = ["| | flights | with writes | writes | on the ground |", "|---|---|---|---|---|"]
    counts = Counter(k for r in results for k in r.kinds)
    for kind in ("all", *WAYS, *sorted(set(counts) - set(WAYS))):
        rows = [r for r in results if kind == "all" or kind in r.kinds]
        lines.append(
            f"| {kind} | {len(rows)} | {sum(r.writes > 0 for r in rows)} | {sum(r.writes for r in rows)} "
            f"| {sum(r.on_ground for r in rows)} |"
        )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.attached_flight", description=__doc__)
    parser.add_argument("--flights", type=int, default=200, help="seeds (default %(default)s)")
    parser.add_argument("--first", type=int, default=1, help="seed (default %(default)s)")
    parser.add_argument("--out", type=Path, required=True, help="results, JSON")
    parser.add_argument("--docs", action="store_true", help="write the table into docs/results/fault_campaign.md")
    a = parser.parse_args(argv)
    results = []
    for seed in range(a.first, a.first + a.flights):
        result = fly(seed)
        results.append(result)
        print(seed, *result.kinds, f"{result.writes} writes, {result.on_ground} on the ground", result.fault_of_ours,
              sep=", ", flush=True)  # fmt: skip
    a.out.write_text(json.dumps([asdict(r) for r in results], indent=1), encoding="utf-8")
    text = table(results)
    print(text)
    if a.docs:
        head, rest = DOCS.read_text(encoding="utf-8").split(MARKS[0])
        tail = rest.split(MARKS[1])[1]
        DOCS.write_text(f"{head}{MARKS[0]}\n\n{text}\n\n{MARKS[1]}{tail}", encoding="utf-8")
    return int(any(r.on_ground or r.fault_of_ours for r in results))


if __name__ == "__main__":
    sys.exit(main())
