"""Flights of the simulated firmware in one process, with guard, write supervisor and monitor.

Bytes in, log packets out (wire_flight.py); estimator, guard, monitor and gate are those of `crazyem fly`, without its
threads: a decision of the guard is in the drone 20 ms later. The truth is used for drawing and judging only.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from struct import pack

import numpy as np

from benchmarks.wire_flight import LOG_PERIOD, SETPOINT_JITTER, SETPOINT_PERIOD, Client
from crazyem.control.indi import IndiGains, place_ahead
from crazyem.control.trajectories import Trajectory, after_hover
from crazyem.estimation.online import ATTITUDE_PERIOD, OnlineEstimator
from crazyem.estimation.result import Estimate, ParameterEstimate
from crazyem.live.controllers import CONTROLLERS, for_vehicle, with_drag, writes_back
from crazyem.live.guard import Decision, Guard
from crazyem.live.history import History
from crazyem.live.pipeline import Estimator, Pipeline
from crazyem.live.policy import WriteRules, load_policy
from crazyem.live.push import nominal_estimates
from crazyem.live.session import block_plan
from crazyem.live.telemetry import Telemetry
from crazyem.live.write_gate import WriteGate
from crazyem.live.write_supervisor import WriteSupervisor
from crazyem.signals.sample import Block, Packet, Variable
from crazyem.signals.vocabulary import compress_quaternion, decoders
from crazyem.vehicle import Vehicle
from firmware_sim import wire
from firmware_sim.controllers import parameters as pm
from firmware_sim.plant import layout as at
from firmware_sim.scenario import Scenario

CTYPES = {1: "uint8_t", 2: "uint16_t", 3: "uint32_t", 4: "int8_t", 5: "int16_t", 6: "int32_t", 7: "float", 8: "FP16"}
TAKE_OFF, BASELINE = 2500, 2.0  # ms, s


@dataclass
class Writer:
    """The part of a pusher that the write supervisor uses; writes at once."""

    flight: "GuardedFlight"
    known: dict[str, float]
    busy: bool = False

    def submit(self, decision: Decision) -> None:
        """Write a set of values, or restore those values that differ."""
        writes = decision.writes
        if decision.kind != "push":
            self.flight.reverted = True
            writes = writes_back(self.flight.guard.controller, dict(writes), now=self.known)
        why = self.flight.supervisor.gate.objection(decision.kind)
        for name, value in writes if not why else ():
            self.flight.client.set(name, value)
            self.flight.writes.append((self.flight.seconds, name, value))
            self.known[name] = value
        self.flight.supervisor.on_written(decision, why)


@dataclass
class GuardedFlight:
    """A flight made by `fly`, with its records.

    Args:
        controller: stabilizer.controller. parameters: at boot, beside the scenario's.
        tamper: changes an estimate before it reaches the guard, or None.
        estimator: None: one without detection of mass steps.
    """

    scenario: Scenario
    seed: int
    vehicle: Vehicle
    controller: int
    parameters: Mapping[str, float] = field(default_factory=dict)
    push: bool = True
    tamper: Callable[[Estimate], Estimate] | None = None
    estimator: Estimator | None = None

    def __post_init__(self) -> None:
        told = (
            dict(self.scenario.parameters) | dict(self.parameters) | {"stabilizer.controller": float(self.controller)}
        )
        self.client = Client(replace(self.scenario, parameters=told), self.seed)
        self.flight = self.client.firmware.flight
        self.plan = list(block_plan([i.name for i in self.client.firmware.log.table.items], wrench="none"))
        types = self.client.log(self.plan)
        blocks = [
            Block(i, tuple(Variable(n, CTYPES[t]) for n, t in zip(names, kinds)), LOG_PERIOD)
            for i, (names, kinds) in enumerate(zip(self.plan, types))
        ]
        self.decoders = decoders(blocks)
        self.formats = [np.dtype([(str(n), _NUMPY[t]) for n, t in enumerate(kinds)]) for kinds in types]
        self.telemetry, self.history = Telemetry(), History()
        self.estimator = self.estimator or OnlineEstimator(self.vehicle, attitude_period=ATTITUDE_PERIOD)
        self.pipeline = Pipeline(self.estimator, history=self.history)
        self.writes: list[tuple[float, str, float]] = []
        self.rows: list[list[float]] = []  # seconds, truth: position, velocity, quaternion, rate; estimate: velocity
        self.reverted = False
        self.begin = math.nan
        target = for_vehicle(CONTROLLERS[self.controller], self.vehicle)
        assert not isinstance(target, str)
        target = with_drag(target)
        originals = {name: self.read(name) for name in target.parameters}
        self.guard = Guard(
            target,
            nominal=nominal_estimates(self.vehicle, target),
            originals=originals,
            limits=load_policy().limits,
        )
        self.supervisor = WriteSupervisor(
            self.guard,
            WriteRules(load_policy()),
            originals=originals,
            history=self.history,
            gate=WriteGate(self.telemetry, now=lambda: self.flight.tick / 1000.0),
            now=lambda: self.flight.tick / 1000.0,
            residual=lambda: getattr(self.estimator, "residual", None),
            enabled=lambda time: self.pipeline.push_from <= time <= self.pipeline.push_until,
        )
        self.supervisor.pusher = self.writer = Writer(self, dict(originals))  # type: ignore[assignment]
        if self.push:
            self.pipeline.guard = self if self.tamper else self.supervisor
            self.pipeline.push = self.writer.submit

    def consider(self, estimate: Estimate, time: float, *, airborne: bool, enabled: bool = True) -> Decision:
        """The supervisor's decision on the estimate after `tamper`."""
        assert self.tamper is not None
        return self.supervisor.consider(self.tamper(estimate), time, airborne=airborne, enabled=enabled)

    def on_mass_step(self, *_: object) -> None:
        """Do nothing: there are no payload events here."""

    def read(self, name: str) -> float:
        """A parameter."""
        return float(self.flight._param[pm.PARAMETER_INDEX[name]])

    @property
    def seconds(self) -> float:
        """Time since the start of the trajectory, after the hover [s]."""
        return self.flight.tick / 1000.0 - self.begin - BASELINE

    @property
    def crashed(self) -> bool:
        """Whether the drone has crashed: on its back, locked, or far below."""
        s = self.flight.state
        upright = 1.0 - 2.0 * (s[at.QUAT + 1] ** 2 + s[at.QUAT + 2] ** 2)
        return bool(upright < 0.0 or (not math.isnan(self.begin) and s[at.POS + 2] < 0.2))

    def fly(
        self,
        trajectory: Trajectory,
        *,
        each: Callable[["GuardedFlight"], None] = lambda flight: None,
        push_for: float = math.inf,
    ) -> None:
        """Take off to 1 m, hover for 2 s, fly; `each` is called with every setpoint. Ends early with a crash.

        push_for: s of the trajectory during which the guard is active.
        """
        c = self.client
        c.send(wire.SUPERVISOR, 1, bytes((1, 1)))
        self._wait(1000)  # brushless rotors come up to speed
        c.send(wire.SETPOINT_HIGH_LEVEL, 0, pack("<BBff?f", 7, 0, 1.0, 0.0, False, 2.0))
        self._wait(TAKE_OFF)
        path = after_hover(trajectory, seconds=BASELINE)
        self.begin = self.flight.tick / 1000.0
        self.pipeline.push_from = self.begin + BASELINE
        self.pipeline.push_until = self.pipeline.push_from + push_for
        late = np.random.default_rng([self.seed, 0x5E7]).normal(0.0, SETPOINT_JITTER, 10 * round(1000 * path.duration))
        start = self.flight.tick
        for count in range(math.ceil(1000.0 * path.duration / SETPOINT_PERIOD)):
            self._wait(max(0, start + round(count * SETPOINT_PERIOD + late[count]) - self.flight.tick))
            r = path.at((self.flight.tick - start) / 1000.0)
            if self.guard.controller.incremental:
                x, y, z, heading = place_ahead(r, IndiGains())
                c.send(wire.SETPOINT_GENERIC, 0, pack("<Bffff", 7, x, y, z, math.degrees(heading)))
            else:
                values = [round(1000 * v) for v in (*r.position, *r.velocity, *r.acceleration)]
                rates = (0, 0, round(1000 * r.yaw_rate))
                packed = pack("<B9hI3h", 6, *values, compress_quaternion(r.quaternion), *rates)
                c.send(wire.SETPOINT_GENERIC, 0, packed)
            s = self.flight.state
            known = [self.flight._estimate[at.E_VEL + i] for i in range(3)]
            self.rows.append([self.seconds, *s[: at.ROTOR].tolist(), *known, *r.position])
            each(self)
            if self.crashed:
                return

    def _wait(self, milliseconds: int) -> None:
        """Let time pass; the log packets go through telemetry, monitor and estimator."""
        self.client.wait(milliseconds)
        packets, self.client.packets = self.client.packets, []
        for data in packets:
            block, stamp = data[0], int.from_bytes(data[1:4], "little")
            values = tuple(float(v) for v in np.frombuffer(data[4:], self.formats[block])[0])
            packet = Packet(block, stamp, stamp / 1000.0, values)
            if "supervisor.info" in self.plan[block]:
                self.telemetry.info = int(values[self.plan[block].index("supervisor.info")])
                self.telemetry.heard = stamp / 1000.0
            samples = self.decoders[block].decode(packet)
            for sample in samples:
                self.telemetry.take(sample)
            self.supervisor.take(samples)
            for sample in samples:
                self.pipeline.sample(sample)


_NUMPY = {1: "<u1", 2: "<u2", 3: "<u4", 4: "<i1", 5: "<i2", 6: "<i4", 7: "<f4", 8: "<f2"}


def scaled(estimate: Estimate, names: tuple[str, ...], factor: float, *, sd: float = 0.01) -> Estimate:
    """An estimate with `factor` times the value of some parameters, and with small intervals."""
    changed = dict(estimate.parameters)
    for name in names:
        p = changed[name]
        value = factor * p.value
        around = (value * (1 - 1.96 * sd), value * (1 + 1.96 * sd))
        changed[name] = ParameterEstimate(value, sd * value, around, p.unit, True, "")
    return replace(estimate, parameters=changed)
