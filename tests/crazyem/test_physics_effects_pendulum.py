"""The load as an estimated state: it is found from how it pulls, where no path says where it is."""

import numpy as np
import pytest
from hanging_load import Array, G, hang, tilted
from hypothesis import given
from hypothesis import strategies as st

from crazyem.physics.effects.pendulum import HANGING, WANDERING, _slopes, swing_along, swing_on, watched_along

DRONE, LOAD, LENGTH = 0.03, 0.003, 0.25
SHARE = LOAD / (DRONE + LOAD)
NOISE = 0.01  # m/s^2 sqrt(s)
STEP = 0.01


def shaken(t: float) -> Array:
    """A push near the pendulum's own 1 Hz: swings past the horizon within seconds."""
    return DRONE * np.array([3.4 * np.sin(5.6 * t), 3.4 * np.sin(6.1 * t + 1.0), np.sin(9.0 * t)]) + [0, 0, 0.0322 * G]


def steps_of(hanging, push, seed: int = 1) -> dict[str, Array]:
    """What a filter would know: a path with noise, the drone's own force, and the force that was seen, over steps."""
    rng = np.random.default_rng(seed)
    time, gap = hanging.time, np.r_[0.0, np.diff(hanging.time)]
    free = np.array([push(t - 0.5 * STEP) for t in time]) / DRONE
    seen = np.zeros_like(free)
    seen[1:] = np.diff(hanging.velocity, axis=0) / STEP + [0, 0, G]
    seen += NOISE / np.sqrt(STEP) * rng.standard_normal(seen.shape)
    velocity = hanging.velocity + 1e-3 * rng.standard_normal(seen.shape)
    return {
        "gap": gap, "broken": gap == 0, "velocity": velocity, "air": np.zeros_like(free),
        "rotation": np.tile(np.eye(3), (len(time), 1, 1)), "free": free, "shown": seen, "noise": np.full(3, NOISE),
    }  # fmt: skip


def plain(steps):
    return {name: steps[name] for name in ("gap", "broken", "velocity", "air")}


def apart(one: Array, other: Array) -> Array:
    """rad between directions."""
    return np.arccos(np.clip(np.sum(one[:, :3] * other[:, :3], axis=1), -1, 1))


def calm(t: float) -> Array:
    return np.array([0, 0, (DRONE + LOAD) * G])


def test_a_load_that_swings_by_itself_is_found() -> None:
    """Below a drone that hovers; the path alone has it hang still, 0.4 rad from where it is."""
    truth = hang(calm, STEP * np.arange(800), drone=DRONE, load=LOAD, length=LENGTH, start=tilted(0.4))
    steps = steps_of(truth, calm)
    found = watched_along(**steps, length=LENGTH, share=SHARE)
    alone = swing_along(**plain(steps), length=LENGTH)
    late = truth.time > 3.0
    assert apart(found, truth.swing)[late].max() < 0.03
    assert apart(alone, truth.swing)[late].max() > 0.1
    rate = np.linalg.norm(found[:, 3:] - truth.swing[:, 3:], axis=1)
    assert rate[late].max() < 0.03 * np.sqrt(G / LENGTH) * 2


def test_a_load_that_is_shaken_stays_found_where_its_path_loses_it() -> None:
    truth = hang(shaken, STEP * np.arange(2500), drone=DRONE, load=LOAD, length=LENGTH, start=tilted(0.02))
    steps = steps_of(truth, shaken)
    assert np.degrees(np.arccos(-truth.swing[:, 2])).max() > 90
    late = truth.time > 15.0
    found = apart(watched_along(**steps, length=LENGTH, share=SHARE), truth.swing)[late]
    alone = apart(swing_along(**plain(steps), length=LENGTH), truth.swing)[late]
    assert np.sqrt(np.mean(found**2)) < 0.05
    assert np.sqrt(np.mean(alone**2)) > 0.5
    longer = apart(watched_along(**steps, length=1.02 * LENGTH, share=SHARE), truth.swing)[late]
    assert np.sqrt(np.mean(longer**2)) < 0.2  # a length that is a little wrong loses it no more


@given(at=st.integers(1, 198), size=st.floats(-5, 5))
def test_no_row_knows_its_own_pull_nor_a_later_one(at: int, size: float) -> None:
    truth = hang(calm, STEP * np.arange(200), drone=DRONE, load=LOAD, length=LENGTH, start=tilted(0.1))
    steps = steps_of(truth, calm)
    changed = {**steps, "shown": steps["shown"] + size * (np.arange(200) >= at)[:, None] * [1, 0, 0]}
    before, after = (watched_along(**s, length=LENGTH, share=SHARE) for s in (steps, changed))
    np.testing.assert_array_equal(before[: at + 1], after[: at + 1])
    assert size == 0.0 or abs(size) < 1e-9 or not np.array_equal(before[at + 1], after[at + 1])


