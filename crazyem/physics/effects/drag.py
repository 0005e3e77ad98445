"""linear_drag, quadratic_drag, velocity_moment, rate_damping: what the air does against motion."""

import math
from collections.abc import Callable

import numpy as np

from crazyem.physics.effects.effect import Body, Effect, Parameter, Situation, Values, Wrench
from crazyem.physics.effects.prior import Conditions, Prior, Sizes, alike, in_turn
from crazyem.vehicle import GRAVITY, Vehicle


def linear_force(situation: Situation, body: Body, *, x: float, y: float, z: float) -> Wrench:
    """-D v: x, y, z [N s/m] along body axes."""
    return Wrench(-np.array([x, y, z]) * situation.airspeed, np.zeros((situation.size, 3)))


def _of_real_rotors(names: str, size: float) -> Callable[[Conditions], Sizes]:
    """Real rotors have drag and flapping, bare rigid bodies of files neither."""
    return lambda conditions: alike(names, size) if conditions.individual_file else {}


# N s/m, N s^2/m^2, within which no drag is known: an attitude 1 ms late is a force of 3e-4 N s/m along the quicker axis
# of a figure 8 (mass * (3.1 rad/s)^2 * 1 ms); along z thrust is a little wrong.
SYSTEMATIC = in_turn("x y z", 3e-4, 3e-4, 1e-3)
DETECTABLE = in_turn("x y z", 1e-3, 1e-3, 3e-3)  # N s/m, N s^2/m^2; along z thrust is a little wrong

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
    """-Q |v| v: the whole airspeed times each component; x, y, z [N s^2/m^2] along body axes."""
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
    """Torque (roll_per_vy v_y, pitch_per_vx v_x, 0) of the air's flow on the rotors [N m s/m], body axes."""
    airspeed = situation.airspeed
    torque = np.zeros((situation.size, 3))
    torque[:, 0] = roll_per_vy * airspeed[:, 1]
    torque[:, 1] = pitch_per_vx * airspeed[:, 0]
    return Wrench(np.zeros((situation.size, 3)), torque)


def damping(situation: Situation, body: Body, *, x: float, y: float, z: float) -> Wrench:
    """Torque -B w, x, y, z [N m s]."""
    return Wrench(np.zeros((situation.size, 3)), -np.array([x, y, z]) * situation.body_rate)


def _sampled(conditions: Conditions) -> Sizes:
    """N m s: what is sent between two logged commands looks like a damping. Speeds logged at 100 Hz: of 1 to 11e-6 in
    quick flights of 11 drones with nothing hidden. With heavy rotors: about z of 1e-5 to 1.9e-4 in 11 flights."""
    usual = 6e-6 if conditions.measured_speeds or conditions.heavy_rotors else 0.0
    tilting = 3e-4 if conditions.other_clock else math.hypot(usual, 3e-4 * conditions.unlogged_share)
    if not conditions.shows_rotation or tilting == 0.0:
        return {}
    return in_turn("x y z", tilting, tilting, 1e-4 if conditions.heavy_rotors else tilting)


# N m s/m: smallest moment that tips the drone back from where it flies, as air on rotors above the centre of mass
# does, and further towards there. Five of simulated drones with none were such about both axes, of 4e-6 to 1.2e-5: more
# than that may be of a body below which the air finds more hold.
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

# m/s: a rotor loses thrust with the speed at which its air comes, all of it at twice the speed that it gives to the air
# (4 m/s in a Crazyflie's hover; half of that is less than any small drone's).
INDUCED = 2.0


def _beyond_rotor_damping(values: Values, vehicle: Vehicle) -> bool:
    """Whether no rotors can damp a turn as much (see `INDUCED`)."""
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
    # rotors that are heavy look like a damping about z to commands that are sampled, and their derivative at none may
    # have the wrong sign: begun as a bar of 0.3 g and 46 mm would be
    imitators={"rotor_inertia": {"inertia": 5e-8}},
    needs=("body_rate", "attitude"),
    separates=(
        "turn at several steady yaw rates; and step roll and pitch with the gyro logged at 500 Hz or more (a lag shows"
        " in the first 50 ms, damping throughout)"
    ),
    needs_torques=True,
)
