"""Flies a case of a random world in this process, without link and clock: the same case gives the same file.

Firmware, controllers and plant are those of `python -m firmware_sim`; setpoints enter after the decoding of packets.
The logged signals are drawn with the case (`conditions.log`).
"""

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_sim.commander import setpoint as sp
from firmware_sim.commander.setpoint import CRTP
from firmware_sim.firmware import Firmware
from firmware_sim.flight import Flight
from firmware_sim.scenario import parse_scenario

from .courses import STOPPED, Course, course
from .logs import BlockLog, mapping_of, write_table
from .random_world import scenario_of

Table = dict[str, Any]
BOOT = 1.5  # s of the clock before the motors start
SETPOINT = 10  # ms
LOWEST, STEEPEST, FARTHEST = 0.06, math.radians(70), 1.5  # m, tilt, m off the course; beyond, the flight has failed
UNREADABLE = 65535.0  # reported rpm of a telegram with a wrong checksum
RPM = 2.0 * math.pi / 60.0


class PoseLog:
    """The table of a laboratory without an onboard estimate: pose of motion capture and gyro, one time stamp a row."""

    suffix = ".csv"

    def __init__(self, firmware: Firmware, flight: Flight, case: Table, seed: int) -> None:
        self._firmware, self._flight = firmware, flight
        self._log, self._noise = case["conditions"]["log"], case["conditions"]["scenario"]["estimator"]
        self._random = np.random.default_rng([seed, 8])
        self._period = int(self._log["period"])
        self._due = int(self._random.integers(self._period))
        self._drift = np.zeros(6)
        self._rows: list[list[float]] = []
        self._time: list[float] = []
        self.written = self.lost = 0

    def next_due(self) -> int:
        return self._due

    def _read(self, *names: str, by: float = 1.0) -> list[float]:
        items = self._firmware.log.table.by_name
        return [by * float(items[n].array[items[n].index]) for n in names]

    def sample(self, tick: int, **_: Any) -> None:
        """One row, if it is due and not lost."""
        if tick < self._due:
            return
        self._due += self._period
        drift, white = self._log["drift"], self._random.standard_normal(6)
        keep = math.exp(-1e-3 * self._period / drift["time"])
        self._drift = keep * self._drift + math.sqrt(1.0 - keep * keep) * drift["share"] * self._random.standard_normal(
            6
        )
        size = np.repeat([self._noise["position_noise"], self._noise["attitude_noise"]], 3)
        error = size * (white + self._drift)
        if self._random.random() < self._log["loss"]:
            self.lost += 1
            return
        position, quaternion = self._flight.seen_pose()
        row = [*(position + error[:3])]
        if self._log["attitude"]:
            row += turned(quaternion, error[3:]).tolist()
        row += self._read("gyro.x", "gyro.y", "gyro.z", by=math.pi / 180.0)
        if self._log["accelerometer"]:
            row += self._read("acc.x", "acc.y", "acc.z", by=9.81)
        row += self._read("motor.m1", "motor.m2", "motor.m3", "motor.m4", by=1.0 / 65535.0)
        if self._log["rotor_speed"]:
            speeds = self._read(*(f"motor.m{i}_rpm" for i in range(1, 5)))
            row += [math.nan if rpm >= UNREADABLE else RPM * rpm for rpm in speeds]
        if self._log["voltage"]:
            row += self._read("pm.vbat")
        self._rows.append(row)
        self._time.append(1e-3 * tick)
        self.written += 1

    def signals(self) -> list[str]:
        """Names of what each row holds."""
        wanted = ("attitude", "accelerometer", "rotor_speed", "voltage")
        kept = {name: bool(self._log[name]) for name in wanted}
        names = ["position", *(["attitude"] if kept["attitude"] else []), "body_rate"]
        names += ["specific_force"] if kept["accelerometer"] else []
        return [*names, "motor_command", *(n for n in ("rotor_speed", "voltage") if kept[n])]

    def write(self, file: Path) -> None:
        widths = {"attitude": 4, "motor_command": 4, "rotor_speed": 4, "voltage": 1}
        table, at, signals = np.array(self._rows), 0, {}
        for name in self.signals():
            width = widths.get(name, 3)
            signals[name] = table[:, at : at + width]
            at += width
        write_table(file, self._time, signals)
        file.with_name("mapping.toml").write_text(mapping_of(self.signals(), onboard=False))