def test_of_what_is_not_seen_the_path_alone_tells() -> None:
    truth = hang(shaken, STEP * np.arange(400), drone=DRONE, load=LOAD, length=LENGTH, start=tilted(0.0))
    steps = steps_of(truth, shaken)
    unseen = {**steps, "shown": np.full_like(steps["shown"], np.nan)}
    found = watched_along(**unseen, length=LENGTH, share=SHARE)
    np.testing.assert_allclose(found, swing_along(**plain(steps), length=LENGTH), atol=1e-12)


def test_a_load_of_no_mass_or_without_noise_stays_finite() -> None:
    truth = hang(shaken, STEP * np.arange(100), drone=DRONE, load=LOAD, length=LENGTH, start=tilted(0.0))
    steps = steps_of(truth, shaken)
    for share, noise in ((0.0, 0.0), (SHARE, 0.0), (0.9, NOISE)):
        found = watched_along(**{**steps, "noise": np.full(3, noise)}, length=LENGTH, share=share)
        assert np.isfinite(found).all()
        np.testing.assert_allclose(np.linalg.norm(found[:, :3], axis=1), 1.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_slopes_are_derivatives(seed: int) -> None:
    """Of the equation of the module's docstring, by differences."""
    rng = np.random.default_rng(seed)
    n = rng.standard_normal(3)
    n /= np.linalg.norm(n)
    state = np.concatenate([n, np.cross(n, rng.standard_normal(3))])
    pull, velocity, air = rng.standard_normal((3, 3)) * [[5], [1], [1]]

    def slope(x):
        n, turning = x[:3], x[3:]
        drawn = pull - 0.1 * (velocity + LENGTH * turning - air)
        return np.concatenate([turning, (drawn - n * (n @ drawn)) / LENGTH - (turning @ turning) * n])

    found = np.zeros((6, 6))
    _slopes(state, pull, velocity, air, LENGTH, found)
    h = 1e-6
    by_differences = np.stack([(slope(state + h * e) - slope(state - h * e)) / (2 * h) for e in np.eye(6)], axis=1)
    np.testing.assert_allclose(found, by_differences, rtol=1e-5, atol=1e-5)


def test_the_filter_is_the_textbooks() -> None:
    """Kalman's equations by numpy, with transitions and pulls differentiated by differences."""
    truth = hang(shaken, STEP * np.arange(300), drone=DRONE, load=LOAD, length=LENGTH, start=tilted(0.2))
    steps = steps_of(truth, shaken)
    velocity, free, seen = steps["velocity"], steps["free"], steps["shown"]

    def on(x, k):
        acceleration = (velocity[k] - velocity[k - 1]) / STEP
        at = {"acceleration": acceleration[None], "velocity": velocity[k - 1 : k], "air": np.zeros((1, 3))}
        return swing_on(x[None], **at, step=np.full(1, STEP), length=LENGTH)[0]

    def pull(x, k):
        n, turning = x[:3], x[3:]
        drag = -0.1 * (velocity[k] + LENGTH * turning)
        return SHARE * (n @ (drag - free[k]) + LENGTH * turning @ turning) * n

    def derivative(function, x):
        h = 1e-6
        return np.stack([(function(x + h * e) - function(x - h * e)) / (2 * h) for e in np.eye(6)], axis=1)

    def flat(n):
        return np.kron(np.eye(2), np.eye(3) - np.outer(n, n))

    x, expected = tilted(0.0), [tilted(0.0)]
    p = np.diag([HANGING**2] * 2 + [0] + [HANGING**2 * G / LENGTH] * 2 + [0])
    for k in range(1, 300):
        transition = derivative(lambda s, k=k: on(s, k), x)
        x = on(x, k)
        expected.append(x)
        p = transition @ p @ transition.T + np.diag([STEP * (WANDERING / LENGTH) ** 2] * 3 + [0] * 3)
        p = flat(x[:3]) @ p @ flat(x[:3])
        shows = derivative(lambda s, k=k: pull(s, k), x)
        gain = p @ shows.T @ np.linalg.inv(shows @ p @ shows.T + NOISE**2 / STEP * np.eye(3))
        x = x + gain @ (seen[k] - free[k] - pull(x, k))
        p = (np.eye(6) - gain @ shows) @ p
        x[:3] /= np.linalg.norm(x[:3])
        x[3:] -= x[:3] * (x[:3] @ x[3:])
    found = watched_along(**steps, length=LENGTH, share=SHARE)
    np.testing.assert_allclose(found[:, :3], np.array(expected)[:, :3], atol=2e-3)
