"""From the simulator's frames (FLU, z up) to MAVLink's (FRD, north-east-down), and its rotors to those of PX4.

Our x axis is north. Half a turn about x leads from one to the other and back: y and z change their signs.
"""

import math
from collections.abc import Sequence

# PX4's motors 1..4 of an X quad: front right, back left, front left, back right; index of the simulator's rotor
ROTOR = (0, 2, 3, 1)


def turned(v: Sequence[float]) -> tuple[float, float, float]:
    """A vector, either way."""
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
