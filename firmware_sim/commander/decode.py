"""Setpoint packets (ports 3 and 7) into setpoint arrays.

Source: crazyflie-firmware crtp_commander_rpyt.c, crtp_commander_generic.c, quatcompress.h.
"""

import math
import struct
from collections.abc import Callable

import numpy as np

from firmware_sim.commander import setpoint as sp

_MIN_THRUST, _MAX_THRUST = 1000, 60000  # PWM units

STOP, VELOCITY_LEGACY, Z_DISTANCE_LEGACY, ALTITUDE_HOLD, HOVER_LEGACY = 0, 1, 2, 4, 5
FULL_STATE, POSITION, VELOCITY_WORLD, Z_DISTANCE, HOVER, MANUAL = 6, 7, 8, 9, 10, 11


def decompress_quaternion(packed: int) -> tuple[float, float, float, float]:
    """The quaternion (x, y, z, w) of its 32-bit smallest-three form.

    Bits 30-31: index of the largest component; then for the others, in order, a sign bit and a 9-bit magnitude with
    511 standing for 1/sqrt(2). Step 0.00138 per component.
    """
    largest = packed >> 30 & 3
    values = [0.0, 0.0, 0.0, 0.0]
    total = 0.0
    for index in (3, 2, 1, 0):
        if index != largest:
            magnitude = (packed & 0x1FF) / 511.0 * math.sqrt(0.5)
            values[index] = -magnitude if packed >> 9 & 1 else magnitude
            packed >>= 10
            total += values[index] ** 2
    values[largest] = math.sqrt(max(0.0, 1.0 - total))
    return values[0], values[1], values[2], values[3]


def _yaw_rate(out: np.ndarray, rate: float) -> None:
    out[sp.MODE_YAW] = sp.VELOCITY
    out[sp.RATE_YAW] = rate


def _tilt(out: np.ndarray, roll: float, pitch: float) -> None:
    out[sp.MODE_ROLL] = out[sp.MODE_PITCH] = sp.ABSOLUTE
    out[sp.ROLL], out[sp.PITCH] = roll, pitch


def _height(out: np.ndarray, z: float) -> None:
    out[sp.MODE_Z], out[sp.Z] = sp.ABSOLUTE, z


def _velocity(out: np.ndarray, data: bytes, sign: float) -> None:
    vx, vy, vz, rate = struct.unpack("<ffff", data)
    out[sp.MODE_X] = out[sp.MODE_Y] = out[sp.MODE_Z] = sp.VELOCITY
    out[sp.VX : sp.VZ + 1] = vx, vy, vz
    _yaw_rate(out, sign * rate)


def _z_distance(out: np.ndarray, data: bytes, sign: float) -> None:
    roll, pitch, rate, z = struct.unpack("<ffff", data)
    _height(out, z)
    _yaw_rate(out, sign * rate)
    _tilt(out, roll, pitch)


def _hover(out: np.ndarray, data: bytes, sign: float) -> None:
    vx, vy, rate, z = struct.unpack("<ffff", data)
    _height(out, z)
    _yaw_rate(out, sign * rate)
    out[sp.MODE_X] = out[sp.MODE_Y] = sp.VELOCITY
    out[sp.VX], out[sp.VY] = vx, vy
    out[sp.VELOCITY_BODY] = 1.0


def _altitude_hold(out: np.ndarray, data: bytes, sign: float) -> None:
    roll, pitch, rate, vz = struct.unpack("<ffff", data)
    out[sp.MODE_Z], out[sp.VZ] = sp.VELOCITY, vz
    _yaw_rate(out, sign * rate)
    _tilt(out, roll, pitch)


def _full_state(out: np.ndarray, data: bytes, _sign: float) -> None:
    """mm, mm/s, mm/s^2, compressed quaternion, milliradians per second (cflib's docstring is wrong)."""
    values = struct.unpack("<9hI3h", data)
    out[sp.MODE_X] = out[sp.MODE_Y] = out[sp.MODE_Z] = sp.ABSOLUTE
    out[sp.X : sp.AZ + 1] = np.array(values[:9]) / 1000.0
    out[sp.MODE_QUAT] = sp.ABSOLUTE
    out[sp.QX : sp.QW + 1] = decompress_quaternion(values[9])
    out[sp.RATE_ROLL : sp.RATE_YAW + 1] = np.degrees(np.array(values[10:]) / 1000.0)


