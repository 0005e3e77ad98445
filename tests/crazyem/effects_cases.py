"""Situations for the tests of effects: at rest, random but reproducible, and the vehicle that they are about."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from crazyem.physics.effects.effect import Situation
from crazyem.vehicle import Vehicle, load_vehicle

CF2 = load_vehicle("cf2")
ROTORS = replace(CF2, rotor_constant=2.5e-8)
G = 9.81


def still(n: int = 1, *, thrust: float = 0.07, vehicle: Vehicle = ROTORS, **changes) -> Situation:
    """n rows at 100 Hz of a level drone that neither moves nor turns; keywords replace fields (broadcast)."""
    time = 0.01 * np.arange(n)
    none = np.zeros((n, 3))
    constant = np.nan if vehicle.rotor_constant is None else vehicle.rotor_constant
    situation = Situation(
        time=time, flown=time, step=np.where(np.arange(n) > 0, 0.01, 0.0), position=none, height=np.ones(n),
        velocity=none, rotation=np.tile(np.eye(3), (n, 1, 1)), body_rate=none, specific_force=none,
        angular_acceleration=none, thrust=np.full((n, 4), thrust), thrust_rate=np.zeros((n, 4)),
        voltage=np.full(n, 3.7), rotor_constant=constant, air=none,
    )  # fmt: skip
    shaped = {
        key: np.broadcast_to(np.asarray(value, float), getattr(situation, key).shape)
        if isinstance(getattr(situation, key), np.ndarray)
        else value
        for key, value in changes.items()
    }
    return replace(situation, **shaped)


def wild(n: int, *, seed: int, speed: float = 1.0, vehicle: Vehicle = ROTORS) -> Situation:
    """n rows of anything; not a path."""
    rng = np.random.default_rng(seed)
    draw = lambda: speed * rng.standard_normal((n, 3))  # noqa: E731
    return still(
        n, vehicle=vehicle, position=draw(), height=rng.random(n), velocity=draw(), body_rate=3 * draw(),
        rotation=Rotation.random(n, random_state=seed).as_matrix(), specific_force=draw(), angular_acceleration=draw(),
        thrust=0.12 * rng.random((n, 4)), thrust_rate=0.3 * rng.standard_normal((n, 4)),
        voltage=3.2 + rng.random(n), air=np.zeros((n, 3)),
    )  # fmt: skip
