"""The rigid body with its effects: from rotor thrusts and state to specific force and angular acceleration.

Vectorised over n moments; used by diagnosis and prediction. With all effects at neutral, the model is

    f = e3 sum(thrust)/m,   alpha = I^-1 (M - w x I w).

O is the middle of the rotors; positions and velocities are those of O. With the centre of mass at c from O, torques are
taken about the centre of mass, and the specific force at O is F/m - alpha x c - w x (w x c).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from crazyem.compiled import compiled
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Body, Effect, Effects, Offset, Situation
from crazyem.physics.lag import CAUSAL, HOLD, LINEAR, fit_predictor, hold_predictor, lagged_means
from crazyem.physics.rotors import wrench
from crazyem.vehicle import GRAVITY, Vehicle


@dataclass(frozen=True)
class RotorInput:
    """Commands or measured speeds of the rotors as thrusts, at m stamps.

    Attributes:
        time: (m,) s, increasing.
        thrust: (m, 4) N: settled thrust of each command, or thrust at each measured speed.
        voltage: (m,) V, NaN where unknown.
        flown: (m,) s since take-off.
        measured: thrusts come from measured rotor speeds, so the lag and effects on commands do not apply.
        aged: commands of a sampled closed loop: a step must not use commands later than its start.
        delay: s, known delay: mean hold of a command, and low pass of the measured rates.
    """

    time: NDArray
    thrust: NDArray
    voltage: NDArray
    flown: NDArray
    measured: bool
    aged: bool = True
    delay: float = 0.0


@dataclass(frozen=True)
class Motion:
    """Specific force (n, 3) m/s^2 at O, without gravity, and angular acceleration (n, 3) rad/s^2; body axes."""

    specific_force: NDArray
    angular_acceleration: NDArray


def vehicle_values(vehicle: Vehicle) -> dict[str, dict[str, float]]:
    """The vehicle's own values for parameters whose neutral value is the vehicle's."""
    return {effect.name: effect.own(vehicle) for effect in CATALOGUE.values() if effect.own is not None}


def active(effects: Effects, vehicle: Vehicle) -> list[tuple[Effect, dict]]:
    """The given effects with all their parameters, in the order of the catalogue."""
    own = vehicle_values(vehicle)
    return [(CATALOGUE[n], CATALOGUE[n].complete(effects[n], own.get(n, {}))) for n in CATALOGUE if n in effects]


def gain(found: list[tuple[Effect, dict]], what: str) -> float:
    """Product of the factors of effects (from `active`) on the "thrust" or "torque" of all rotors."""
    return math.prod(float(values[effect.parameters[0].name]) for effect, values in found if effect.gain == what)


def settled(inputs: RotorInput, *, vehicle: Vehicle, effects: Effects) -> tuple[NDArray, float, float]:
    """Settled thrust of the rotors at each stamp, with lag and delay.

    Returns: (m, 4) N; the lag [s]; the delay [s].
    """
    thrust = inputs.thrust
    lag, delay = (0.0 if inputs.measured else vehicle.motor_time_constant), inputs.delay
    for effect, values in active(effects, vehicle):
        if effect.commanded is not None and not inputs.measured:
            thrust = effect.commanded(
                thrust, time=inputs.time, flown=inputs.flown, voltage=inputs.voltage,
                hover=vehicle.mass * GRAVITY / 4, **values,
            )  # fmt: skip
        if effect.speed is not None and inputs.measured:
            thrust = effect.speed(thrust, **values)
        if effect.timing is not None:
            lag, delay = effect.timing(lag, delay, **values)
    return np.ascontiguousarray(thrust, float), (0.0 if inputs.measured else lag), delay


def rotor_thrust(
    inputs: RotorInput, nodes: NDArray, *, vehicle: Vehicle, effects: Effects, breaks: Sequence[int] = ()
) -> tuple[NDArray, NDArray]:
    """Mean thrust of each rotor, and its mean derivative, over the steps that end at nodes (n,) [s].

    `breaks`: rows at which a new stretch begins. These rows and the first one get the thrust at the node, and a rate of
    0. Returns (n, 4) N and (n, 4) N/s.
    """
    thrust, lag, delay = settled(inputs, vehicle=vehicle, effects=effects)
    mode = CAUSAL if inputs.aged and (inputs.measured or lag > 0) else LINEAR if inputs.measured else HOLD
    mean, rate = np.zeros((len(nodes), 4)), np.zeros((len(nodes), 4))
    unused = np.zeros((0, 4))
    predictor = fit_predictor(thrust) if mode == CAUSAL else hold_predictor()
    state = np.zeros(5)
    starts = sorted({0, *breaks, len(nodes)})
    for first, last in pairwise(starts):
        begin = nodes[first] - delay - 10 * max(lag, 0.02)
        at = max(0, int(np.searchsorted(inputs.time, begin, "right")) - 1)
        state[:4], state[4] = thrust[at], inputs.time[at]
        # The first row gets the thrust at its node. A mean over earlier commands would depend on the choice of the
        # first one, by up to 10 m/s^2 after rotors at rest; so would its rate.
        at = lagged_means(inputs.time, thrust, at, len(inputs.time), predictor, nodes, first, first + 1, mode, lag,
                          delay, state, mean, unused, rate)  # fmt: skip
        mean[first], rate[first] = state[:4], 0.0
        lagged_means(inputs.time, thrust, at, len(inputs.time), predictor, nodes, first + 1, last, mode, lag, delay,
                     state, mean, unused, rate)  # fmt: skip
    return mean, -rate


def body_of(vehicle: Vehicle, effects: Effects) -> Body:
    """Mass, inertia and centre of mass of the vehicle with the effects that change them."""
    xx, yy, zz = vehicle.inertia
    xy, xz, yz = vehicle.inertia_products
    body = Body(vehicle.mass, np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), np.zeros(3))
    for effect, values in active(effects, vehicle):
        if effect.body is not None:
            body = effect.body(body, **values)
    return body


def motion(situation: Situation, *, vehicle: Vehicle, effects: Effects) -> Motion:
    """Specific force and angular acceleration at n moments; `situation.thrust` is the thrust after the lag."""
    acting = active(effects, vehicle)
    n = situation.size
    body = body_of(vehicle, effects)
    situation = replace(situation, lagged=situation.thrust)
    for effect, values in acting:
        if effect.rotors is not None:
            situation = situation.with_thrust(effect.rotors(situation, **values))
    shaken = any(effect.couples_air for effect, _ in acting)
    air = np.zeros((n, 3))
    for effect, values in acting:
        if effect.air is not None:
            air = air + effect.air(situation, **values)
    situation = replace(situation, air=air, shaken=shaken)
    rotors = wrench(situation.thrust, arm=vehicle.arm, torque_per_thrust=vehicle.torque_per_thrust)
    torque = rotors[:, 1:]
    for effect, values in acting:
        if effect.turning is not None:
            torque = effect.turning(torque, **values)
    force = np.zeros((n, 3))
    force[:, 2] = rotors[:, 0]
    for effect, values in acting:
        if effect.external is not None:
            added = effect.external(situation, body, **values)
            force = force + added.force
            torque = torque + added.torque
    free = accelerated(force, torque, body=body, body_rate=situation.body_rate)
    tied = [(effect, values) for effect, values in acting if effect.tied is not None]
    if not tied:
        return free
    situation = replace(situation, specific_force=free.specific_force, angular_acceleration=free.angular_acceleration)
    for effect, values in tied:
        added = effect.tied(situation, body, **values)  # type: ignore[misc]
        force = force + added.force
        torque = torque + added.torque
    return accelerated(force, torque, body=body, body_rate=situation.body_rate)


@compiled
def _accelerated(force, torque, rate, centre, mass, inertia, inverse, specific, angular):
    """Loop of `accelerated`; specific (n, 3) m/s^2 and angular (n, 3) rad/s^2 receive the result."""
    cx, cy, cz = centre[0], centre[1], centre[2]
    for k in range(len(force)):
        fx, fy, fz = force[k, 0], force[k, 1], force[k, 2]
        wx, wy, wz = rate[k, 0], rate[k, 1], rate[k, 2]
        hx = inertia[0, 0] * wx + inertia[0, 1] * wy + inertia[0, 2] * wz
        hy = inertia[1, 0] * wx + inertia[1, 1] * wy + inertia[1, 2] * wz
        hz = inertia[2, 0] * wx + inertia[2, 1] * wy + inertia[2, 2] * wz
        tx = torque[k, 0] - (cy * fz - cz * fy) - (wy * hz - wz * hy)
        ty = torque[k, 1] - (cz * fx - cx * fz) - (wz * hx - wx * hz)
        tz = torque[k, 2] - (cx * fy - cy * fx) - (wx * hy - wy * hx)
        ax = inverse[0, 0] * tx + inverse[0, 1] * ty + inverse[0, 2] * tz
        ay = inverse[1, 0] * tx + inverse[1, 1] * ty + inverse[1, 2] * tz
        az = inverse[2, 0] * tx + inverse[2, 1] * ty + inverse[2, 2] * tz
        angular[k, 0], angular[k, 1], angular[k, 2] = ax, ay, az
        ux, uy, uz = wy * cz - wz * cy, wz * cx - wx * cz, wx * cy - wy * cx
        specific[k, 0] = fx / mass - (ay * cz - az * cy) - (wy * uz - wz * uy)
        specific[k, 1] = fy / mass - (az * cx - ax * cz) - (wz * ux - wx * uz)
        specific[k, 2] = fz / mass - (ax * cy - ay * cx) - (wx * uy - wy * ux)


def accelerated(force: NDArray, torque: NDArray, *, body: Body, body_rate: NDArray) -> Motion:
    """Equations of Newton and Euler: force (n, 3) N at O and torque (n, 3) N m about O -> motion of O, body axes."""
    rows = [np.ascontiguousarray(v, np.float64) for v in (force, torque, body_rate)]
    motion = Motion(np.empty(rows[0].shape), np.empty(rows[0].shape))
    _accelerated(
        *rows, np.asarray(body.centre, np.float64), float(body.mass), body.inertia, np.linalg.inv(body.inertia),
        motion.specific_force, motion.angular_acceleration,
    )  # fmt: skip
    return motion


def measured(situation: Situation, *, vehicle: Vehicle, effects: Effects) -> Offset:
    """Sum of the measurement errors of all effects: shown less true values."""
    state, force, tilt = np.zeros((situation.size, 12)), np.zeros((situation.size, 3)), np.zeros((situation.size, 3))
    for effect, values in active(effects, vehicle):
        if effect.measured is not None:
            turned = tilt if situation.tilt is None else situation.tilt + tilt
            added = effect.measured(replace(situation, tilt=turned) if effect.uses_force else situation, **values)
            state += added.state
            force += added.specific_force
            tilt = tilt + added.filter_tilt
    return Offset(state, force, tilt)
