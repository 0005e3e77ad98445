"""The rotor lag: means over steps against brute-force integration, derivatives, the predictor; sampled commands."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from crazyem.physics.effects.timing import MODES, shrunk
from crazyem.physics.lag import CAUSAL, HOLD, LINEAR, PREDICTION_ORDER, fit_predictor, hold_predictor, lagged_means
from crazyem.physics.motion import RotorInput, rotor_thrust
from crazyem.vehicle import load_vehicle

seeds = st.integers(0, 2**32 - 1)


def run(times, commands, nodes, *, mode, tau, delay=0.0, predictor=None, start=None, splits=()):
    """Means, d/dtau, d/ddelay of the steps between nodes; in several calls if splits are given."""
    state = np.zeros(13)
    state[:12] = np.tile(commands[0] if start is None else start, 3)
    state[12] = nodes[0] - delay
    outputs = tuple(np.zeros((len(nodes), 4)) for _ in range(3))
    predictor = hold_predictor() if predictor is None else predictor
    edges = [1, *splits, len(nodes)]
    at = 0
    for first, last in pairwise(edges):
        at = lagged_means(
            times, commands, at, len(times), predictor, nodes, first, last, mode, tau, delay, state, *outputs
        )
    return *outputs, state


def brute_force(times, commands, nodes, *, hold, tau, delay, start, fine=4000):
    """tau dy/dt = u - y on a fine grid (trapezoidal rule), u from the stamps, and the mean of y over each step."""
    means = np.zeros((len(nodes), 4))
    y = np.array(start, float)
    for k in range(1, len(nodes)):
        t = np.linspace(nodes[k - 1], nodes[k], fine + 1) - delay
        h = t[1] - t[0]
        if hold:
            middle = np.clip(np.searchsorted(times, 0.5 * (t[:-1] + t[1:]), "right") - 1, 0, None)
            u0 = u1 = commands[middle]
        else:
            u = np.stack([np.interp(t, times, commands[:, c]) for c in range(4)], 1)
            u0, u1 = u[:-1], u[1:]
        total = np.zeros(4)
        for j in range(fine):
            if tau > 0:
                new = (y * (1 - h / (2 * tau)) + h / (2 * tau) * (u0[j] + u1[j])) / (1 + h / (2 * tau))
                total += 0.5 * h * (y + new)
                y = new
            else:
                total += 0.5 * h * (u0[j] + u1[j])
                y = u1[j]
        means[k] = total / (nodes[k] - nodes[k - 1])
    return means


def irregular(seed, *, n=12, m=6):
    """Stamps at uneven spacing, commands of very different scales, nodes out of step with them."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.002, 0.015, n))
    commands = rng.normal(size=(n, 4)) * [0.3, 1e-4, 1e-4, 1e-5]
    nodes = np.sort(rng.uniform(times[0] + 0.005, times[-1] + 0.01, m))
    nodes = nodes[np.concatenate([[True], np.diff(nodes) > 1e-4])]
    return rng, times, commands, nodes


@given(seeds, st.sampled_from([0.0, 0.003, 0.06]), st.sampled_from([0.0, 0.004]), st.booleans())
@settings(max_examples=12)
def test_means_are_those_of_a_fine_integration(seed, tau, delay, hold):
    rng, times, commands, nodes = irregular(seed)
    start = commands[0] + rng.normal(size=4) * [0.1, 1e-5, 1e-5, 1e-6]
    mode = HOLD if hold else LINEAR
    ours = run(times, commands, nodes, mode=mode, tau=tau, delay=delay, start=start)[0]
    truth = brute_force(times, commands, nodes, hold=hold, tau=tau, delay=delay, start=start)
    # a jump inside a fine interval is placed within span/4000 of a step
    np.testing.assert_allclose(ours, truth, atol=1e-3 * np.abs(commands).max(0).max(), rtol=2e-3)
    np.testing.assert_allclose(ours / [0.3, 1e-4, 1e-4, 1e-5], truth / [0.3, 1e-4, 1e-4, 1e-5], atol=3e-3)


@given(seeds)
def test_without_lag_a_linear_command_gives_the_mean_of_the_line(seed):
    _, times, commands, nodes = irregular(seed)
    ours = run(times, commands, nodes, mode=LINEAR, tau=0.0)[0]
    for k in range(1, len(nodes)):
        inner = np.concatenate([[nodes[k - 1]], times[(times > nodes[k - 1]) & (times < nodes[k])], [nodes[k]]])
        u = np.stack([np.interp(inner, times, commands[:, c]) for c in range(4)], 1)
        area = np.sum(0.5 * (u[1:] + u[:-1]) * np.diff(inner)[:, None], 0)
        np.testing.assert_allclose(ours[k], area / (nodes[k] - nodes[k - 1]), rtol=1e-9, atol=1e-15)


def after_a_while(seed, behind):
    """As `irregular`, with one long step at first, so that what is gone back over had been carried; nodes `behind` [s]
    stamps, or before them."""
    rng, times, commands, _ = irregular(seed, n=24)
    return rng, times, commands, np.concatenate([[times[0] - 0.005], times[12:18] + behind])


