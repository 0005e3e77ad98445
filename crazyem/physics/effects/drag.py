"""linear_drag, quadratic_drag, velocity_moment, rate_damping: forces and torques of the air against motion."""

import math
from collections.abc import Callable

import numpy as np

from crazyem.physics.effects.effect import Body, Effect, Parameter, Situation, Values, Wrench
from crazyem.physics.effects.prior import Conditions, Prior, Sizes, alike, in_turn
from crazyem.vehicle import GRAVITY, Vehicle


def linear_force(situation: Situation, body: Body, *, x: float, y: float, z: float) -> Wrench:
    """Force -D v with the airspeed v; x, y, z [N s/m] along body axes."""
    return Wrench(-np.array([x, y, z]) * situation.airspeed, np.zeros((situation.size, 3)))


def _of_real_rotors(names: str, size: float) -> Callable[[Conditions], Sizes]:
    """Usual sizes for the file of one real drone: real rotors have drag and flapping; none for other files."""
    return lambda conditions: alike(names, size) if conditions.individual_file else {}


# Systematic error [N s/m, N s^2/m^2]: an attitude 1 ms late looks like 3e-4 N s/m along the faster axis of a figure 8
# (mass * (3.1 rad/s)^2 * 1 ms); along z, the thrust has a small error.
SYSTEMATIC = in_turn("x y z", 3e-4, 3e-4, 1e-3)
DETECTABLE = in_turn("x y z", 1e-3, 1e-3, 3e-3)  # N s/m, N s^2/m^2; along z, the thrust has a small error

# Drag of rotors is proportional to their speed (Svacha et al. 2017). With 10 % of thrust, which flights are assumed to
# differ by in the mean, that is 5 %. A drag that follows the speed is no effect of the catalogue.
SPEED_SHARE = 0.05

LINEAR_DRAG = Effect(
    "linear_drag",
    tuple(Parameter(axis, "N s/m", 0.0, 0.0, 0.5, 1e-3) for axis in "xyz"),
    order=60,
    constants={a: f"drag_{a}" for a in "xyz"},
    about=("drag",),
    external=linear_force,
    couples_air=True,
    prior=Prior(
        alike("x y z", 0.012),
        _of_real_rotors("x y z", 0.02),
        systematic=SYSTEMATIC,
        relative_error=alike("x y z", SPEED_SHARE),
        detection_limit=DETECTABLE,
        usual_named=True,
    ),
    of_healthy_rotors=True,
    most_per_mass=5.0,
    needs=("velocity", "position"),
    separates="fly straight legs of different speeds in opposite directions",
    steady_force=True,
)


def quadratic_force(situation: Situation, body: Body, *, x: float, y: float, z: float) -> Wrench:
    """Force -Q |v| v with the airspeed v; x, y, z [N s^2/m^2] along body axes."""
    airspeed = situation.airspeed
    speed = np.sqrt(np.einsum("ni,ni->n", airspeed, airspeed))[:, None]
    return Wrench(-np.array([x, y, z]) * speed * airspeed, np.zeros((situation.size, 3)))


QUADRATIC_DRAG = Effect(
    "quadratic_drag",
    tuple(Parameter(axis, "N s^2/m^2", 0.0, 0.0, 0.1, 5e-4) for axis in "xyz"),
    order=61,
    constants={a: f"quadratic_drag_{a}" for a in "xyz"},
    about=("quadratic",),
    external=quadratic_force,
    couples_air=True,
    prior=Prior(alike("x y z", 0.012), systematic=SYSTEMATIC, detection_limit=DETECTABLE),
    most_per_mass=3.0,
    needs=("velocity", "position"),
    separates="fly straight legs at 0.5, 1 and 2 m/s: linear drag doubles with speed, this one goes up four times",
    steady_force=True,
)


def flapping(situation: Situation, body: Body, *, roll_per_vy: float, pitch_per_vx: float) -> Wrench:
    """Torque (roll_per_vy v_y, pitch_per_vx v_x, 0) by airspeed v at the rotors; coefficients [N m s/m], body axes."""
    airspeed = situation.airspeed
    torque = np.zeros((situation.size, 3))
    torque[:, 0] = roll_per_vy * airspeed[:, 1]
    torque[:, 1] = pitch_per_vx * airspeed[:, 0]
    return Wrench(np.zeros((situation.size, 3)), torque)


