"""thrust_scale, rotor_fault, torque_scale, ground_effect, trim, rotor_inertia: force and torque of the rotors.

trim is a steady torque that every real drone has: its rotors are not equal and not upright, and its battery is not
exactly in the middle. The trim is in proportion to the thrust, so it is zero with the rotors at rest. The trim of a day
differs a little from the trim in a vehicle file; the prior gives the size of the difference.
rotor_inertia is the angular momentum of the rotors: it turns with the body (gyroscopic torque), and its change gives a
reaction torque.
"""

import math

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Body, Effect, Parameter, Situation, Values, Wrench
from crazyem.physics.effects.mass_properties import largest_inertia
from crazyem.physics.effects.prior import AT_ONCE_SD, Conditions, Prior, Sizes, in_turn
from crazyem.vehicle import Vehicle


def scaled(situation: Situation, *, scale: float) -> NDArray:
    """Thrust of all rotors times scale; their drag torque changes likewise."""
    return situation.thrust * scale


def faulty(situation: Situation, *, rotor: int, scale: float, onset_time: float | None) -> NDArray:
    """Thrust of one rotor (1 to 4) times scale from onset_time on [s, the recording's clock]; None: from the start.

    In the step of the onset the change acts in part, so that the likelihood is continuous in onset_time.
    """
    since = np.ones(situation.size)
    if onset_time is not None:
        step = np.where(situation.step > 0, situation.step, 1e-3)
        since = np.clip((situation.time - onset_time) / step, 0.0, 1.0)
    thrust = situation.thrust.copy()
    thrust[:, int(rotor) - 1] *= 1 + (scale - 1) * since
    return thrust


def turned(torque: NDArray, *, scale: float) -> NDArray:
    """The rotors' three torques about O times scale."""
    return torque * scale


def _strength(conditions: Conditions) -> Sizes:
    """Relative, from day to day: batteries are put in again, propellers bend (docs/results/diagnosis_real.md).

    Each of several recordings has its own scale. With one scale for all, the response to commands would look too small.
    """
    if not (conditions.own_battery or conditions.individual_file):
        return {}
    return {"scale": conditions.days[0] if conditions.days else 0.02}


THRUST_SCALE = Effect(
    "thrust_scale",
    (Parameter("scale", "", 1.0, 0.1, 5.0, 0.01),),
    order=30,
    gain="thrust",
    about=("thrust_per_speed2", "thrust_max", "mass"),
    rotors=scaled,
    # detection limit: two standard deviations of a day
    prior=Prior(
        own={"scale": 0.08},
        usual=_strength,
        each=lambda conditions: conditions.own_battery,
        detection_limit=lambda chosen, conditions: {n: 2.0 * sd for n, sd in _strength(conditions).items()},
    ),
    separates="weigh the drone; without its weight thrust and mass are one number",
    steady_force=True,
    imbalance="thrust",
    lifts=True,
    needs_voltage=True,
)

ROTOR_FAULT = Effect(
    "rotor_fault",
    (
        Parameter("rotor", "", 1, 1, 4, 1, chosen=(1, 2, 3, 4), phrase="of rotor {}"),
        Parameter("scale", "", 1.0, 0.0, 2.0, 0.02, words="thrust"),
        Parameter("onset_time", "s", None, -1e9, 1e9, 0.1, phrase="since {} s"),
    ),
    order=31,
    rotors=faulty,
    prior=Prior(own={"scale": 0.1}),
    steady_torque=True,
    imbalance="rotor",
    # a worn, cut or bent propeller has less thrust than the others, a new one among worn ones a little more; in flight,
    # no rotor gets stronger
    admitted=lambda chosen: {"scale": (0.0, 1.1 if chosen.get("onset_time") is None else 1.0)},
    separates=(
        "yaw for 5 s at 2 Hz (a weak rotor also lacks drag torque, a heavy corner does not), or hover with the drone's"
        " battery turned round"
    ),
)


def _torques(conditions: Conditions) -> Sizes:
    """Relative: in ten flights without hidden effects, with a free lag, torques look 2 +- 2 % too strong (-0.5 to
    +4 %). With sampled commands, a longer lag with more torque has nearly the same signals."""
    return {"scale": 0.03} if conditions.shows_rotation and not conditions.other_clock else {}


def _too_weak(values: Values, vehicle: Vehicle) -> bool:
    """Whether the torque scale is equivalent to an impossibly large inertia."""
    return max(vehicle.inertia) > largest_inertia(vehicle) * float(values["scale"])


TORQUE_SCALE = Effect(
    "torque_scale",
    (Parameter("scale", "", 1.0, 0.0, 5.0, 0.02),),
    order=40,
    gain="torque",
    about=("torque_per_thrust", "arm", "inertia"),
    turning=turned,
    prior=Prior(own={"scale": 0.2}, usual=_torques, conditional=True, detection_limit={"scale": 0.08}),
    twins=("inertia", "motor_lag"),  # angular acceleration is torque over inertia: both together are not determined
    fixed_beside=("motor_lag",),  # with both free, a lag without a prior is estimated 8 ms too long
    unphysical=_too_weak,
    needs=("body_rate", "attitude"),
    separates="swing the drone on two threads (bifilar pendulum): torque over inertia is all that a flight shows",
    needs_torques=True,
)


