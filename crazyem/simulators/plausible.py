"""Checks for constants that no drone has: impossible inertias, and numbers that suggest a wrong unit in a file."""

import math
from collections.abc import Callable

import numpy as np

from crazyem.simulators.constants import Constants, hover_speed, inertia_of

# Speed at hover of a point at the arm's length from a rotor's axis [m/s]: 56 for a 0.5 kg hummingbird, 65 for a
# Crazyflie, 130 for a 2 kg X500. Rotor speeds in RPM instead of rad/s differ by a factor of 9.5 and leave this range.
TIP_SPEED = (15.0, 250.0)
RPM = 60.0 / (2.0 * math.pi)  # rev/min of one rad/s
# Inertia about x over mass times squared arm: 0.5 for a Crazyflie; 2 for four masses at the rotors.
SPREAD_OF_MASS = (0.02, 20.0)


def objection(c: Constants, label: Callable[[str], str]) -> str:
    """Why no drone can have these constants: one clause that names the field; "" if a drone can.

    Args:
        label: quantity -> its name in the file.
    """
    if c.mass is None:
        return f"{label('mass')} is missing"
    if not (0.0 < c.mass < math.inf):
        return f"{label('mass')} must be a positive number, got {c.mass:g}"
    for name in ("inertia_xx", "inertia_yy", "inertia_zz"):
        value = getattr(c, name)
        if value is None:
            return f"{label(name)} is missing"
        if not (0.0 < value < math.inf):
            return f"{label(name)} must be a positive number, got {value:g}"
    return _inertia(c, label) or _rotors(c, label)


def _inertia(c: Constants, label: Callable[[str], str]) -> str:
    matrix = inertia_of(c)
    assert matrix is not None
    assert c.mass is not None
    values = np.linalg.eigvalsh(matrix)
    if values[0] <= 0.0:
        return f"{label('inertia_xy')} and its neighbours: the inertia is not a positive definite matrix"
    if c.arm_x and c.arm_y:
        ratio = float(matrix[0, 0]) / (c.mass * c.arm_y**2)
        if not SPREAD_OF_MASS[0] < ratio < SPREAD_OF_MASS[1]:
            return (
                f"{label('inertia_xx')} does not fit {label('mass')} and {label('arm_x')}: it is {ratio:.2g} times "
                "mass times squared arm, and 0.1 to 2 is usual; are the units kg, m and kg m^2?"
            )
    return ""


def impossible(c: Constants, label: Callable[[str], str]) -> str:
    """A clause if the moments of inertia violate the triangle inequality, so that no body has them; else ""."""
    matrix = inertia_of(c)
    if matrix is None:
        return ""
    values = np.linalg.eigvalsh(matrix)
    if values[2] > values[:2].sum() * (1.0 + 1e-6):
        worst = max(("inertia_xx", "inertia_yy", "inertia_zz"), key=lambda n: getattr(c, n))
        return (
            f"{label(worst)} is larger than the other two moments together "
            f"({values[2]:.3g} > {values[0]:.3g} + {values[1]:.3g} kg m^2), which no body has"
        )
    return ""


def _rotors(c: Constants, label: Callable[[str], str]) -> str:
    for name in ("arm_x", "arm_y", "thrust_per_speed2", "torque_per_thrust", "thrust_max"):
        value = getattr(c, name)
        if value is not None and not (0.0 < value < math.inf):
            return f"{label(name)} must be a positive number, got {value:g}"
    if c.lag is not None and not (0.0 <= c.lag <= 1.0):
        return f"{label('lag')} must lie between 0 and 1 s, got {c.lag:g}"
    if c.thrust_per_speed2 is None or not c.arm_x or not c.arm_y:
        return ""
    tip = hover_speed(c) * math.sqrt(c.arm_x * c.arm_y)
    if TIP_SPEED[0] < tip < TIP_SPEED[1]:
        return ""
    hint = ""
    if TIP_SPEED[0] < tip / RPM < TIP_SPEED[1]:
        hint = "; as N per RPM^2 it would fit"
    elif TIP_SPEED[0] < tip * RPM < TIP_SPEED[1]:
        hint = "; as N per (rad/s)^2 it would fit"
    return (
        f"{label('thrust_per_speed2')} cannot be in the unit of this file: the drone would hover at "
        f"{hover_speed(c):.3g} rad/s, {tip:.2g} m/s at the length of an arm{hint}"
    )
