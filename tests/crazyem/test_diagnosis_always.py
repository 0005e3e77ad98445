"""What is never exactly known: priors that depend on the flight and on the model, and what intervals have added."""

from types import SimpleNamespace

import numpy as np
import pytest
from closed_loop import DRONE

from crazyem.diagnosis.always import (
    AT_ONCE_SD,
    DAMPING_SD,
    INERTIA_SD,
    JITTER,
    PULL,
    VELOCITY_SD,
    jittery,
    nuisances,
    unsure,
)
from crazyem.diagnosis.model import Point
from crazyem.diagnosis.noise import first_guess

POINT = Point(DRONE, {}, first_guess())


def flown(*, speed: float, measured: bool = False) -> SimpleNamespace:
    """Flights that swing at these rms speeds [m/s] along x, y, z: 1, 2 and 4 times `speed`."""
    y = np.zeros((400, 13))
    y[:, 3:6] = np.sqrt(2) * speed * np.array([1, 2, 4]) * np.sin(np.arange(400) * np.pi / 20)[:, None]
    flight = SimpleNamespace(y=y, inputs=SimpleNamespace(measured=measured))
    return SimpleNamespace(flights=[flight], signals=frozenset({"position", "velocity", "attitude", "body_rate"}))


def sd_of(data: SimpleNamespace, point: Point, effect: str) -> np.ndarray:
    found = [p for c, p in nuisances(data, point, ()) if c.effect == effect]  # type: ignore[arg-type]
    return np.array(found[0]) ** -0.5 if found else np.zeros(0)


def test_velocities_are_as_wrong_as_an_onboard_estimate_jitters():
    assert jittery(flown(speed=0.1)) == pytest.approx(JITTER / np.array([0.1, 0.2, 0.4]))  # type: ignore[arg-type]
    assert sd_of(flown(speed=0.1), POINT, "velocity_scale")[0] == pytest.approx(VELOCITY_SD + JITTER / 0.1)
    still = sd_of(flown(speed=0.0), POINT, "velocity_scale")
    assert np.all(np.isfinite(still))
    assert np.all(still > 0.2)


def test_a_biased_gyro_tilts_the_attitude_that_a_filter_makes_of_it():
    assert sd_of(flown(speed=0.1), POINT, "attitude_misalignment").size == 0
    biased = POINT.with_effects({"gyro_bias": {"x": 0.03, "y": -0.04, "z": 0.0}})
    assert sd_of(flown(speed=0.1), biased, "attitude_misalignment") == pytest.approx(np.full(3, PULL * 0.05))
    unbiased = POINT.with_effects({"gyro_bias": dict.fromkeys("xyz", 0.0)})
    assert sd_of(flown(speed=0.1), unbiased, "attitude_misalignment").size == 0


def test_speeds_logged_too_seldom_look_like_a_damping_and_commands_have_their_own_way():
    """Without speeds, what commands miss is a torque with memory."""
    assert sd_of(flown(speed=0.1, measured=True), POINT, "rate_damping") == pytest.approx(np.full(3, DAMPING_SD))
    assert sd_of(flown(speed=0.1), POINT, "rate_damping").size == 0


def test_beside_heavy_rotors_the_yaw_inertia_is_hardly_known():
    heavy = POINT.with_effects({"rotor_inertia": {"inertia": 2e-8}})
    light, free = (sd_of(flown(speed=0.1), p, "inertia") / DRONE.inertia for p in (POINT, heavy))
    assert light == pytest.approx(INERTIA_SD)
    assert free == pytest.approx([*INERTIA_SD[:2], AT_ONCE_SD])
    assert sd_of(flown(speed=0.1, measured=True), heavy, "inertia")[2] == pytest.approx(
        INERTIA_SD[2] * DRONE.inertia[2]
    )


def test_intervals_hold_what_no_scatter_shows():
    heavy = POINT.with_effects({"rotor_inertia": {"inertia": 2e-8}})
    never = unsure(flown(speed=0.7), heavy)  # type: ignore[arg-type]
    # an attitude 1 ms late, at 3.1 rad/s: force over velocity = mass * rate^2 * delay
    assert never["linear_drag", "y"] == pytest.approx(DRONE.mass * 3.1**2 * 1e-3, rel=0.3)
    assert never["rotor_inertia", "inertia"] == pytest.approx(AT_ONCE_SD * 2e-8)
    assert never["input_delay", "delay"] > 0  # and of what is always free
    assert ("thrust_scale", "scale") not in never
