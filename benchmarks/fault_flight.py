"""One flight of the fault campaign: drawn from a seed, with faults of link, host, payload and battery, and judged.

Faults of sensors act between link and session, and the drone's own sensors stay right: so a crash is caused by a write,
the link or the payload, never by a blind autopilot. The simulator's truth decides. Simulator and relay are threads of
this process, which saves time; they exchange real packets on real sockets.
"""

import contextlib
import csv
import math
import random
import struct
import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from benchmarks.in_process import OPEN_GATE, Pace, in_a_thread, simulator
from crazyem.control.named_trajectories import trajectory_maker
from crazyem.errors import CrazyemError
from crazyem.estimation.online import OnlineEstimator
from crazyem.estimation.result import Estimate
from crazyem.estimation.steps import StepAwareEstimator
from crazyem.links import open_link
from crazyem.live.controllers import LEE, writes_for
from crazyem.live.flight import Flight, FlightPlan
from crazyem.live.flight_monitor import monitor_for
from crazyem.live.guard import INERTIA_NAMES, Decision
from crazyem.live.history import open_recorder
from crazyem.live.policy import FaultRules, WriteRules
from crazyem.live.runner import warm_up
from crazyem.live.session import Session
from crazyem.recordings import open_recording
from crazyem.signals.sample import Packet, Sample
from crazyem.vehicle import Vehicle, load_vehicle
from firmware_sim.relay.faults import UP, Engine, Fault
from firmware_sim.relay.relay import Relay

DURATION, BASELINE = 7.0, 1.5  # s of the trajectory, and of the hover before it
RAW_EVERY = 0.1  # s between writes without a guard
# Limits of a crash: tilt; m/s into the floor (a landing may drop the last 0.3 m); m from the start; m, ceiling of a
# usual room; s for which the drone may touch the floor before the landing
STEEP, HARD, FAR, CEILING, TOUCH = math.radians(75.0), 2.7, 8.0, 2.5, 0.1
LATE = 0.25  # s, largest delay of the estimator before the drone's time waits
MOTORS = tuple(f"motor.m{i}" for i in range(1, 5))

# Faults of log variables on the way to the estimator: variables, and range of the drawn number
SENSORS: dict[str, tuple[tuple[str, ...], tuple[float, float]]] = {
    "stuck_height": (("stateEstimateZ.z",), (0.0, 0.0)),
    "stuck_rates": (("stateEstimateZ.rateRoll", "stateEstimateZ.ratePitch"), (0.0, 0.0)),
    "biased_voltage": (("pm.vbatMV",), (0.75, 1.3)),
    "biased_motors": (MOTORS, (0.6, 1.5)),
    "scaled_rates": (("stateEstimateZ.rateRoll", "stateEstimateZ.ratePitch", "stateEstimateZ.rateYaw"), (0.3, 3.0)),
    "scaled_velocity": (("stateEstimateZ.vz",), (0.5, 2.0)),
    "not_a_number": (("acc.z",), (math.nan, math.nan)),
    "infinite": (("stateEstimateZ.vx",), (math.inf, math.inf)),
    "hostile_values": (MOTORS, (-1e6, 1e6)),
}