def lifted(situation: Situation, *, strength: float, height: float) -> NDArray:
    """Thrust of all rotors times 1 + strength exp(-z/height), z the height of O above the floor [m]."""
    return situation.thrust * (1 + strength * np.exp(-np.maximum(situation.height, 0.0) / height))[:, None]


GROUND_EFFECT = Effect(
    "ground_effect",
    (
        Parameter("strength", "", 0.0, 0.0, 2.0, 0.02),
        Parameter("height", "m", 0.1, 0.005, 10.0, 0.01),
    ),
    order=32,
    rotors=lifted,
    # finding: a floor acts up to a height of some rotor radii; a change that hardly depends on height is a thrust error
    prior=Prior(own={"strength": 0.3, "height": 0.1}, finding=lambda here, neutral, conditions: here["height"] < 1.0),
    needs=("position",),
    separates="hover for 5 s at each of several heights, from 3 cm to 1 m",
    nudge={"strength": 0.02},
    amplitude="strength",
    beginnings={"height": (0.03, 0.1, 0.3)},
    steady_force=True,
)


def trimmed(situation: Situation, body: Body, *, x: float, y: float, z: float) -> Wrench:
    """Torque (x, y, z) [m, that is N m per N] times the total thrust, body axes."""
    total = situation.thrust.sum(axis=1)[:, None]
    return Wrench(np.zeros((situation.size, 3)), np.array([x, y, z]) * total)


def _of_the_day(conditions: Conditions) -> Sizes:
    """m: scatter over healthy and damaged flights of two drones on several days (docs/results/diagnosis_real.md)."""
    if not conditions.individual_file:
        return {}
    return in_turn("x y z", *(conditions.days[1:4] if conditions.days else (5e-4, 5e-4, 1.6e-4)))


def _tails(conditions: Conditions) -> float:
    """Degrees of freedom: the spread is known from some twelve days of two drones, so a normal tail is too short."""
    return 8.0 if conditions.days is None else conditions.days[4]


TRIM = Effect(
    "trim",
    tuple(Parameter(axis, "m", 0.0, -0.02, 0.02, 1e-4) for axis in "xyz"),
    order=41,
    external=trimmed,
    prior=Prior(usual=_of_the_day, freedom=_tails),
    on_request=True,  # a look-alike of every effect with a steady torque
    separates="fly the drone while it is well and judge by the vehicle file written from that: its trim is in there",
)


SPIN = np.array([1.0, -1.0, 1.0, -1.0])  # rotors 1 and 3 turn counter-clockwise seen from above
# N/(rad/s)^2, for vehicles without a rotor constant (the rotor inertia is then relative to it): 46 mm propellers of a
# brushed Crazyflie, which lift 28.6 g at 17174 rpm, 17.3 g at 13522 rpm (Bitcraze, Measuring propeller RPM, part 3,
# 2015).
TYPICAL_ROTOR_CONSTANT = 2.1e-8


def reaction(situation: Situation, body: Body, *, inertia: float) -> Wrench:
    """Torque -w x H e3 - dH/dt e3 with H = inertia (W1 - W2 + W3 - W4), inertia [kg m^2] of one rotor.

    W_i = sqrt(f_i/rotor_constant); f_i is the thrust after the lag, before effects that change it at the same speed.
    Source: Euler's equation of a body with rotors, e.g. Hughes, Spacecraft Attitude Dynamics, 3.4.
    """
    lagged = situation.thrust if situation.lagged is None else situation.lagged
    constant = TYPICAL_ROTOR_CONSTANT if math.isnan(situation.rotor_constant) else situation.rotor_constant
    momentum = inertia * (_speed(lagged, constant) @ SPIN)
    step = np.where(situation.step > 0, situation.step, 1e-3)[:, None]
    half = situation.thrust_rate * step / 2
    change = (_speed(lagged + half, constant) - _speed(lagged - half, constant)) / step
    torque = np.empty((situation.size, 3))
    torque[:, 0] = -situation.body_rate[:, 1] * momentum
    torque[:, 1] = situation.body_rate[:, 0] * momentum
    torque[:, 2] = -inertia * (change @ SPIN)
    return Wrench(np.zeros((situation.size, 3)), torque)


def _speed(thrust: NDArray, constant: float) -> NDArray:
    """Rotor speed [rad/s]. Its change is a difference over a step, as the derivative of the root is infinite at 0."""
    return np.sqrt(np.maximum(thrust, 0.0) / constant)


ROTOR_INERTIA = Effect(
    "rotor_inertia",
    (Parameter("inertia", "kg m^2", 0.0, 0.0, 1e-6, 2e-9),),
    order=66,
    controllers=True,  # INDI: ctrlINDI.g2
    external=reaction,
    # own: a bar of 0.3 g and 46 mm; a Crazyflie's propeller and rotor have a tenth of this, in no file. Detection
    # limit: a sixth of a rod of 0.1 g and 46 mm; no rotor is lighter. Relative error: that of the yaw inertia.
    prior=Prior(own={"inertia": 4e-8}, relative_error={"inertia": AT_ONCE_SD}, detection_limit={"inertia": 3e-9}),
    needs=("body_rate", "attitude"),
    separates="yaw for 5 s at 2 Hz (spin-up), and roll while turning about yaw (gyroscope); weigh a propeller",
    needs_torques=True,
)
