"""Flights for the monitor's benchmark: a random world flown in this process, with faults during the flight.

Firmware, controllers and plant are those of `python -m firmware_sim`; log blocks are those of a session. Faults of the
body are changes in the plant, faults of sensors act between link and estimator. A fault ends after a while, so that one
flight has several.
"""

import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.concealed import conditions
from benchmarks.concealed.courses import course, size_of
from benchmarks.concealed.draw import waypoints
from benchmarks.concealed.random_world import random_case, scenario_of
from benchmarks.concealed.simulate import BOOT, SETPOINT, astray, full_state
from crazyem.signals.sample import Block, Packet, Sample, Variable
from crazyem.signals.vocabulary import block_plan, decoders
from crazyem.vehicle import Vehicle, parse_vehicle
from firmware_sim.commander.setpoint import CRTP
from firmware_sim.controllers.tick import tick_step_with_effects
from firmware_sim.firmware import Firmware
from firmware_sim.flight import Flight
from firmware_sim.plant import layout as at
from firmware_sim.scenario import parse_scenario
from firmware_sim.tables import pack, unpack
from firmware_sim.wire import Air

PERIOD = 11  # ms between samples of a block, as a session asks for
CTYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "i8": "int8_t", "i16": "int16_t", "i32": "int32_t",
          "fp16": "FP16", "float": "float"}  # fmt: skip
STYLES = ("hover", "figure8", "excite", "fast")  # fast: through waypoints
GUSTS = (0.05, 1.0)  # m/s, sd of the gusts where there are any
WIND_DRAG = 0.007  # N s/m where the drone has no drag of its own, as the simulator has it
FIRST, LASTING, PAUSE = 16.0, 6.0, 12.0  # s: the first fault; a fault lasts; from its end to the next
Sense = Callable[[Sample], Sample]


@dataclass(frozen=True)
class Event:
    """The onset or end of a fault.

    Attributes:
        kind: name in the table, "" for the end of a fault. expected: right names in the monitor's report.
        time: s of the drone's clock. size: in the table's unit.
        plant: called once with the simulated flight. sense: applied to every sample until the next event.
        payload: entry of the scenario's payload events.
    """

    kind: str
    expected: tuple[str, ...]
    time: float
    size: float = 0.0
    plant: Callable[[Any], None] | None = None
    sense: Sense | None = None
    payload: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True)
class World:
    """A drawn flight: the case, the vehicle file of the estimator, the events."""

    case: dict[str, Any]
    seed: int
    vehicle: Vehicle
    style: str
    gusts: float = 0.0
    events: tuple[Event, ...] = ()


def draw(seed: int, *, kinds: Sequence[str] = (), faults: int = 0) -> World:
    """A flight of a random world without hidden effects; hover, figure 8, excite and waypoints in turn.

    `faults`: number of faults, drawn from `kinds`.
    """
    random = np.random.default_rng([seed, 43])
    case = random_case(f"{seed:06d}", "nothing", {}, random)
    style = STYLES[seed % len(STYLES)]
    mine = conditions.flight(style, waypoints(style, random), random, case["own"].get("trim"))
    mine["size"] = size_of(style, random)
    sd = 0.0
    if random.random() < 0.5:
        sd = float(np.exp(random.uniform(*np.log(GUSTS))))
        mine["gusts"] = {"standard_deviation": sd, "correlation_time": float(random.uniform(0.3, 2.0))}
    case["flights"] = {"recording": mine}
    world = World(case, seed, parse_vehicle(case["vehicle"]), style, sd)
    events: list[Event] = []
    for i in range(faults):
        begin = FIRST + i * (LASTING + PAUSE) + float(random.uniform(0.0, 1.0))
        kind = kinds[int(random.integers(len(kinds)))]
        events += FAULTS[kind](world, random, begin, begin + LASTING)
    return replace(world, events=tuple(events))