@dataclass(frozen=True)
class Case:
    """The case drawn by one seed. Times are s of firmware time: of `link` since the connection, of `payload` since
    take-off, all others since pushing began."""

    seed: int
    mass: float
    inertia: tuple[float, float, float]
    charge: float = 1.0
    sensor: str = ""
    sensor_value: float = 0.0
    sensor_from: float = math.inf
    stall_at: float = math.inf
    stall_for: float = 0.0
    link: tuple[dict[str, Any], ...] = ()
    payload: tuple[tuple[float, float], ...] = ()  # s, kg: attached, or released if negative

    @property
    def kinds(self) -> list[str]:
        """Names of the faults."""
        names = [f"link {f['what']}" for f in self.link] + ([self.sensor] if self.sensor else [])
        names += [f"payload {'attached' if mass > 0 else 'dropped'}" for _, mass in self.payload]
        return names + (["battery"] if self.charge < 1 else []) + (["stall"] if self.stall_for else [])

    def scenario(self) -> str:
        """For the simulator."""
        carried = -sum(mass for _, mass in self.payload if mass < 0)
        text = (
            f"[vehicle]\nmass = {self.mass - carried!r}\ninertia = {list(self.inertia)!r}\n"
            f"[battery]\ncharge = {self.charge!r}\n"
        )
        if carried:
            text += f"[effects.payload]\nmass = {carried!r}\nz = -0.01\n"
        for when, mass in self.payload:
            text += f'[[payload.events]]\naction = "{"attach" if mass > 0 else "release"}"\n'
            text += f'after = "take-off"\ntime = {when!r}\n'
            if mass > 0:
                text += f"mass = {mass!r}\nposition = [0.002, -0.002, -0.01]\n"
        return text

    def later(self, seconds: float) -> "Case":
        """The same case with every fault later, but for losses that last the whole flight."""
        moved = [{k: v + seconds if k in ("start", "end") else v for k, v in fault.items()} for fault in self.link]
        return replace(
            self,
            sensor_from=self.sensor_from + seconds,
            stall_at=self.stall_at + seconds,
            link=tuple(moved),
            payload=tuple((when + seconds, mass) for when, mass in self.payload),
        )

    def mass_at_end(self) -> float:
        """Mass [kg] after all payload events."""
        return self.mass + sum(mass for _, mass in self.payload)


def draw(seed: int) -> Case:
    """The case of a seed: a drone that differs from its vehicle file, and one to three faults."""
    r = random.Random(f"faults {seed}")
    grown = r.uniform(0.95, 1.35)
    xx, yy, zz = (j * grown * r.uniform(0.9, 1.2) for j in (1.66e-5, 1.67e-5, 2.93e-5))
    case = Case(seed, 0.029 * grown, (xx, yy, min(zz, 0.98 * (xx + yy))))  # triangle inequality of a body
    kinds = ("link", "link", "sensor", "sensor", "payload", "battery", "stall")
    for what in r.sample(kinds, r.choice((1, 1, 2, 3))):
        if what == "link":
            case = replace(case, link=(*case.link, _draw_link(r)))
        elif what == "sensor":
            name = r.choice(sorted(SENSORS))
            low, high = SENSORS[name][1]
            value = low if not high > low else r.uniform(low, high)
            case = replace(case, sensor=name, sensor_value=value, sensor_from=r.uniform(-4.0, 4.0))
        elif what == "payload":
            share = r.choice((-1.0, 1.0)) * r.uniform(0.03, 0.2)
            case = replace(case, payload=((r.uniform(4.5, 9.5), share * case.mass),))
        elif what == "battery":
            case = replace(case, charge=r.uniform(0.03, 0.10))
        else:
            case = replace(case, stall_at=r.uniform(-1.0, 4.0), stall_for=r.choice((0.5, 1.5, 4.0, 30.0)))
    return case


def _draw_link(r: random.Random) -> dict[str, Any]:
    start = r.uniform(4.0, 9.0)
    return r.choice(
        (
            {"what": "drop", "rate": r.uniform(0.01, 0.25), "burst": r.choice((1.0, 4.0))},
            {"what": "drop", "rate": r.uniform(0.2, 0.9), "direction": "down", "kinds": ["param.write"]},
            {"what": "drop", "direction": "down", "kinds": ["param.write"], "start": start, "end": start + 6.0},
            {"what": "duplicate", "rate": r.uniform(0.05, 0.5)},
            {"what": "reorder", "rate": r.uniform(0.05, 0.4), "distance": r.randint(1, 5)},
            {"what": "delay", "ms": r.uniform(5.0, 60.0), "jitter_ms": r.uniform(0.0, 40.0)},
            {"what": "silence", "direction": "down", "start": start, "end": start + r.uniform(0.3, 3.0)},
            {
                "what": "silence",
                "direction": r.choice(("up", "both")),
                "start": start,
                "end": start + r.uniform(0.2, 1.5),
            },
            {"what": "die", "start": start, "end": start + r.uniform(0.3, 1.5)},
        )
    )