def turned(quaternion: NDArray, by: NDArray) -> NDArray:
    """x y z w, turned by a small rotation vector in its own axes."""
    x, y, z, w = quaternion
    a, b, c = 0.5 * by
    out = np.array([x + w * a + y * c - z * b, y + w * b + z * a - x * c, z + w * c + x * b - y * a,
                    w - x * a - y * b - z * c])  # fmt: skip
    return out / np.linalg.norm(out)


def full_state(path: Course, k: int) -> NDArray:
    """The setpoint of row k of a course, as a full-state packet decodes to."""
    out = sp.null_setpoint()
    out[sp.MODE_X] = out[sp.MODE_Y] = out[sp.MODE_Z] = sp.ABSOLUTE
    out[sp.X : sp.X + 3] = path.position[k]
    out[sp.VX : sp.VX + 3] = path.velocity[k]
    out[sp.AX : sp.AX + 3] = path.acceleration[k]
    out[sp.MODE_QUAT] = sp.ABSOLUTE
    half = 0.5 * path.yaw[k]
    out[sp.QX : sp.QW + 1] = 0.0, 0.0, math.sin(half), math.cos(half)
    out[sp.RATE_YAW] = math.degrees(path.yaw_rate[k])
    return out


def boot(case: Table, flight: str) -> Firmware:
    """The firmware of one flight of a case, just booted."""
    seed = int(case["flights"][flight]["seed"])
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "vehicle.toml").write_text(case["vehicle"])
        table = {**scenario_of(case, flight), "vehicle_file": "vehicle.toml"}
        scenario = parse_scenario(table, case["case"], folder=Path(folder))
    return Firmware(Flight(scenario, seed), platform=scenario.platform, seed=seed, parameters=scenario.parameters)


def fly(case: Table, flight: str, folder: Path, *, duration: float) -> Table:
    """Record one flight into `folder`/{flight}.mcap or .csv (with mapping.toml); returns its quality.

    Returns {"flown": False, "reason": ...} and writes no file if the drone crashed, turned over or left its course.
    """
    firmware = boot(case, flight)
    drone, mine, log = firmware.flight, case["flights"][flight], case["conditions"]["log"]
    assert isinstance(drone, Flight)
    path, seed = course(mine, duration), int(mine["seed"])
    folder.mkdir(parents=True, exist_ok=True)
    onboard = log["estimate"] == "kalman"
    part = folder / f"{flight}.part"
    recorder: Any = BlockLog(part, firmware.log.table, log, seed) if onboard else PoseLog(firmware, drone, case, seed)
    begin = round(1000 * BOOT)
    end = begin + SETPOINT * len(path.time)
    reason, worst = "", 0.0
    while drone.tick < end + round(1000 * STOPPED):
        tick = drone.tick
        if tick == begin - 500:
            firmware.supervisor.request_arming(True)
        if tick >= begin and tick % SETPOINT == 0:
            k = (tick - begin) // SETPOINT
            wanted = full_state(path, k) if tick < end else sp.null_setpoint()
            firmware.arbiter.offer(wanted, CRTP, tick)
            if path.start <= 1e-3 * (tick - begin) <= path.end:
                reason = astray(drone, path.position[k])
                worst = max(worst, float(np.linalg.norm(drone.truth_row()[1:4] - path.position[k])))
                if reason:
                    break
        firmware.advance(max(1, min((tick // SETPOINT + 1) * SETPOINT, recorder.next_due()) - tick))
        recorder.sample(drone.tick)
    if onboard:
        recorder.close()
    if reason:
        part.unlink(missing_ok=True)
        return {"flown": False, "reason": reason}
    if onboard:
        part.replace(folder / f"{flight}.mcap")
    else:
        recorder.write(folder / f"{flight}.csv")
    marks = {"trajectory_start": BOOT + path.start, "trajectory_end": BOOT + path.end}
    return {"flown": True, "received": recorder.written, "lost": recorder.lost, "marks": marks, "off_course_m": worst}


def astray(drone: Flight, wanted: NDArray) -> str:
    """The reason why the flight has failed; empty while it has not."""
    row = np.array(drone.truth_row())
    x, y = row[8:10]
    tilt = math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y))))
    if row[3] < LOWEST:
        return f"came down to {row[3]:.2f} m"
    if tilt > STEEPEST:
        return f"tilted by {math.degrees(tilt):.0f} degrees"
    if np.linalg.norm(row[1:4] - wanted) > FARTHEST:
        return f"{np.linalg.norm(row[1:4] - wanted):.1f} m off its course"
    return ""
