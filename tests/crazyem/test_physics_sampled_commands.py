"""Commands that are logged slower than their loop: what is new in them acts for less than a sample."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from crazyem.physics.effects.timing import MODES, shrunk
from crazyem.physics.motion import RotorInput, rotor_thrust
from crazyem.vehicle import load_vehicle

Array = NDArray[np.float64]
DRONE = replace(load_vehicle("cf2"), thrust_curve=())


def loop(seed: int, *, jitter: float, seconds: float = 40.0) -> tuple[Array, Array]:
    """Stamps (n,) every 2 ms and thrusts (n, 4) [N]: slow sways of all modes, jitter of the torques about x, y."""
    rng = np.random.default_rng(seed)
    time = 2e-3 * np.arange(int(seconds / 2e-3))
    modes = np.zeros((time.size, 4))
    phase = rng.uniform(0, 6, (4, 6))
    for k, f in enumerate((0.3, 0.7, 1.1, 1.6, 2.0, 2.6)):
        modes += 0.004 * np.sin(2 * np.pi * f * time[:, None] + phase[:, k])
    modes[:, 1:3] += jitter * rng.normal(size=(time.size, 2))
    return time, 0.07 + modes @ MODES.T


def test_modes_are_orthonormal() -> None:
    np.testing.assert_allclose(MODES.T @ MODES, np.eye(4), atol=1e-15)


def test_only_what_is_new_is_shrunk_and_only_of_its_axis() -> None:
    """Jitter is hardly foretold, so its share is lost; sways of 3 Hz and less are, and stay; so does all thrust."""
    _, thrust = loop(1, jitter=0.02)
    sampled = thrust[::5]
    found = shrunk(sampled, tilt=0.6, turn=0.6) @ MODES
    modes = sampled @ MODES
    spread = [np.diff(m, axis=0).std(0) for m in (found, modes)]
    np.testing.assert_allclose(found[:, 0], modes[:, 0], atol=1e-15)
    np.testing.assert_allclose(found[:, 3], modes[:, 3], atol=1e-4)
    assert np.all(spread[0][1:3] < 0.55 * spread[1][1:3])
    one = shrunk(sampled, tilt=0.0, turn=0.6) @ MODES
    np.testing.assert_allclose(one[:, :3], modes[:, :3], atol=1e-15)


def test_with_the_share_that_errs_least_torques_are_as_strong_as_they_were() -> None:
    """Errors in the variables: the slope of the true torque on that of every fifth command is too small; an estimate
    that errs least has errors that are no part of it, so its slope is 1."""
    time, thrust = loop(2, jitter=0.012)
    nothing = np.full(time.size, np.nan)
    nodes = time[250::5]

    def torque(every: int, share: float) -> Array:
        effects = {"sampled_commands": {"tilt": share}} if share else {}
        inputs = RotorInput(time[::every], thrust[::every], nothing[::every], time[::every], False, aged=every > 1)
        return (rotor_thrust(inputs, nodes, vehicle=DRONE, effects=effects)[0] @ MODES)[:, 1:3].ravel()

    true = torque(1, 0.0)
    goal = true - true.mean()
    found = []
    for share in np.linspace(0.0, 1.0, 11):
        logged = torque(5, float(share))
        logged = logged - logged.mean()
        found.append((float(np.var(logged - goal)), float(logged @ goal / (logged @ logged))))
    least = min(found)
    assert found[0][1] < 0.9
    assert least[0] < 0.75 * found[0][0]
    assert least[1] == pytest.approx(1.0, abs=0.06)


def test_too_few_commands_stay_as_they_are() -> None:
    few = np.full((3, 4), 0.07)
    assert shrunk(few, tilt=0.5, turn=0.5) is few