class Bad:
    """The link's packets with one faulty sensor."""

    def __init__(self, link: Any, case: Case) -> None:
        self._link, self._case = link, case
        self._names: dict[int, tuple[str, ...]] = {}
        self._stuck: dict[str, float] = {}
        self.session: Session | None = None
        self.packets = self  # `link.packets.get(timeout=...)`

    def __getattr__(self, name: str) -> Any:
        return getattr(self._link, name)

    def subscribe(self, *arguments: Any, **options: Any) -> Any:
        blocks = self._link.subscribe(*arguments, **options)
        self._names.update({b.identifier: tuple(v.name for v in b.variables) for b in blocks})
        return blocks

    def get(self, timeout: float) -> Any:
        """Raises queue.Empty."""
        item = self._link.packets.get(timeout=timeout)
        if not isinstance(item, Packet) or not self._case.sensor or self.session is None:
            return item
        since = item.firmware_time_ms / 1000.0 - pushing_from(self.session)
        if not since >= self._case.sensor_from:
            return item
        names = self._names.get(item.block, ())
        return replace(item, values=tuple(self._harm(n, v) for n, v in zip(names, item.values)))

    def _harm(self, name: str, value: float) -> float:
        wrong, number = SENSORS[self._case.sensor][0], self._case.sensor_value
        if name not in wrong:
            return value
        if self._case.sensor.startswith("stuck"):
            return self._stuck.setdefault(name, value)
        if self._case.sensor in ("not_a_number", "infinite", "hostile_values"):
            return number
        return value * number


def pushing_from(session: Session) -> float:
    """Start of pushing [s, drone's clock], after the hover at the trajectory's start; NaN if unknown."""
    marks = session.history.marks
    return marks.get("push_enabled", marks.get("trajectory_start", math.nan) + BASELINE)


class Stalling:
    """An estimator that hangs once for a while."""

    def __init__(self, vehicle: Vehicle, case: Case) -> None:
        self._inner, self._case = StepAwareEstimator(OnlineEstimator(vehicle)), case
        self.session: Session | None = None
        self.speed = 1.0
        self.newest = math.nan  # s, of the newest sample taken
        self._harmed = False  # still late after a drawn stall
        self.over = threading.Event()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def feed(self, sample: Sample) -> Estimate | None:
        session, case = self.session, self._case
        if case.stall_for and session is not None and sample.time - pushing_from(session) >= case.stall_at:
            self._case, self._harmed = replace(case, stall_for=0.0), True
            self.over.wait(case.stall_for / self.speed)
        self.newest = sample.time
        return self._inner.feed(sample)

    def late(self) -> bool:
        """Whether it is late because this machine is slow, and not because of a drawn stall."""
        session = self.session
        if session is None or session.pipeline.estimate_until < math.inf:
            return False  # the estimate has ended
        behind = session.clock.newest - self.newest
        self._harmed = self._harmed and not behind < LATE
        return behind > LATE and not self._harmed


class NoGuard:
    """Writes every estimate at once, like a simple script."""

    def __init__(self, originals: dict[str, float]) -> None:
        self.controller, self.originals, self.stopped = LEE, originals, ""
        names = (LEE.mass, *LEE.inertia)
        self.beliefs = dict(zip(("mass", *INERTIA_NAMES), (originals[n] for n in names)))
        self._last = -math.inf

    def stop(self, reason: str) -> None:
        """Do nothing: a missing echo does not stop the writes."""

    def consider(self, estimate: Estimate, time: float, *, airborne: bool, enabled: bool = True) -> Decision:
        if not airborne or time - self._last < RAW_EVERY:
            return Decision(time)
        self._last = time
        changed = {n: estimate[n].value for n in self.beliefs}
        if not all(abs(v) < 3e38 for v in changed.values()):
            return Decision(time)
        writes = writes_for(self.controller, changed, beliefs=self.beliefs, originals=self.originals)
        self.beliefs.update(changed)
        return Decision(time, writes=writes)