@given(seeds, st.integers(2, 6), st.floats(-0.012, 0.012), st.floats(-0.003, 0.0019))
def test_causal_means_are_blind_to_the_future(seed, k, delay, behind):
    """The mean of step k must not change with anything stamped after the step began.

    Nodes follow a stamp closely or come up to 3 ms before one, as measurements and commands of two log blocks; what is
    known is a matter of stamps, whatever the delay.
    """
    rng, times, commands, nodes = after_a_while(seed, behind)
    predictor = np.concatenate([rng.normal(size=(4, PREDICTION_ORDER)) * 0.4, np.zeros((4, 1))], 1)
    before = run(times, commands, nodes, mode=CAUSAL, tau=0.05, delay=delay, predictor=predictor)
    other = commands.copy()
    later = times > nodes[k - 1] + 1e-6
    other[later] += rng.normal(size=(later.sum(), 4))
    after = run(times, other, nodes, mode=CAUSAL, tau=0.05, delay=delay, predictor=predictor)
    for a, b in zip(before[:3], after[:3]):
        np.testing.assert_allclose(a[2 : k + 1], b[2 : k + 1], rtol=0, atol=1e-9)  # going back is exact to rounding
    if later[:-1].any() and times[later][0] < nodes[-1] - 0.02:
        assert not np.array_equal(before[0][k + 1 :], after[0][k + 1 :])


@given(seeds, st.floats(-0.012, 0.012), st.floats(-0.003, 0.003))
@example(0, 0.0, -1e-6)  # stamps at the very end of the microsecond within which they count as known
def test_causal_means_do_not_jump_with_the_delay(seed, delay, behind):
    """A delay that is fitted may pass where a shifted step begins at a stamp (it did: by 300 nats)."""
    rng, times, commands, nodes = after_a_while(seed, behind)
    predictor = np.concatenate([rng.normal(size=(4, PREDICTION_ORDER)) * 0.4, np.zeros((4, 1))], 1)
    for at in (delay, -behind):  # the second: every step begins at a stamp
        means = [
            run(times, commands, nodes, mode=CAUSAL, tau=0.05, delay=at + d, predictor=predictor)[0][2:]
            for d in (-1e-8, 1e-8)
        ]
        np.testing.assert_allclose(means[0] / [0.3, 1e-4, 1e-4, 1e-5], means[1] / [0.3, 1e-4, 1e-4, 1e-5], atol=1e-4)


def test_causal_means_carry_the_lag_along_what_came():
    """With a prediction that comes true, CAUSAL and LINEAR agree; the lag's state agrees whatever was predicted."""
    t = np.arange(60) * 0.01
    ramp = np.outer(1 + 3 * t, [0.3, 1e-4, -1e-4, 2e-5])
    line = np.zeros((4, PREDICTION_ORDER + 1))
    line[:, :2] = [2.0, -1.0]  # next = 2 latest - the one before
    nodes = t[5:] + 0.002
    causal = run(t, ramp, nodes, mode=CAUSAL, tau=0.06, delay=0.003, predictor=line)
    linear = run(t, ramp, nodes, mode=LINEAR, tau=0.06, delay=0.003)
    inside = slice(1, -2)
    for a, b in zip(causal[:3], linear[:3]):
        np.testing.assert_allclose(a[inside], b[inside], rtol=1e-9, atol=1e-12)
    held = run(t, ramp, nodes, mode=CAUSAL, tau=0.06, delay=0.003)
    np.testing.assert_allclose(held[3], linear[3], rtol=1e-12)
    assert np.all(np.abs(held[0][inside, 0]) < np.abs(linear[0][inside, 0]))  # holding lags behind a ramp


@given(seeds, st.sampled_from([LINEAR, HOLD, CAUSAL]), st.sampled_from([0.01, 0.06]))
def test_derivatives_are_those_of_finite_differences(seed, mode, tau):
    """With respect to tau everywhere; to the delay as the shift of the mean along the lagged curve."""
    _, times, commands, nodes = irregular(seed)
    scale = np.array([0.3, 1e-4, 1e-4, 1e-5])
    _, by_tau, by_delay, _ = run(times, commands, nodes, mode=mode, tau=tau, delay=0.002)
    h = 1e-3 * tau
    plus, minus = (run(times, commands, nodes, mode=mode, tau=tau + s * h, delay=0.002)[0] for s in (1, -1))
    np.testing.assert_allclose(by_tau * tau / scale, (plus - minus) / (2 * h) * tau / scale, atol=1e-5)
    if mode == CAUSAL:
        return
    # the lag starts at the first node whatever the delay, so the shift is exact once that is forgotten: make it so
    early = np.concatenate([[times[0] - 40 * tau], nodes])
    times = np.concatenate([[times[0] - 50 * tau, times[0] - tau], times])
    commands = np.concatenate([commands[[0, 0]], commands])
    by_delay = run(times, commands, early, mode=mode, tau=tau, delay=0.002)[2][1:]
    h = 1e-6
    plus, minus = (run(times, commands, early, mode=mode, tau=tau, delay=0.002 + s * h)[0][1:] for s in (1, -1))
    unit = 1e-3
    np.testing.assert_allclose(by_delay[1:] * unit / scale, (plus - minus)[1:] / (2 * h) * unit / scale, atol=2e-4)


