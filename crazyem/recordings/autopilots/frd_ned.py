"""Conversion from the frames of PX4 and MAVLink (body front-right-down, world north-east-down) to FLU and z up.

The world becomes north-west-up: x stays north, and yaw is still 0 for a drone that faces north, but positive
counter-clockwise seen from above. Both frames rotate by half a turn about x, D = diag(1, -1, -1): a vector v becomes
D v and an attitude R becomes D R D, whose quaternion has the same scalar and x.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20.ardupilotmega import enums

from crazyem.physics.rotations import euler_from_quaternion
from crazyem.recordings.topics import floats

Columns = Sequence[NDArray[np.generic]]
Turn = Callable[[Columns], NDArray[np.float64]]

WORLD = "world, north-west-up"
ATTITUDE = "quaternion x y z w, body (FLU) to world (north-west-up)"
BODY = "body FLU"
MOTORS = "rotors 1..4 as the autopilot numbers them"


def stacked(columns: Columns) -> NDArray[np.float64]:
    """(n, c) float64 from c columns of (n,) numbers."""
    return np.column_stack([floats(c) for c in columns])


def vectors(columns: Columns) -> NDArray[np.float64]:
    """(n, 3) in FLU or NWU from three columns in FRD or NED."""
    value = stacked(columns)
    value[:, 1:] *= -1.0
    return value


def quaternions(columns: Columns) -> NDArray[np.float64]:
    """(n, 4) x y z w, body FLU to NWU, from columns w x y z of FRD to NED."""
    w, x, y, z = (floats(c) for c in columns)
    return np.column_stack([x, -y, -z, w])


euler = vectors  # also (n, 3) roll, pitch, yaw [rad] of FLU to NWU from those of FRD to NED, both in order ZYX


def scaled(factor: float, turned: Turn = stacked) -> Turn:
    """A function that returns the result of `turned` times a factor."""
    return lambda columns: turned(columns) * factor


def bit(mask: int) -> Turn:
    """A function that returns 1 where a number has this bit set, else 0."""
    return lambda columns: ((stacked(columns).astype(np.int64) & mask) != 0).astype(float)


def angles_of_quaternions(columns: Columns) -> NDArray[np.float64]:
    """(n, 3) roll, pitch, yaw [rad] of FLU to NWU from columns w x y z of FRD to NED."""
    return euler_from_quaternions(quaternions(columns))


def euler_from_quaternions(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) roll, pitch, yaw [rad], ZYX, from (n, 4) x y z w of any norm; NaN for norm 0."""
    with np.errstate(invalid="ignore"):
        return euler_from_quaternion(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))


def vehicle_of(kind: int) -> dict[str, str]:
    """The section "vehicle" of the metadata: "mav_type" (a number of MAV_TYPE) and "kind" (its text, "quadrotor").

    Args:
        kind: MAV_TYPE; below 1 ("generic") the section is empty.

    Source: mavlink.io/en/messages/common.html, from pymavlink.
    """
    known = enums["MAV_TYPE"].get(kind) if kind > 0 else None
    if known is None:
        return {}
    words = str(known.description).split(". ")[0].rstrip(".")
    return {"kind": words[:1].lower() + words[1:], "mav_type": str(kind)}
