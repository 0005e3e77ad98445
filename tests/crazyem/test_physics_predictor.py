"""What predicts the next commands: weights that made them, units, and a loop that answers to what it measures."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyem.physics.lag import CAUSAL, lagged_means
from crazyem.physics.predictor import ORDER, OWN, WIDTH, fit_predictor, hold_predictor

seeds = st.integers(0, 2**32 - 1)
UNIT = np.array([0.05, 1e-5, 2e-5, 1e-6])


def answering(rng, *, n=4000, behind=0.002):
    """Commands (n, 4) of which each answers to the rates (n, 3) measured `behind` before it, its past, and noise."""
    times = np.arange(n) * 0.01
    nodes = times - behind
    rates = rng.normal(size=(n, 3))
    gain = rng.normal(size=(4, 6))
    x = np.zeros((n, 4))
    for k in range(3, n):
        known = np.concatenate([rates[k], rates[k - 1]])
        x[k] = 0.5 * x[k - 1] - 0.2 * x[k - 3] + gain @ known + 0.1 * rng.normal(size=4)
    return times, UNIT * (3.0 + x), nodes, rates, gain


def test_weights_of_rates_are_those_that_made_the_commands():
    times, commands, nodes, rates, gain = answering(np.random.default_rng(1))
    fitted = fit_predictor(commands, times, nodes, rates)
    assert fitted.shape == (4, WIDTH)
    np.testing.assert_allclose(fitted[:, OWN : OWN + ORDER], np.tile([0.5, 0.0, -0.2], (4, 1)), atol=0.02)
    np.testing.assert_allclose(fitted[:, 2 * OWN :] / UNIT[:, None], gain, atol=0.02)
    np.testing.assert_array_equal(fitted[:, :OWN], fit_predictor(commands)[:, :OWN])


def test_rates_that_are_not_measured_or_far_apart_are_not_fitted():
    times, commands, nodes, rates, _ = answering(np.random.default_rng(2), n=600)
    alone = fit_predictor(commands)
    np.testing.assert_array_equal(fit_predictor(commands, times, nodes, np.full_like(rates, np.nan)), alone)
    np.testing.assert_array_equal(fit_predictor(commands, times, 10 * nodes, rates), alone)
    np.testing.assert_array_equal(fit_predictor(commands, times, nodes[:1], rates[:1]), alone)
    np.testing.assert_array_equal(alone[:, 2 * OWN :], 0.0)
    rates[::3] = np.nan  # where they are not there, the rest is enough
    assert np.all(np.isfinite(fit_predictor(commands, times, nodes, rates)))


def damping_of(rng, *, with_rates):
    """d(rate)/dt over rate, by regression, of a body without damping whose loop answers to its rates; 1/s.

    Euler steps of 1 ms, torque per inertia -40 rate with a lag of 20 ms and what a pilot asks, measured and commanded
    at 100 Hz, commands 1 ms after the rates.
    """
    n, h, tau, gain = 40_000, 1e-3, 0.02, 40.0
    rate, lagged, asked, command = 0.0, 0.0, 0.0, 0.0
    rates, commands = np.zeros(n), np.zeros(n)
    noise = rng.normal(size=(n, 2))
    for k in range(n):
        rates[k] = rate
        asked += h * -5.0 * asked + 3.0 * np.sqrt(h) * noise[k, 0]
        command = gain * (asked - rate)
        commands[k] = command
        lagged += h / tau * (command - lagged)
        rate += h * lagged + 1.0 * np.sqrt(h) * noise[k, 1]
    nodes, times = np.arange(0, n, 10) * h, np.arange(1, n, 10) * h
    measured = np.zeros((len(nodes), 3))
    measured[:, 0] = rates[::10]
    told = np.zeros((len(times), 4))
    told[:, 1] = commands[1::10]
    seen = measured if with_rates else np.zeros((0, 3))
    predictor = fit_predictor(told, times, nodes, measured) if with_rates else fit_predictor(told)
    mean, scratch, more = (np.zeros((len(nodes), 4)) for _ in range(3))
    state = np.append(np.tile(told[0], 3), times[0])
    lagged_means(
        times, told, 0, len(times), predictor, seen, nodes, 1, len(nodes), CAUSAL, tau, 0.0, state, mean, scratch, more
    )
    known = np.stack([mean[51:, 1], measured[50:-1, 0]], 1)  # row k of the means is the step from node k - 1 to k
    return np.linalg.lstsq(known, np.diff(measured[50:, 0]) / 0.01, rcond=None)[0]


def test_an_answer_that_is_missing_from_the_input_reads_as_damping():
    both = np.array([[damping_of(np.random.default_rng(s), with_rates=w) for w in (False, True)] for s in range(4)])
    alone, known = both[:, 0], both[:, 1]
    assert np.all(alone[:, 1] < -0.8)  # 1/s, invented
    # what is left is of the last millisecond of a step, where the command after the next one acts
    assert np.all(np.abs(known[:, 1]) < 0.6 * np.abs(alone[:, 1]))
    assert np.abs(known[:, 1].mean()) < 0.4 * np.abs(alone[:, 1].mean())
    np.testing.assert_allclose(both[:, :, 0], 1.0, atol=0.05)  # and torque acts as it does


def test_predictor_recovers_an_autoregressive_process():
    rng = np.random.default_rng(2)
    weights = np.array([1.2, -0.5, 0.1])
    scale, centre = np.array([0.05, 1e-5, 2e-5, 1e-6]), np.array([0.35, 0.0, 1e-5, 0.0])
    x = np.zeros((4000, 4))
    for k in range(3, len(x)):
        x[k] = weights @ x[k - 3 : k][::-1] + rng.normal(size=4)
    fitted = fit_predictor(centre + scale * x)
    # standard error of a weight is about 1 / sqrt(n) = 0.016
    np.testing.assert_allclose(fitted[:, :ORDER], np.tile(weights, (4, 1)), atol=0.06)
    np.testing.assert_allclose(fitted[:, ORDER], (1 - weights.sum()) * centre, atol=0.06 * centre.max())


def test_predictor_holds_where_there_is_nothing_to_fit():
    hold = hold_predictor()
    np.testing.assert_array_equal(hold[:, 0], 1.0)
    constant = np.tile([0.3, 1e-4, 0.0, 1e-5], (500, 1))
    predicted = fit_predictor(constant)
    np.testing.assert_allclose(predicted[:, :ORDER] @ np.ones(ORDER) * constant[0] + predicted[:, ORDER], constant[0])
    few = np.random.default_rng(0).normal(size=(20, 4))
    np.testing.assert_array_equal(fit_predictor(few), hold)
    np.testing.assert_array_equal(fit_predictor(np.zeros((0, 4))), hold)


@given(seeds, st.floats(1e-9, 1e9))
@settings(max_examples=20, deadline=None)
def test_predictor_does_not_depend_on_units(seed, scale):
    x = np.random.default_rng(seed).normal(size=(300, 4)).cumsum(0)
    a, b = fit_predictor(x), fit_predictor(scale * x)
    np.testing.assert_allclose(a[:, :ORDER], b[:, :ORDER], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(a[:, ORDER] * scale, b[:, ORDER], rtol=1e-5, atol=1e-9 * scale)