class Listening(Engine):
    """A relay's engine that keeps every parameter write on the way to the drone."""

    def __init__(self, seed: int) -> None:
        super().__init__((), seed)
        self.written: set[bytes] = set()

    def take(self, now: float, route: Any, direction: str, datagram: bytes) -> None:
        if direction == UP and datagram and datagram[0] & 0xF3 == 0x22 and len(datagram) == 7:
            self.written.add(bytes(datagram[1:]))
        super().take(now, route, direction, datagram)


@dataclass
class Result:
    """Result of a flight; `error` is its last sentence in case of an error."""

    seed: int
    arm: str
    kinds: list[str]
    crashed: str = ""
    error: str = ""
    fault_of_ours: str = ""
    writes: int = 0
    left: int = 0  # number of different writes on the way to the drone
    unrecorded: int = 0
    purposes: dict[str, int] = field(default_factory=dict)
    stopped: str = ""
    mass_error: float = math.nan
    landing: float = math.nan  # s of firmware time at the start of the landing; NaN: never
    steps: int = 0  # changes of mass that the estimator has confirmed
    reports: list[str] = field(default_factory=list)  # of the monitor
    seconds: float = 0.0
    processor_s: float = 0.0


def fly(seed: int, arm: str, folder: Path, *, speed: float, later: float = 0.0) -> Result:
    """Draw, fly and judge a case. Files of the flight go to `folder`.

    later: s by which the faults come later and the trajectory is longer.
    """
    case, begun, spent = draw(seed).later(later), time.monotonic(), time.process_time()
    result = Result(seed, arm, case.kinds)
    scenario, truth, file = (folder / f"{seed}_{arm}.{end}" for end in ("toml", "csv", "mcap"))
    scenario.write_text(case.scenario(), encoding="utf-8")
    vehicle = load_vehicle("cf2")
    warm_up(vehicle)
    faults = [_fault(f, speed) for f in case.link]
    engine = Listening(seed)
    with contextlib.ExitStack() as stack:
        pace = Pace(speed)
        address = stack.enter_context(simulator(scenario, seed=seed, truth=truth, pace=pace))
        relay = Relay(address, engine)
        stack.enter_context(in_a_thread(relay))
        link = open_link(relay.uri)
        stack.callback(link.close)
        link.connect(60.0)
        engine.began = None
        engine.replace(faults)  # their times start here: connecting under faults is tested elsewhere
        names = _names(link)
        _fly(case, arm, link, vehicle, file, result, pace, DURATION + later)
    result.crashed = crash(truth, landing=result.landing)
    left = {w for w in engine.written if int.from_bytes(w[:2], "little") in names}
    result.left, result.unrecorded = len(left), unrecorded(left, names, file)
    result.seconds, result.processor_s = time.monotonic() - begun, time.process_time() - spent
    for path in (scenario, truth, file):
        if not result.crashed and not result.fault_of_ours and not result.unrecorded:
            path.unlink(missing_ok=True)  # kept for flights with findings only
    return result


def _fault(drawn: dict[str, Any], speed: float) -> Fault:
    """A fault for the relay, whose times are the host's."""
    hosts = {k: drawn[k] / speed for k in ("start", "end", "ms", "jitter_ms") if k in drawn}
    return Fault(**{**drawn, **hosts, "kinds": frozenset(drawn.get("kinds", ()))})


