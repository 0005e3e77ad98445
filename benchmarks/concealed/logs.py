"""The log of a simulated flight: blocks of firmware variables (MCAP), or one table of a motion capture (CSV).

Blocks are sampled by separate timers as in the firmware: with different phases, one sample in twenty late.
"""

import csv
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from crazyem.recordings.mcap.writer import RecordingWriter
from crazyem.signals.sample import Block, Packet, Variable
from firmware_sim.tables import Table as Contents
from firmware_sim.tables import pack, unpack
from firmware_sim.wire import Air

Table = dict[str, Any]
EPOCH = 1.7e9  # s, host time of the first millisecond: arbitrary, the same in every flight
LATE, LATE_MEAN = 0.05, 1.5  # share of late samples, mean delay [ms] (firmware_sim/services/log.py)
OTHERS = 20  # ms, period of variables that are neither state nor command
CTYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "i8": "int8_t", "i16": "int16_t", "i32": "int32_t",
          "fp16": "FP16", "float": "float"}  # fmt: skip


def _of(group: str, names: str) -> list[str]:
    return [f"{group}.{n}" for n in names.split()]


def blocks_of(log: Table) -> list[tuple[list[str], int]]:
    """Variables and period [ms] of each block of a drawn log."""
    attitude, state, command = bool(log["attitude"]), int(log["period"]), int(log["command_period"])
    motors = _of("motor", "m1 m2 m3 m4")
    speeds = _of("motor", "m1_rpm m2_rpm m3_rpm m4_rpm") if log["rotor_speed"] else []
    volts = ["pm.vbatMV"] if log["voltage"] else []
    gyro, acc = _of("gyro", "x y z"), _of("acc", "x y z") if log["accelerometer"] else []
    small = _of("stateEstimateZ", "x y z vx vy vz")
    floats = _of("stateEstimate", "x y z vx vy vz")
    quaternion = _of("stateEstimate", "qx qy qz qw") if attitude else []
    compressed = ["stateEstimateZ.quat"] if attitude else []
    told = ["supervisor.info"]
    if log["layout"] == "card":  # the logging deck writes all variables in one row
        return [([*floats, *quaternion, *gyro, *acc, *motors, *speeds, *volts, *told], state)]
    commands = ([*motors, *speeds, *volts, *told], command)
    if log["layout"] == "compact":
        rates = _of("stateEstimateZ", "rateRoll ratePitch rateYaw")
        out = [([*small, *compressed, *rates], state), commands]
        return out + ([(acc, max(OTHERS, state))] if acc else [])
    if log["layout"] == "floats":
        out = [(floats, state), ([*gyro, *acc], state), commands]
        return out + ([(quaternion, state)] if quaternion else [])
    return [([*small, *compressed], state), ([*gyro, *acc], state), commands]


class BlockLog:
    """Samples blocks of log variables into a recording.

    Args:
        file: to write. contents: the firmware's table. log: as drawn. seed: of phases, late samples and losses.
    """

    suffix = ".mcap"

    def __init__(self, file: Path, contents: Contents, log: Table, seed: int) -> None:
        self._random = np.random.default_rng([seed, 7])
        self._air = Air(log["loss"], log["burst"], seed)
        wanted = blocks_of(log)
        self._items = [[contents.by_name[n] for n in names] for names, _ in wanted]
        self._periods = [period for _, period in wanted]
        self._nominal = [int(self._random.integers(period)) for period in self._periods]
        self._due = list(self._nominal)
        self._writer = RecordingWriter(file, metadata={"configuration": {"command": json.dumps("fly")}})
        self._writer.blocks([
            Block(i, tuple(Variable(item.name, CTYPES[item.kind]) for item in items), period)
            for i, (items, period) in enumerate(zip(self._items, self._periods))
        ])  # fmt: skip
        self.written = self.lost = 0

    def next_due(self) -> int:
        """The tick [ms] of the next sample."""
        return min(self._due)

    def sample(self, tick: int, **_: Any) -> None:
        """Take the samples that are due at this tick."""
        for i, items in enumerate(self._items):
            if self._due[i] > tick:
                continue
            if self._air.loses():
                self.lost += 1
            else:
                values = tuple(unpack(pack(float(v.array[v.index]), v.kind), v.kind) for v in items)
                self._writer.packet(Packet(i, tick, EPOCH + 1e-3 * tick, values))
                self.written += 1
            period = self._periods[i]
            self._nominal[i] += period
            late = 1 + int(self._random.exponential(LATE_MEAN)) if self._random.random() < LATE else 0
            self._due[i] = max(self._nominal[i] + min(late, period - 1), tick + 1)

    def close(self) -> None:
        self._writer.close()


# name -> (signal, columns, more of its entry) in a mapping
SIGNALS: dict[str, tuple[tuple[str, ...], str]] = {
    "position": (("x", "y", "z"), 'unit = "m"'),
    "velocity": (("vx", "vy", "vz"), 'unit = "m/s"'),
    "attitude": (("qx", "qy", "qz", "qw"), 'order = "xyzw"'),
    "body_rate": (("wx", "wy", "wz"), 'unit = "rad/s"'),
    "specific_force": (("ax", "ay", "az"), 'unit = "m/s^2"'),
    "motor_command": (("m1", "m2", "m3", "m4"), 'unit = "1"'),
    "rotor_speed": (("w1", "w2", "w3", "w4"), 'unit = "rad/s"'),
    "voltage": (("volts",), 'unit = "V"'),
}


ROTORS_OF = ("motor_command", "rotor_speed")


def mapping_of(signals: Iterable[str], *, onboard: bool, rotors: Sequence[int] = ()) -> str:
    """The mapping (docs/reference/formats/csv.md) of a table with these signals.

    onboard: the attitude is from an onboard filter. rotors: the rotor of each of the four columns.
    """
    lines = ["[time]", 'column = "t"', 'unit = "s"', 'clock = "drone"']
    for name in signals:
        columns, more = SIGNALS[name]
        lines += ["", f"[signals.{name}]", f"columns = {json.dumps(list(columns))}", more]
        lines += [f"rotors = {json.dumps(list(rotors))}"] if rotors and name in ROTORS_OF else []
    if onboard:
        lines += ["", "[claims]", 'attitude = "onboard"']
    return "\n".join(lines) + "\n"


def write_table(file: Path, time: Sequence[float], signals: dict[str, np.ndarray]) -> None:
    """A CSV of rows: `time` (n,) [s] and every signal (n, k) in SI; a row's fields are empty where not a number."""
    with file.open("w", newline="") as text:
        rows = csv.writer(text)
        rows.writerow(["t", *(c for name in signals for c in SIGNALS[name][0])])
        table = np.column_stack([np.asarray(v, float).reshape(len(time), -1) for v in signals.values()])
        for t, values in zip(time, table.tolist()):
            rows.writerow([f"{t:.6f}", *("" if math.isnan(v) else f"{v:.7g}" for v in values)])
