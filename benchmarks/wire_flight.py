"""A flight of the simulated firmware in this process, without sockets or clocks: bytes in, log packets out.

Commands and log packets have the bytes of the wire; only the host's time is left out. So a flight of 35 s takes a
second or two, does not depend on the machine's load, and is always the same. The truth is in the scenario.
"""

import math
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.control.trajectories import Reference, Trajectory, after_hover
from crazyem.live.session import LOG_RATE
from crazyem.signals.sample import Block, Packet, Sample, Variable
from crazyem.signals.vocabulary import block_plan, compress_quaternion, decoders
from firmware_sim import wire
from firmware_sim.firmware import Firmware
from firmware_sim.flight import Flight
from firmware_sim.scenario import Scenario

HEIGHT = 1.0  # m
BASELINE = 2.0  # s of hover before the trajectory, as `crazyem fly` has it
# Setpoints as `crazyem fly` sends them, with the jitter seen in its recordings (a tenth 0.9 ms late, a tenth early). At
# the rate of the log their steps would keep their place between two log samples (crazyem/live/clock.py).
SETPOINT_PERIOD, SETPOINT_JITTER = 7.0, 0.8  # ms
LOG_PERIOD = round(1000.0 / LOG_RATE)  # ms
LEE = 5  # stabilizer.controller
_CTYPES = {1: "uint8_t", 2: "uint16_t", 3: "uint32_t", 4: "int8_t", 5: "int16_t", 6: "int32_t", 7: "float", 8: "FP16"}
_FORMATS = {1: "B", 2: "H", 3: "I", 4: "b", 5: "h", 6: "i", 7: "f", 8: "e"}


@dataclass(frozen=True)
class Log:
    """The log packets of one flight.

    Attributes:
        names: of each block's variables.
        types: their types, as numbers of the wire.
        stamps: of each block (n,) ms.
        values: of each block (n, variables).
        start, end: of the trajectory [s].
        order: (packets,) block of each packet in order of arrival.
    """

    names: tuple[tuple[str, ...], ...]
    types: tuple[tuple[int, ...], ...]
    stamps: tuple[NDArray, ...]
    values: tuple[NDArray, ...]
    order: NDArray
    start: float
    end: float

    def samples(self) -> Iterator[Sample]:
        """Samples as a link delivers them, in order of arrival."""
        blocks = [
            Block(i, tuple(Variable(n, _CTYPES[t]) for n, t in zip(names, types)), LOG_PERIOD)
            for i, (names, types) in enumerate(zip(self.names, self.types))
        ]
        decode = decoders(blocks)
        at = [0] * len(blocks)
        for i in self.order.tolist():
            k = at[i]
            at[i] += 1
            packet = Packet(i, int(self.stamps[i][k]), 0.0, tuple(self.values[i][k].tolist()))
            yield from decode[i].decode(packet)

    def save(self, path: Path) -> None:
        """Write to an .npz file (no pickles)."""
        arrays: dict[str, Any] = {"order": self.order, "span": np.array([self.start, self.end])}
        for i in range(len(self.names)):
            arrays |= {f"names{i}": np.array(self.names[i]), f"types{i}": np.array(self.types[i])}
            arrays |= {f"stamps{i}": self.stamps[i], f"values{i}": self.values[i]}
        np.savez_compressed(path, **arrays)

    @classmethod
    def load(cls, path: Path) -> "Log":
        """Inverse of `save`."""
        with np.load(path, allow_pickle=False) as file:
            count = sum(name.startswith("stamps") for name in file.files)
            return cls(
                tuple(tuple(file[f"names{i}"].tolist()) for i in range(count)),
                tuple(tuple(file[f"types{i}"].tolist()) for i in range(count)),
                tuple(file[f"stamps{i}"] for i in range(count)),
                tuple(file[f"values{i}"] for i in range(count)),
                file["order"],
                *file["span"].tolist(),
            )


