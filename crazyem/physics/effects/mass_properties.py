"""inertia, inertia_products, center_of_mass, payload: mass properties of the body, and a point mass on it."""

import math
from dataclasses import replace

import numpy as np

from crazyem.physics.effects.effect import Body, Effect, Parameter
from crazyem.physics.effects.prior import AT_ONCE_SD, Conditions, Prior, Sizes, alike, in_turn
from crazyem.vehicle import Vehicle

ON_BOARD = 0.04  # m, largest distance of a part of a Crazyflie from the middle of the rotors
WITHIN = dict.fromkeys("xyz", (-ON_BOARD, ON_BOARD))
# Largest radius of gyration of a drone over the distance of its rotors from the middle.
FAR_OUT = 2.0


def diagonal(body: Body, *, xx: float, yy: float, zz: float) -> Body:
    """Replace the diagonal of the inertia matrix about the body's centre of mass [kg m^2]."""
    inertia = body.inertia.copy()
    inertia[0, 0], inertia[1, 1], inertia[2, 2] = xx, yy, zz
    return replace(body, inertia=inertia)


def products(body: Body, *, xy: float, xz: float, yz: float) -> Body:
    """Replace the elements J_xy, J_xz, J_yz (not their negatives) of the inertia matrix [kg m^2]."""
    inertia = body.inertia.copy()
    inertia[0, 1] = inertia[1, 0] = xy
    inertia[0, 2] = inertia[2, 0] = xz
    inertia[1, 2] = inertia[2, 1] = yz
    return replace(body, inertia=inertia)


def _moments(conditions: Conditions) -> Sizes:
    """Relative. In 76 flights with known torque over inertia, differences scatter by 1.2 % between roll and pitch and
    by 2.0 % to yaw, beyond the standard deviations of the fits (figures 8 by 2.1 and 3.0 %, shakes by 0.5 and 1.3 %).

    Commands on another clock carry no information on inertia. With heavy rotors, Izz looks 20 to 40 % too large.
    """
    if not conditions.shows_rotation:
        return {}
    sampled = 1.0 if conditions.other_clock else conditions.unlogged_share
    x, y, z = (math.hypot(share, sampled) for share in (0.01, 0.01, 0.02))
    return in_turn("xx yy zz", x, y, AT_ONCE_SD if conditions.heavy_rotors else z)


def largest_inertia(vehicle: Vehicle) -> float:
    """Largest inertia [kg m^2] of a drone of this mass and size (see `FAR_OUT`)."""
    return vehicle.mass * (FAR_OUT * float(np.hypot(*vehicle.arm))) ** 2


INERTIA = Effect(
    "inertia",
    tuple(Parameter(axis, "kg m^2", math.nan, 1e-7, 1e-1, 3e-7) for axis in ("xx", "yy", "zz")),
    order=10,
    own=lambda vehicle: in_turn("xx yy zz", *vehicle.inertia),
    constants={a: f"inertia_{a}" for a in ("xx", "yy", "zz")},
    about=("inertia", "torque_per_thrust"),
    body=diagonal,
    needs=("body_rate", "attitude"),
    separates="swing the drone on two threads (bifilar pendulum), or measure the rotors' torque on a stand",
    prior=Prior(
        alike("xx yy zz", 0.3),
        _moments,
        dict.fromkeys(("xx", "yy", "zz"), "neutral"),
        together=0.9,  # inertias about the three axes are too large or too small together
        detection_limit=alike("xx yy zz", 0.08),
    ),
    alike=0.9,  # differences between the axes are a third of the common deviation
    needs_torques=True,
    twins=("torque_scale",),
    common_factor="torque_scale",
    unphysical=lambda values, vehicle: max(values.values()) > largest_inertia(vehicle),
)