def damping(situation: Situation, body: Body, *, x: float, y: float, z: float) -> Wrench:
    """Torque -B w with the body rate w; x, y, z [N m s]."""
    return Wrench(np.zeros((situation.size, 3)), -np.array([x, y, z]) * situation.body_rate)


def _sampled(conditions: Conditions) -> Sizes:
    """N m s: commands between two logged ones look like a damping. With speeds logged at 100 Hz: 1 to 11e-6 in fast
    flights of 11 drones without hidden effects. With heavy rotors: 1e-5 to 1.9e-4 about z in 11 flights."""
    usual = 6e-6 if conditions.measured_speeds or conditions.heavy_rotors else 0.0
    tilting = 3e-4 if conditions.other_clock else math.hypot(usual, 3e-4 * conditions.unlogged_share)
    if not conditions.shows_rotation or tilting == 0.0:
        return {}
    return in_turn("x y z", tilting, tilting, 1e-4 if conditions.heavy_rotors else tilting)


# N m s/m: detection limits of a moment that tilts the drone back, against its motion (air on rotors above the centre of
# mass), and onward, with its motion. In five simulated drones without the effect, an onward moment of 4e-6 to 1.2e-5
# came out about both axes. A larger one may be real: drag of the body below the centre of mass.
BACK, ONWARD = 3e-6, 1.5e-5

VELOCITY_MOMENT = Effect(
    "velocity_moment",
    (
        Parameter("roll_per_vy", "N m s/m", 0.0, -5e-3, 5e-3, 5e-6),
        Parameter("pitch_per_vx", "N m s/m", 0.0, -5e-3, 5e-3, 5e-6),
    ),
    order=62,
    external=flapping,
    of_healthy_rotors=True,
    # own: a Crazyflie tilts its flow by some 1e-5 N m s/m (docs/reference/effects.md)
    prior=Prior(
        alike("roll_per_vy pitch_per_vx", 4e-5),
        _of_real_rotors("roll_per_vy pitch_per_vx", 3e-4),
        detection_limit={"roll_per_vy": (ONWARD, BACK), "pitch_per_vx": (BACK, ONWARD)},
    ),
    needs=("velocity", "position"),
    separates="fly straight legs forward and back, then left and right, at 1 and 2 m/s, and hover between them",
    slow_torque=True,
)

# m/s, induced velocity in hover: the thrust of a rotor falls with the axial speed of the air, to zero at twice the
# induced velocity. It is 4 m/s for a Crazyflie; half of this is less than that of any small drone.
INDUCED = 2.0


def _beyond_rotor_damping(values: Values, vehicle: Vehicle) -> bool:
    """Whether the damping is more than rotors can have (see `INDUCED`)."""
    most = vehicle.mass * GRAVITY * float(np.hypot(*vehicle.arm)) ** 2 / (2.0 * INDUCED)
    return max(values.values()) > most


RATE_DAMPING = Effect(
    "rate_damping",
    tuple(Parameter(axis, "N m s", 0.0, 0.0, 1e-3, 2e-6) for axis in "xyz"),
    order=63,
    constants={a: f"damping_{a}" for a in "xyz"},
    about=("damping",),
    external=damping,
    prior=Prior(alike("x y z", 2e-5), _sampled, conditional=True),
    unphysical=_beyond_rotor_damping,
    # with sampled commands, heavy rotors look like a damping about z, and the derivative at an inertia of 0 may have
    # the wrong sign: the fit begins at a bar of 0.3 g and 46 mm
    imitators={"rotor_inertia": {"inertia": 5e-8}},
    needs=("body_rate", "attitude"),
    separates=(
        "turn at several steady yaw rates; and step roll and pitch with the gyro logged at 500 Hz or more (a lag shows"
        " in the first 50 ms, damping throughout)"
    ),
    needs_torques=True,
)