def boot(world: World) -> Firmware:
    """The firmware of a flight, just booted."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "vehicle.toml").write_text(world.case["vehicle"])
        table = {**scenario_of(world.case, "recording"), "vehicle_file": "vehicle.toml"}
        payload = [dict(e.payload) for e in world.events if e.payload]
        if payload:
            table["payload"] = {"events": payload}
        scenario = parse_scenario(table, world.case["case"], folder=Path(folder))
    flight = Flight(scenario, world.seed)
    if world.events:  # the plant must compute effects that are neutral until an event
        flight._truth[[at.EFFECT_ROTORS, at.EFFECT_BODY, at.EFFECT_SENSING]] = 1.0
        flight._effects, flight._tick_step = True, tick_step_with_effects
    return Firmware(flight, platform=scenario.platform, seed=world.seed, parameters=scenario.parameters)


def samples(world: World, *, duration: float) -> Iterator[Sample]:
    """Samples for the estimator until the landing begins; ends early when the flight has failed."""
    firmware = boot(world)
    drone, contents = firmware.flight, firmware.log.table
    plan = block_plan(tuple(contents.by_name))
    blocks = tuple(
        Block(i, tuple(Variable(n, CTYPES[contents.by_name[n].kind]) for n in names), PERIOD)
        for i, names in enumerate(plan)
    )
    items = [[contents.by_name[n] for n in names] for names in plan]
    decode = decoders(blocks)
    random = np.random.default_rng([world.seed, 7])
    log = world.case["conditions"]["log"]
    air = Air(log["loss"], log["burst"], world.seed)
    nominal = [int(random.integers(PERIOD)) for _ in blocks]
    due = list(nominal)
    path = course(world.case["flights"]["recording"], duration)
    begin = round(1000 * BOOT)
    end = begin + round(1000 * path.end)  # a live session ends its estimate before the landing
    events = list(world.events)
    sense: Sense | None = None
    while drone.tick < end:
        tick = drone.tick
        if tick == begin - 500:
            firmware.supervisor.request_arming(True)
        if tick >= begin and tick % SETPOINT == 0:
            k = (tick - begin) // SETPOINT
            firmware.arbiter.offer(full_state(path, k), CRTP, tick)
            if path.start <= 1e-3 * (tick - begin) and astray(drone, path.position[k]):  # type: ignore[arg-type]
                return
        while events and 1e-3 * tick >= events[0].time:
            event = events.pop(0)
            sense = event.sense
            if event.plant is not None:
                event.plant(drone)
        firmware.advance(max(1, min((tick // SETPOINT + 1) * SETPOINT, *due) - tick))
        for i, variables in enumerate(items):
            if due[i] > drone.tick:
                continue
            lost = air.loses()
            nominal[i] += PERIOD
            late = 1 + int(random.exponential(1.5)) if random.random() < 0.05 else 0
            stamp = drone.tick
            due[i] = max(nominal[i] + min(late, PERIOD - 1), stamp + 1)
            if lost:
                continue
            values = tuple(unpack(pack(float(v.array[v.index]), v.kind), v.kind) for v in variables)
            for sample in decode[i].decode(Packet(i, stamp, 1e-3 * stamp, values)):
                yield sample if sense is None else sense(sample)


# possible faults: (world, random numbers, s of the onset, s of the end) -> events


def _lose(rotor: int, scale: float) -> Callable[[Any], None]:
    def plant(drone: Any) -> None:
        drone._truth[at.FAULT_ROTOR], drone._truth[at.FAULT_SCALE], drone._truth[at.FAULT_ONSET] = rotor, scale, 0.0

    return plant


def _rotor(loss: float) -> Any:
    def make(world: World, random: np.random.Generator, begin: float, end: float) -> list[Event]:
        rotor = int(random.integers(1, 5))
        kind = f"rotor {100 * loss:.0f} %"
        return [
            Event(kind, (f"rotor_fault {rotor}",), begin, loss, _lose(rotor, 1.0 - loss)),
            Event("", (), end, plant=_lose(0, 1.0)),
        ]

    return make


def _wind(speed: float) -> Any:
    def make(world: World, random: np.random.Generator, begin: float, end: float) -> list[Event]:
        angle = float(random.uniform(-math.pi, math.pi))
        change = speed * np.array([math.cos(angle), math.sin(angle)])

        def blow(sign: float) -> Callable[[Any], None]:
            def plant(drone: Any) -> None:
                truth = drone._truth
                if not truth[at.LINEAR_DRAG] and not truth[at.QUADRATIC_DRAG]:
                    truth[at.WIND_DRAG] = WIND_DRAG
                truth[at.WIND : at.WIND + 2] += sign * change

            return plant

        return [Event(f"wind {speed:g} m/s", ("wind",), begin, plant=blow(1.0)), Event("", (), end, plant=blow(-1.0))]

    return make


def _payload(share: float) -> Any:
    def make(world: World, random: np.random.Generator, begin: float, end: float) -> list[Event]:
        mass = share * world.vehicle.mass
        place = (*random.uniform(-0.005, 0.005, 2).tolist(), -0.01)
        attach = (("action", "attach"), ("time", begin), ("mass", mass), ("position", list(place)))
        names = ("payload", "payload_off_centre", "thrust_scale")  # a flight shows only the ratio of mass and thrust
        return [
            Event(f"payload {100 * share:.0f} %", names, begin, mass, payload=attach),
            Event("", (), end, payload=(("action", "release"), ("time", end))),
        ]

    return make


def _battery(world: World, random: np.random.Generator, begin: float, end: float) -> list[Event]:
    """All rotors lose 15 % of their thrust, and the logged voltage does not show it."""

    def scale(by: float) -> Callable[[Any], None]:
        def plant(drone: Any) -> None:
            drone._truth[at.THRUST_SCALE] *= by

        return plant

    names = ("thrust_scale", "payload", "payload_off_centre")
    return [Event("thrust 15 %", names, begin, 0.15, scale(0.85)), Event("", (), end, plant=scale(1 / 0.85))]


def _sensed(kind: str, signal: str, expected: tuple[str, ...], change: Callable[[float, int], Any]) -> Any:
    """A fault of a sensor; `change` (random sign, axis) gives the map from value to value."""

    def make(world: World, random: np.random.Generator, begin: float, end: float) -> list[Event]:
        convert = change(float(random.choice((-1.0, 1.0))), int(random.integers(3)))

        def sense(sample: Sample) -> Sample:
            return sample if sample.signal != signal else replace(sample, value=convert(sample.value))

        return [Event(kind, expected, begin, sense=sense), Event("", (), end)]

    return make


def _added(size: float) -> Callable[[float, int], Any]:
    def of(sign: float, axis: int) -> Any:
        return lambda value: tuple(v + (sign * size if i == axis else 0.0) for i, v in enumerate(value))

    return of


def _stuck(sign: float, axis: int) -> Any:
    kept: list[tuple[float, ...]] = []

    def keep(value: tuple[float, ...]) -> tuple[float, ...]:
        kept[1:] = []
        if not kept:
            kept.append(value)
        return kept[0]

    return keep


FAULTS: dict[str, Any] = {
    "rotor 10 %": _rotor(0.10),
    "rotor 5 %": _rotor(0.05),
    "payload 20 %": _payload(0.20),
    "payload 10 %": _payload(0.10),
    "thrust 15 %": _battery,
    "wind 3 m/s": _wind(3.0),
    "wind 1 m/s": _wind(1.0),
    "gyro biased 0.1 rad/s": _sensed("gyro biased 0.1 rad/s", "body_rate", ("gyro_bias",), _added(0.1)),
    "position jumps 0.1 m": _sensed("position jumps 0.1 m", "position", ("position_offset",), _added(0.1)),
    "velocity biased 0.2 m/s": _sensed("velocity biased 0.2 m/s", "velocity", ("velocity_offset",), _added(0.2)),
    "gyro counts 1.5 times": _sensed(
        "gyro counts 1.5 times", "body_rate", ("gyro_scale",), lambda sign, axis: lambda v: tuple(1.5 * x for x in v)
    ),
    "gyro stuck": _sensed("gyro stuck", "body_rate", ("stuck body_rate",), _stuck),
    "velocity stuck": _sensed("velocity stuck", "velocity", ("stuck velocity",), _stuck),
}