class Client:
    """A client of a simulated firmware that sends bytes; time passes only in `wait`."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        flight = Flight(scenario, seed)
        parameters = dict(scenario.parameters)
        self.firmware = Firmware(flight, platform=scenario.platform, seed=seed, parameters=parameters)
        self.firmware.advance(500)
        self.send(wire.LINK, 0, b"")
        self.packets: list[bytes] = []

    def send(self, port: int, channel: int, data: bytes) -> None:
        """One packet to the drone."""
        packet = wire.decode(wire.encode(port, channel, data))
        assert packet is not None
        self.firmware.receive(packet)

    def wait(self, milliseconds: int) -> None:
        """Let time pass; keep log packets and drop the others."""
        self.firmware.advance(milliseconds)
        for datagram, _ in self.firmware.outbox:
            packet = wire.decode(datagram)
            if packet is not None and (packet.port, packet.channel) == (wire.LOG, 2):
                self.packets.append(packet.data)
        self.firmware.outbox.clear()

    def log(self, plan: Iterable[tuple[str, ...]]) -> list[list[int]]:
        """Create and start a block for each tuple of names; the types of their variables."""
        items = {item.name: (number, item) for number, item in enumerate(self.firmware.log.table.items)}
        types = []
        for block, names in enumerate(plan):
            kinds = [items[name][1].type_byte & 0x0F for name in names]
            entries = [struct.pack("<BH", kind, items[name][0]) for name, kind in zip(names, kinds)]
            self.send(wire.LOG, 1, bytes((6, block)) + b"".join(entries[:9]))
            if entries[9:]:
                self.send(wire.LOG, 1, bytes((7, block)) + b"".join(entries[9:]))
            self.send(wire.LOG, 1, bytes((8, block)) + struct.pack("<H", LOG_PERIOD))
            types.append(kinds)
        return types

    def set(self, name: str, value: float) -> None:
        """Write a parameter that is a float."""
        numbers = [item.name for item in self.firmware.param.table.items]
        self.send(wire.PARAM, 2, struct.pack("<Hf", numbers.index(name), value))

    def full_state(self, r: Reference) -> None:
        """A full-state setpoint."""
        values = [round(1000 * v) for v in (*r.position, *r.velocity, *r.acceleration)]
        rates = (0, 0, round(1000 * r.yaw_rate))
        packed = struct.pack("<B9hI3h", 6, *values, compress_quaternion(r.quaternion), *rates)
        self.send(wire.SETPOINT_GENERIC, 0, packed)


def fly(
    scenario: Scenario, seed: int, trajectory: Trajectory, *, beliefs: dict[str, float], correction: float = 5.0
) -> Log:
    """Take off to 1 m, hover 2 s, fly the trajectory under the Lee controller, and log what `crazyem fly` logs.

    Args:
        scenario: the truth. seed: of all noise.
        trajectory: around (0, 0, 1) m.
        beliefs: parameters written `correction` seconds into the trajectory, as pushes would.

    Raises:
        RuntimeError: the drone did not stay in the air.
    """
    client = Client(scenario, seed)
    table = [item.name for item in client.firmware.log.table.items]
    plan = [names for names in block_plan(table) if not any("thrustSi" in n for n in names)]
    plan = [tuple(n for n in names if "_rpm" not in n) for names in plan]
    types = client.log(plan)
    controller = [item.name for item in client.firmware.param.table.items].index("stabilizer.controller")
    client.send(wire.PARAM, 2, struct.pack("<HB", controller, LEE))
    client.send(wire.SUPERVISOR, 1, bytes((1, 1)))  # arm
    client.wait(200)
    client.send(wire.SETPOINT_HIGH_LEVEL, 0, struct.pack("<BBff?f", 7, 0, HEIGHT, 0.0, False, 1.0 + HEIGHT))
    client.wait(2500)
    path = after_hover(trajectory, seconds=BASELINE)
    begin = client.firmware.flight.tick
    late = np.random.default_rng([seed, 0x5E7]).normal(
        0.0, SETPOINT_JITTER, math.ceil(1000 * path.duration / SETPOINT_PERIOD)
    )
    corrected = False
    for count, jitter in enumerate(late.tolist()):
        client.wait(max(0, begin + round(count * SETPOINT_PERIOD + jitter) - client.firmware.flight.tick))
        elapsed = 1e-3 * (client.firmware.flight.tick - begin)
        client.full_state(path.at(elapsed))
        if not corrected and elapsed >= BASELINE + correction:
            corrected = True
            for name, value in beliefs.items():
                client.set(name, value)
    truth = client.firmware.flight.truth_row()
    if not 0.5 < truth[3] < 1.5:
        raise RuntimeError(f"the flight of seed {seed} ended at a height of {truth[3]:.2f} m")
    return _log_of(plan, types, client.packets, begin, client.firmware.flight.tick)


def _log_of(plan: list[tuple[str, ...]], types: list[list[int]], packets: list[bytes], begin: int, end: int) -> Log:
    order, stamps, values = [], [[] for _ in plan], [[] for _ in plan]  # type: ignore[var-annotated]
    formats = [struct.Struct("<" + "".join(_FORMATS[t] for t in kinds)) for kinds in types]
    for data in packets:
        block = data[0]
        order.append(block)
        stamps[block].append(int.from_bytes(data[1:4], "little"))
        values[block].append(formats[block].unpack(data[4:]))
    return Log(
        tuple(plan), tuple(map(tuple, types)), tuple(np.array(s, np.int64) for s in stamps),
        tuple(np.array(v, float) for v in values), np.array(order, np.int64), 1e-3 * begin, 1e-3 * end,
    )  # fmt: skip
