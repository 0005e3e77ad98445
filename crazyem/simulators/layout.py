"""Convert rotor positions relative to the centre of mass, as in some files, to arms and centre of mass, and back."""

import math

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.simulators.constants import Constants

Array = NDArray[np.float64]
EQUAL = 1e-3  # relative difference of arms up to which four rotors are the corners of a rectangle
NOTHING = 1e-10  # relative to the largest arm or moment of inertia of a drone: smaller values are rounding errors
PLUS = "the rotors lie on the body axes (a plus); it is read as the same drone turned by 45 degrees"


def read_positions(positions: Array, *, where: str, field: str) -> tuple[dict[str, float], list[str]]:
    """Arms and centre of mass of rotor positions (4, 3) [m] from the centre of mass, FLU, and remarks.

    Raises: FileFormatError where they are not the corners of a rectangle.
    """
    if positions.shape != (4, 3) or not np.isfinite(positions).all():
        raise FileFormatError(f"{where}: {field} must hold four positions of three numbers")
    middle = positions.mean(axis=0)
    around = positions - middle
    remarks = []
    if is_plus(positions):
        s = math.sqrt(0.5)
        around, remarks = around @ np.array([[s, -s, 0.0], [s, s, 0.0], [0.0, 0.0, 1.0]]).T, [PLUS]
    arms = np.abs(around[:, :2])
    arm = arms.mean(axis=0)
    quadrants = {(bool(x > 0), bool(y > 0)) for x, y in around[:, :2]}
    if len(quadrants) != 4 or not np.allclose(arms, arm, rtol=EQUAL, atol=0.0):
        raise FileFormatError(f"{where}: {field}: the four rotors are not the corners of a rectangle")
    found = {"arm_x": float(arm[0]), "arm_y": float(arm[1])}
    # the mean of positions has a rounding error even if the centre of mass is in the middle
    centre = np.where(np.abs(middle) < NOTHING * arm.max(), 0.0, -middle)
    return found | {f"centre_{a}": float(c) for a, c in zip("xyz", centre)}, remarks


def placed(now: Array, c: Constants) -> Array:
    """Rotor positions (4, 3) [m] with these arms and centre; each rotor keeps its side in `now`."""
    around = now - now.mean(axis=0)
    arm = np.array([c.or_("arm_x", math.nan), c.or_("arm_y", math.nan)])
    if is_plus(now):
        length = math.hypot(*arm)
        around = np.sign(np.where(np.abs(around) < 0.1 * np.abs(around).max(), 0.0, around)) * [length, length, 0.0]
    else:
        around = np.column_stack([np.sign(around[:, :2]) * arm, np.zeros(4)])
    found: Array = around - np.array([c.or_(f"centre_{a}", 0.0) for a in "xyz"])
    return found


def is_plus(positions: Array) -> bool:
    """Whether rotors lie on the body axes."""
    around = np.abs((positions - positions.mean(axis=0))[:, :2])
    return bool((around.min(axis=1) < 0.1 * around.max(axis=1)).all())