INERTIA_PRODUCTS = Effect(
    "inertia_products",
    tuple(Parameter(axis, "kg m^2", math.nan, -1e-2, 1e-2, 3e-7) for axis in ("xy", "xz", "yz")),
    order=11,
    own=lambda vehicle: in_turn("xy xz yz", *vehicle.inertia_products),
    constants={a: f"inertia_{a}" for a in ("xy", "xz", "yz")},
    body=products,
    needs=("body_rate", "attitude"),
    separates="excite one axis at a time: roll, pitch and yaw for 5 s each at 2 Hz",
    prior=Prior(alike("xy xz yz", 0.15), per=dict.fromkeys(("xy", "xz", "yz"), "inertia")),
    needs_torques=True,
)


def shifted(body: Body, *, x: float, y: float, z: float) -> Body:
    """Put the centre of mass at x, y, z [m] from O; mass and inertia about the centre of mass stay."""
    return replace(body, centre=np.array([x, y, z]))


def _placed(conditions: Conditions) -> Sizes:
    """m; errors of onboard velocities look like a height of -0.4 to -0.8 mm.

    With commands on another clock no shift is named, but the drone still has a trim: one rotor 10 % weaker is a torque
    per thrust of a twentieth of the arm. Without this freedom the trim looks like a wind (by the moment of its flow).
    """
    if not conditions.shows_rotation or "velocity" not in conditions.signals:
        return {}
    trimmed = conditions.other_clock and not conditions.individual_file
    level = [max(0.05 * arm, 2e-5) if trimmed else 2e-5 for arm in conditions.arm]
    return in_turn("x y z", *level, 7e-4)


CENTER_OF_MASS = Effect(
    "center_of_mass",
    tuple(Parameter(axis, "m", 0.0, -0.1, 0.1, 5e-4) for axis in "xyz"),
    order=12,
    constants={a: f"centre_{a}" for a in "xyz"},
    about=("centre",),
    words="shift of the centre of mass",
    body=shifted,
    steady_torque=True,
    shifts_centre=True,
    admitted=lambda chosen: WITHIN,
    # own: a battery of a third of the weight, some millimetres from its place
    # detection limit: only lateral accelerations of O depend on z
    prior=Prior(alike("x y z", 1.5e-3), _placed, detection_limit=in_turn("x y z", 1e-4, 1e-4, 1e-3)),
    separates=(
        "balance the drone on an edge, or log the accelerometer and yaw for 5 s at 2 Hz; for z fly hard sideways steps"
    ),
)


def steiner(mass: float, offset: np.ndarray) -> np.ndarray:
    """Contribution (3, 3) [kg m^2] of a mass [kg] at an offset (3,) [m] to the inertia matrix."""
    return mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))


def loaded(body: Body, *, mass: float, x: float, y: float, z: float) -> Body:
    """The body with a point mass [kg] at x, y, z [m] from O; inertia about the new centre by Steiner for both parts."""
    place = np.array([x, y, z])
    total = body.mass + mass
    centre = (body.mass * body.centre + mass * place) / total
    inertia = body.inertia + steiner(body.mass, body.centre - centre) + steiner(mass, place - centre)
    return Body(total, inertia, centre)


PAYLOAD = Effect(
    "payload",
    (
        Parameter("mass", "kg", 0.0, 0.0, 1.0, 5e-4),
        *(Parameter(axis, "m", 0.0, -0.3, 0.3, 2e-3) for axis in "xyz"),
    ),
    order=13,
    about=("mass", "centre", "thrust_per_speed2"),
    body=loaded,
    # own: typical payload of a drone of this class, within its frame
    prior=Prior(in_turn("mass x y z", 0.08, 0.01, 0.01, 0.01), per={"mass": "mass"}),
    separates="weigh the drone",
    nudge={"mass": 5e-4},
    amplitude="mass",
    steady_torque=True,
    shifts_centre=True,
    imbalance="load",
    lifts=True,
    needs_voltage=True,
    admitted=lambda chosen: WITHIN,
)