def _position(out: np.ndarray, data: bytes, _sign: float) -> None:
    x, y, z, yaw = struct.unpack("<ffff", data)
    out[sp.MODE_X] = out[sp.MODE_Y] = out[sp.MODE_Z] = out[sp.MODE_YAW] = sp.ABSOLUTE
    out[sp.X : sp.Z + 1] = x, y, z
    out[sp.YAW] = yaw


def _manual(out: np.ndarray, data: bytes, _sign: float) -> None:
    roll, pitch, rate, thrust, rate_mode = struct.unpack("<fffHB", data)
    if rate_mode == 1:
        out[sp.MODE_ROLL] = out[sp.MODE_PITCH] = sp.VELOCITY
        out[sp.RATE_ROLL], out[sp.RATE_PITCH] = roll, pitch
    else:
        _tilt(out, roll, pitch)
    _yaw_rate(out, rate)
    out[sp.THRUST] = thrust


# type -> (decoder, sign of the yaw rate, data bytes); the legacy types have the yaw rate inverted.
_DECODERS: dict[int, tuple[Callable[[np.ndarray, bytes, float], None], float, int]] = {
    VELOCITY_LEGACY: (_velocity, -1.0, 16),
    Z_DISTANCE_LEGACY: (_z_distance, -1.0, 16),
    ALTITUDE_HOLD: (_altitude_hold, 1.0, 16),
    HOVER_LEGACY: (_hover, -1.0, 16),
    FULL_STATE: (_full_state, 1.0, 28),
    POSITION: (_position, 1.0, 16),
    VELOCITY_WORLD: (_velocity, 1.0, 16),
    Z_DISTANCE: (_z_distance, 1.0, 16),
    HOVER: (_hover, 1.0, 16),
    MANUAL: (_manual, 1.0, 15),
}


def decode_generic(kind: int, data: bytes) -> np.ndarray | None:
    """The setpoint of a generic packet, data without the type byte; None for an unknown type or a wrong length.

    (On a wrong length the firmware stops with a failed assertion; the simulator ignores the packet.)
    """
    out = sp.null_setpoint()
    if kind == STOP:
        return out
    if kind not in _DECODERS:
        return None
    decoder, sign, length = _DECODERS[kind]
    if len(data) != length:
        return None
    decoder(out, data, sign)
    return out


class RpytDecoder:
    """Roll, pitch, yaw rate, thrust packets: thrust stays locked until a zero thrust has been received.

    mode(name) reads the parameter flightmode.<name>.
    """

    def __init__(self, mode: Callable[[str], float]):
        self._mode = mode
        self._locked = True

    def decode(self, roll: float, pitch: float, yaw_rate: float, thrust: int, *, disabled: bool) -> np.ndarray:
        """The setpoint; roll, pitch [deg, firmware's sign], yaw_rate [deg/s], thrust [PWM units, 1000..60000].

        disabled: no setpoint has been active yet, which locks the thrust.
        """
        if disabled:
            self._locked = True
        if thrust == 0:
            self._locked = False
        out = sp.null_setpoint()
        out[sp.THRUST] = 0 if self._locked or thrust < _MIN_THRUST else min(thrust, _MAX_THRUST)
        if self._mode("althold"):
            out[sp.THRUST] = 0
            out[sp.MODE_Z], out[sp.VZ] = sp.VELOCITY, (thrust - 32767.0) / 32767.0
        if self._mode("poshold"):
            out[sp.MODE_X] = out[sp.MODE_Y] = sp.VELOCITY
            out[sp.VX], out[sp.VY] = pitch / 30.0, roll / 30.0
        elif self._mode("posSet") and thrust != 0:
            out[sp.MODE_X] = out[sp.MODE_Y] = out[sp.MODE_Z] = out[sp.MODE_YAW] = sp.ABSOLUTE
            out[sp.X : sp.Z + 1] = -pitch, roll, thrust / 1000.0
            out[sp.YAW] = yaw_rate
            out[sp.THRUST] = 0
        else:
            for mode, angle, rate, value, name in (
                (sp.MODE_ROLL, sp.ROLL, sp.RATE_ROLL, roll, "stabModeRoll"),
                (sp.MODE_PITCH, sp.PITCH, sp.RATE_PITCH, pitch, "stabModePitch"),
            ):
                if self._mode(name):
                    out[mode], out[angle] = sp.ABSOLUTE, value
                else:
                    out[mode], out[rate] = sp.VELOCITY, value
        if not self._mode("posSet"):
            _yaw_rate(out, yaw_rate)
        return out
