"""Messages that the simulated autopilot streams, made from the firmware's log variables, in MAVLink's frames.

MAVLink uses FRD and north-east-down; our x axis is north. Half a turn about x converts either way: y and z change
their signs.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from firmware_sim.commander import setpoint as sp
from firmware_sim.tables import Slot

# PX4's motors 1..4 of an X quad: front right, back left, front left, back right; index of the simulator's rotor
ROTOR = (0, 2, 3, 1)


def turned(v: Sequence[float]) -> tuple[float, float, float]:
    """A vector, converted either way."""
    return v[0], -v[1], -v[2]


def turned_quaternion(x: float, y: float, z: float, w: float) -> tuple[float, float, float, float]:
    """w, x, y, z of body FRD to NED from x, y, z, w of body FLU to north-west-up; w is never negative."""
    sign = -1.0 if w < 0.0 else 1.0
    return sign * w, sign * x, -sign * y, -sign * z


def angles(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Roll, pitch, yaw [rad], ZYX, of a quaternion."""
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


def px4_order(values: Sequence[float]) -> tuple[float, ...]:
    """Values of the simulator's rotors in PX4's order."""
    return tuple(values[i] for i in ROTOR)


GRAVITY = 9.81
UNKNOWN = 65535
UID = b"crazyem firmware"  # tells a client that the drone is simulated


class EscStatus(mavlink.MAVLink_message):
    """ESC_STATUS of common.xml, which pymavlink 2.4.50 does not have."""

    id = 291
    msgname = "ESC_STATUS"
    crc_extra = 10

    def __init__(self, time_usec: int, rpm: tuple[float, ...]) -> None:
        super().__init__(291, "ESC_STATUS")
        self._values = (time_usec, *(round(v) for v in rpm), *(0.0,) * 8, 0)

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """The frame."""
        import struct

        return bytes(self._pack(mav, self.crc_extra, struct.pack("<Q4i8fB", *self._values), force_mavlink1))


class Telemetry:
    """Makes messages. log: the firmware's variables. state: landed state and modes, set by the autopilot."""

    def __init__(self, log: Mapping[str, Slot], *, tick: Callable[[], int], beat: Callable[[], Any]) -> None:
        self._log, self._tick, self._beat = log, tick, beat
        self.landed = 1
        self.setpoint: Any = None
        self.makers: dict[int, Callable[[], Any]] = {
            0: beat,
            1: self._system,
            30: self._attitude,
            31: self._quaternion,
            32: self._position,
            85: self._target,
            105: self._imu,
            147: self._battery,
            148: self._version,
            245: lambda: mavlink.MAVLink_extended_sys_state_message(0, self.landed),
            375: self._actuators,
        }
        if "motor.m1_rpm" in log:
            self.makers[291] = self._speeds

    def get(self, *names: str) -> list[float]:
        """Values of log variables."""
        return [float(array[index]) for array, index in (self._log[n] for n in names)]

    def _us(self) -> int:
        return self._tick() * 1000

    def _q(self) -> tuple[float, float, float, float]:
        x, y, z, w = self.get(*(f"stateEstimate.q{a}" for a in "xyzw"))
        return turned_quaternion(x, y, z, w)

    def _rates(self) -> tuple[float, float, float]:
        return turned([math.radians(v) for v in self.get("gyro.x", "gyro.y", "gyro.z")])

    def _attitude(self) -> Any:
        return mavlink.MAVLink_attitude_message(self._tick(), *angles(*self._q()), *self._rates())

    def _quaternion(self) -> Any:
        return mavlink.MAVLink_attitude_quaternion_message(self._tick(), *self._q(), *self._rates())

    def position(self) -> tuple[float, float, float]:
        """Estimated, m, north-west-up."""
        x, y, z = self.get("stateEstimate.x", "stateEstimate.y", "stateEstimate.z")
        return x, y, z

    def _position(self) -> Any:
        velocity = self.get("stateEstimate.vx", "stateEstimate.vy", "stateEstimate.vz")
        return mavlink.MAVLink_local_position_ned_message(self._tick(), *turned(self.position()), *turned(velocity))

    def _imu(self) -> Any:
        acceleration = turned([v * GRAVITY for v in self.get("acc.x", "acc.y", "acc.z")])
        rest = (0.0,) * 7
        return mavlink.MAVLink_highres_imu_message(self._us(), *acceleration, *self._rates(), *rest, 63)

    def _actuators(self) -> Any:
        duty = px4_order([v / 65535.0 for v in self.get(*(f"motor.m{n}" for n in range(1, 5)))])
        return mavlink.MAVLink_actuator_output_status_message(self._us(), 4, [*duty, *(0.0,) * 28])

    def _speeds(self) -> Any:
        speeds = [0.0 if v == UNKNOWN else v for v in self.get(*(f"motor.m{n}_rpm" for n in range(1, 5)))]
        return EscStatus(self._us(), px4_order(speeds))

    def _millivolts(self) -> int:
        return min(max(round(1000.0 * self.get("pm.vbat")[0]), 0), UNKNOWN - 1)

    def _percent(self) -> int:
        return min(max(round(self.get("pm.batteryLevel")[0]), 0), 100)

    def _battery(self) -> Any:
        cells = [self._millivolts(), *(UNKNOWN,) * 9]
        return mavlink.MAVLink_battery_status_message(0, 0, 3, 32767, cells, -1, -1, -1, self._percent())

    def _system(self) -> Any:
        return mavlink.MAVLink_sys_status_message(
            0, 0, 0, 0, self._millivolts(), -1, self._percent(), 0, 0, 0, 0, 0, 0
        )  # fmt: skip

    def _version(self) -> Any:
        nothing = [0] * 8
        return mavlink.MAVLink_autopilot_version_message(
            1 << 13, 0x010F0000, 0, 0, 0, nothing, nothing, nothing, 0, 0, 1, list(UID.ljust(18, b"\0"))
        )

    def _target(self) -> Any:
        """The present setpoint, which PX4 streams only under position control."""
        s = self.setpoint
        if s is None or s[sp.MODE_X] != sp.ABSOLUTE or s[sp.MODE_Z] != sp.ABSOLUTE:
            return None
        place, speed = turned(s[sp.X : sp.Z + 1].tolist()), turned(s[sp.VX : sp.VZ + 1].tolist())
        acceleration = turned(s[sp.AX : sp.AZ + 1].tolist())
        yaw = -math.radians(float(s[sp.YAW]))
        return mavlink.MAVLink_position_target_local_ned_message(
            self._tick(), 1, 0, *place, *speed, *acceleration, yaw, 0.0
        )