@given(seeds, st.sampled_from([LINEAR, HOLD, CAUSAL]), st.integers(2, 5), st.sampled_from([0.0, 0.05]))
def test_incremental_calls_equal_one_call(seed, mode, split, tau):
    rng, times, commands, nodes = irregular(seed)
    predictor = np.concatenate([rng.normal(size=(4, PREDICTION_ORDER)) * 0.4, np.zeros((4, 1))], 1)
    split = min(split, len(nodes) - 1)
    one = run(times, commands, nodes, mode=mode, tau=tau, delay=0.003, predictor=predictor)
    if split < 2:
        return
    two = run(times, commands, nodes, mode=mode, tau=tau, delay=0.003, predictor=predictor, splits=(split,))
    for a, b in zip(one, two):
        np.testing.assert_array_equal(a, b)


def test_a_node_that_does_not_advance_gives_the_present_value():
    t = np.arange(10) * 0.01
    commands = np.outer(np.ones(10), [0.3, 0, 0, 0])
    nodes = np.array([0.02, 0.02, 0.03])
    mean = run(t, commands, nodes, mode=LINEAR, tau=0.05)[0]
    assert np.all(np.isfinite(mean))
    np.testing.assert_allclose(mean[1:], commands[:2])


def test_predictor_recovers_an_autoregressive_process():
    rng = np.random.default_rng(2)
    weights = np.array([1.2, -0.5, 0.1])
    scale, centre = np.array([0.05, 1e-5, 2e-5, 1e-6]), np.array([0.35, 0.0, 1e-5, 0.0])
    x = np.zeros((4000, 4))
    for k in range(3, len(x)):
        x[k] = weights @ x[k - 3 : k][::-1] + rng.normal(size=4)
    fitted = fit_predictor(centre + scale * x)
    # standard error of a weight is about 1 / sqrt(n) = 0.016
    np.testing.assert_allclose(fitted[:, :PREDICTION_ORDER], np.tile(weights, (4, 1)), atol=0.06)
    np.testing.assert_allclose(fitted[:, PREDICTION_ORDER], (1 - weights.sum()) * centre, atol=0.06 * centre.max())


def test_predictor_holds_where_there_is_nothing_to_fit():
    hold = hold_predictor()
    np.testing.assert_array_equal(hold[:, 0], 1.0)
    constant = np.tile([0.3, 1e-4, 0.0, 1e-5], (500, 1))
    predicted = fit_predictor(constant)
    np.testing.assert_allclose(
        predicted[:, :PREDICTION_ORDER] @ np.ones(PREDICTION_ORDER) * constant[0] + predicted[:, PREDICTION_ORDER],
        constant[0],
    )
    few = np.random.default_rng(0).normal(size=(20, 4))
    np.testing.assert_array_equal(fit_predictor(few), hold)
    np.testing.assert_array_equal(fit_predictor(np.zeros((0, 4))), hold)


@given(seeds, st.floats(1e-9, 1e9))
def test_predictor_does_not_depend_on_units(seed, scale):
    x = np.random.default_rng(seed).normal(size=(300, 4)).cumsum(0)
    a, b = fit_predictor(x), fit_predictor(scale * x)
    np.testing.assert_allclose(a[:, :PREDICTION_ORDER], b[:, :PREDICTION_ORDER], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(a[:, PREDICTION_ORDER] * scale, b[:, PREDICTION_ORDER], rtol=1e-5, atol=1e-9 * scale)


@given(
    seeds, st.sampled_from([0.0, 0.003, 0.06]), st.sampled_from([0.0, 0.004]), st.sampled_from([LINEAR, HOLD, CAUSAL])
)
def test_without_derivatives_the_means_are_the_same(seed, tau, delay, mode):
    _, times, commands, nodes = irregular(seed)
    mean, _, by_delay, state = run(times, commands, nodes, mode=mode, tau=tau, delay=delay)
    alone, late = np.zeros_like(mean), np.zeros_like(mean)
    lagged = np.append(commands[0], nodes[0] - delay)
    by_lag = np.zeros((0, 4))
    lagged_means(times, commands, 0, len(times), hold_predictor(), nodes, 1, len(nodes), mode, tau, delay, lagged,
                 alone, by_lag, late)  # fmt: skip
    np.testing.assert_array_equal(alone, mean)
    np.testing.assert_array_equal(late, by_delay)
    np.testing.assert_array_equal(lagged, state[[0, 1, 2, 3, 12]])


# -- commands that are logged slower than their loop -------------------------------------------------------------------


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