def _fly(
    case: Case, arm: str, link: Any, vehicle: Vehicle, file: Path, result: Result, pace: Pace, duration: float
) -> None:
    bad, estimator = Bad(link, case), Stalling(vehicle, case)
    estimator.speed, pace.late = pace.speed, estimator.late
    recorder = open_recorder(str(file), configuration={}, vehicle=vehicle, link=link)
    assert recorder is not None
    monitor = monitor_for(vehicle, FaultRules(), enabled=arm == "monitored")
    session = Session(bad, vehicle=vehicle, estimator=estimator, recorder=recorder, monitor=monitor)
    bad.session = estimator.session = session
    rules = WriteRules(dry_run=arm == "unguarded")  # the raw writer below replaces the guard
    plan = FlightPlan(trajectory_maker(["excite"], duration), LEE, push=arm != "none", rules=rules, baseline=BASELINE)
    flight = Flight(session, plan)
    if arm == "unguarded":
        prepare = session.push_to_controller
        session.push_to_controller = lambda rules=None: _without_guard(session, prepare(rules))  # type: ignore[method-assign]
    try:
        session.start()
        flight.fly()
    except CrazyemError as error:
        result.error = str(error)
    except Exception as error:
        result.fault_of_ours = repr(error)
    finally:
        pace.late = None
        estimator.over.set()
        session.close()
        recorder.close()
    history = session.history
    result.writes = len(history.pushes)
    for push in history.pushes:
        result.purposes[push.purpose] = result.purposes.get(push.purpose, 0) + 1
    result.stopped = str(history.guard.get("stopped", "")) if arm in ("guarded", "monitored") else ""
    result.reports = [fault.name for fault in history.faults if not fault.settled]
    if history.pushes and (masses := [p.value for p in history.pushes if p.parameter == LEE.mass]):
        result.mass_error = masses[-1] / case.mass_at_end() - 1.0
    result.landing = history.marks.get("estimate_end", math.nan)  # set when a landing begins
    result.steps = sum(step.real is True for step in history.steps)


def _without_guard(session: Session, note: str) -> str:
    from crazyem.live.push import Pusher, read_originals

    originals = read_originals(session.link, LEE)
    guard: Any = NoGuard(originals)
    on_write = session.recorder.parameter_write if session.recorder else None
    session.pusher = Pusher(session.link, guard, gate=OPEN_GATE, history=session.history, on_write=on_write)
    session.write_supervisor, session.pipeline.guard, session.pipeline.push = None, guard, session.pusher.submit
    return note


def _names(link: Any) -> dict[int, str]:
    """Number -> name of every parameter of the controller."""
    table = link._cf.param.toc if link._cf is not None else None
    found = {} if table is None else {p: table.get_element_by_complete_name(p) for p in LEE.parameters}
    return {element.ident: name for name, element in found.items() if element is not None}


def unrecorded(sent: set[bytes], names: dict[int, str], file: Path) -> int:
    """Number of different writes to the controller that were sent and are not in the recording."""
    try:
        events = open_recording(file).events
    except CrazyemError:  # ended without a recording: every write is missing
        events = ()
    kept = {
        (str(e.data.get("name")), struct.pack("<f", float(e.data.get("value", math.nan))))
        for e in events
        if e.kind == "parameter_write"
    }
    writes = {(names[int.from_bytes(w[:2], "little")], w[2:]) for w in sent}
    return len(writes - kept)


def crash(truth: Path, *, landing: float = math.nan) -> str:
    """Kind of crash by the simulator's truth, "" for none; `landing`: start of the landing [s]."""
    flown, down = False, math.nan
    try:
        with truth.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                t, x, y, z, vz, qx, qy = (float(row[k] or "nan") for k in ("t", "px", "py", "pz", "vz", "qx", "qy"))
                flown = flown or z > 0.3
                tilt = math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (qx * qx + qy * qy))))
                if tilt > STEEP:
                    return f"tilted {math.degrees(tilt):.0f} degrees at {t:.2f} s"
                if flown and z < 0.05 and vz < -HARD:
                    return f"hit the floor with {-vz:.1f} m/s at {t:.2f} s"
                if flown and z < 0.03 and t < landing:
                    down = t if math.isnan(down) else down
                    if t - down > TOUCH:
                        return f"lay on the floor at {down:.2f} s, told to land at {landing:.2f} s"
                else:
                    down = math.nan
                if z > CEILING:
                    return f"hit the ceiling at {t:.2f} s"
                if math.hypot(x, y) > FAR:
                    return f"flew away at {t:.2f} s"
    except (OSError, TypeError, ValueError):
        return ""  # the last line is incomplete
    return ""
