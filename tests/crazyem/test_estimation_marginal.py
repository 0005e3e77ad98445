"""Noise scales that the data leave open are integrated out: the mixture's arithmetic, its oracle, and its coverage."""

from dataclasses import replace

import numpy as np
import pytest
import zhao_flight
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom
from test_estimation_scoring import FORCE, OFF, SENSOR_A, TORQUE, placed, true_noise

from crazyem.estimation import initial_state
from crazyem.estimation.em import Information
from crazyem.estimation.marginal import WIDE_PRIOR_SD, Marginal, MarginalRefresh, Node, combine, shifted
from crazyem.estimation.maximum import maximise_posterior
from crazyem.estimation.model import NAMES, KnownNoise
from crazyem.estimation.online import OnlineEstimator
from crazyem.estimation.scoring import P, log_posterior, scoring_steps
from crazyem.estimation.verdict import estimate_of
from crazyem.vehicle import load_vehicle

ZHAO = load_vehicle("zhao")
ORDINARY = ("position", "velocity", "body_rate")


def information(sd: float) -> Information:
    return Information(
        np.eye(P), sd**2 * np.eye(P), np.zeros(P), 0.0, np.ones(P), np.zeros(P), np.zeros(11), np.zeros(11)
    )


def node(weight: float, shift: float, sd: float) -> Node:
    return Node(weight, np.full(P, shift), np.full(P, sd))


def test_one_node_is_the_plain_interval():
    marginal = combine([[node(3.0, 0.0, 0.02)]], information(0.02), scales=(2,))
    np.testing.assert_allclose(marginal.sd, 0.02)
    np.testing.assert_allclose(marginal.low, -0.02 * 1.959964, rtol=1e-6)
    np.testing.assert_allclose(marginal.high, 0.02 * 1.959964, rtol=1e-6)
    np.testing.assert_array_equal(marginal.shift, 0.0)


@given(
    st.lists(
        st.tuples(st.floats(-6, 0), st.floats(-0.05, 0.05), st.floats(0.005, 0.1)), min_size=2, max_size=9
    )
)  # fmt: skip
def test_the_mixture_is_that_of_a_million_draws(rows):
    """Mean, standard deviation and quantiles against random numbers; four standard errors of those."""
    marginal = combine([[node(*row) for row in rows]], information(0.05), scales=(2,))
    weights = np.exp([row[0] for row in rows])
    rng = np.random.default_rng(0)
    which = rng.choice(len(rows), 200_000, p=weights / weights.sum())
    shift, sd = np.array([row[1] for row in rows])[which], np.array([row[2] for row in rows])[which]
    draws = shift + sd * rng.standard_normal(len(which))
    assert marginal.shift[0] == pytest.approx(draws.mean(), abs=4 * draws.std() / 400)
    assert marginal.sd[0] == pytest.approx(max(draws.std(), 0.025), rel=0.02)
    # a quantile's rank is within four standard deviations of a binomial's
    for bound, q in ((marginal.low[0], 0.025), (marginal.high[0], 0.975)):
        assert np.mean(draws < bound) == pytest.approx(q, abs=4 * np.sqrt(q * (1 - q) / len(draws)) + 1e-4)


def test_two_scales_add_what_each_adds():
    wide = [node(0.0, 0.0, 0.02), node(0.0, 0.0, 0.04)]
    one = combine([wide], information(0.02), scales=(2,))
    two = combine([wide, wide], information(0.02), scales=(2, 3))
    assert two.sd[0] ** 2 - 0.02**2 == pytest.approx(2 * (one.sd[0] ** 2 - 0.02**2))


def test_widening_for_correlation_is_kept():
    plain = combine([[node(0.0, 0.0, 0.02), node(0.0, 0.0, 0.03)]], information(0.02), scales=(2,))
    wider = replace(information(0.02), inflation=np.full(P, 2.0), covariance=0.04**2 * np.eye(P))
    double = combine([[node(0.0, 0.0, 0.02), node(0.0, 0.0, 0.03)]], wider, scales=(2,))
    np.testing.assert_allclose(double.sd, 2 * plain.sd)
    np.testing.assert_allclose(double.high, 2 * plain.high)


@pytest.mark.slow
def test_the_integral_is_that_of_a_fine_grid_with_everything_refitted():
    """Thrust noise on 25 points of log s, all else converged at each, against the nodes and their quadratic steps."""
    em, n = placed(21)
    settled = maximise_posterior(em, 0, n)
    assert settled.marginal is not None
    assert settled.marginal.scales == (2,)
    best, prior, scale = em.parameters, em.setup.prior, 2
    held = np.zeros(P + 11, bool)
    held[P + scale] = True
    weights, means, sds = [], [], []
    with initial_state.known_initial_state(em, 0, n) as begin:
        begin()
        for shift in np.linspace(-4, 3, 25):
            em.parameters = shifted(best, scale, shift)
            end = scoring_steps(em, 0, n, steps=10, tolerance=0.02, held=held)
            far = end.parameters.noise.logs[scale] - prior.noise.logs[scale]
            volume = 0.5 * np.linalg.slogdet(end.information)[1]
            weights.append(end.value + 0.5 * far**2 * (prior.noise_sd**-2 - WIDE_PRIOR_SD**-2) - volume)
            means.append(np.log(end.parameters.theta[0] / best.theta[0]))
            sds.append(end.sd[0])
    weights, means, sds = (np.array(a) for a in (weights, means, sds))
    weights = np.exp(weights - weights.max())
    weights /= weights.sum()
    mean = weights @ means
    sd = np.sqrt(weights @ (sds**2 + (means - mean) ** 2))
    assert settled.marginal.sd[0] == pytest.approx(sd, rel=0.15)
    assert settled.marginal.shift[0] == pytest.approx(mean, abs=0.3 * sd)
    assert settled.marginal.sd[0] > 0.7 * np.sqrt(settled.information.covariance[0, 0])


@pytest.mark.parametrize(
    "settings",
    [{"force": 0.005, "torque": 0.002, "signals": ORDINARY}, {"seconds": 2.0, "known": KnownNoise(FORCE, TORQUE)}],
    ids=["determined by the data", "known"],
)
def test_nothing_is_integrated_where_the_noise_is(settings):
    em, n = placed(22, **settings)
    assert maximise_posterior(em, 0, n).marginal is None


def test_the_estimate_says_the_integrated_interval():
    em, _ = placed(2, seconds=0.3)
    marginal = Marginal(np.full(P, 0.01), np.full(P, 0.02), np.full(P, -0.03), np.full(P, 0.06), (2,))
    said = estimate_of(
        em.parameters, em.setup, information(0.01), time=0.0, samples=60, updates=1, converged=True, marginal=marginal
    )["mass"]
    theta = em.parameters.theta[0]
    assert said.value == pytest.approx(theta * np.exp(0.01))
    assert said.ci95 == (pytest.approx(theta * np.exp(-0.03)), pytest.approx(theta * np.exp(0.06)))
    assert said.sd == pytest.approx(0.02 * said.value)


# The running estimator -----------------------------------------------------------------------------------------


def test_refreshing_leaves_the_estimator_where_it_was():
    em, n = placed(23)
    info = em.converge(0, n, passes=30)
    best, state = em.parameters, em.tape.xf[n - 1].copy()
    value = log_posterior(em, 0, n, best)
    em.sensitivities(0, n)
    refreshed = MarginalRefresh()
    marginals = []
    for _ in range(10):
        marginals.append(refreshed.refresh(em, 0, n, info))
        em.sensitivities(0, n)
        assert em.parameters is best
        np.testing.assert_array_equal(em.tape.xf[n - 1], state)
    assert log_posterior(em, 0, n, best) == value
    assert marginals[0] is None  # one node is no pair
    assert marginals[-1] is not None
    assert 2 in marginals[-1].scales
    full = maximise_posterior(em, 0, n)
    assert full.marginal is not None
    assert marginals[-1].sd[0] == pytest.approx(full.marginal.sd[0], rel=0.5)


def test_a_running_estimate_is_integrated_too_and_finish_agrees():
    flight = zhao_flight.fly(seed=24, seconds=6.0)
    estimator = OnlineEstimator(ZHAO, integration="euler")
    last = None
    for sample in zhao_flight.samples(flight):
        last = estimator.feed(sample) or last
    assert last is not None
    assert estimator._marginal is not None
    final = estimator.finish()
    assert final.converged
    for name in NAMES[:4]:
        assert abs(last[name].value - final[name].value) < 3 * final[name].sd, name
    assert 0.3 < last["mass"].sd / final["mass"].sd < 4


# Many flights --------------------------------------------------------------------------------------------------

SEEDS = 60


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("regime", ["quiet", "ordinary", "known"])
def test_intervals_cover(regime):
    """One window of 2.5 s from each of 60 flights; with coverage 0.95, fewer than 52 hits of 60 happen once in 250."""
    assert binom.cdf(51, SEEDS, 0.95) < 0.01
    quiet = regime == "quiet"
    force, torque = (FORCE, TORQUE) if quiet else (0.005, 0.002)
    known = KnownNoise(force=force, torque=torque, lateral_force=0.0) if regime == "known" else None
    errors, sds, hits, steps, conv = [], [], [], [], []
    for seed in range(SEEDS):
        em, n = placed(
            1000 + seed, seconds=2.5, force=force, torque=torque, off=OFF, noise=true_noise(1.3 * force, 1.3 * torque),
            signals=SENSOR_A if quiet else ORDINARY, known=known,
        )  # fmt: skip
        settled = maximise_posterior(em, 0, n)
        estimate = estimate_of(
            em.parameters, em.setup, settled.information, time=0.0, samples=n, updates=1, converged=settled.converged,
            marginal=settled.marginal,
        )  # fmt: skip
        said = [estimate[name] for name in NAMES[:4]]
        errors.append([np.log(p.value / t) for p, t in zip(said, zhao_flight.TRUE, strict=True)])
        sds.append([p.sd / p.value for p in said])
        hits.append([p.ci95[0] <= t <= p.ci95[1] for p, t in zip(said, zhao_flight.TRUE, strict=True)])
        steps.append(settled.steps)
        conv.append(settled.converged)
    z = np.array(errors) / np.array(sds)
    report = (
        f"{regime}: sd % {100 * np.median(sds, 0)}, rms of z {np.sqrt(np.mean(z**2, 0))}, mean {z.mean(0)}, "
        f"cover {np.sum(hits, 0)} of {SEEDS}, steps {np.mean(steps)} (most {max(steps)}), converged {np.sum(conv)}"
    )
    print(report)
    assert all(conv), report
    assert np.all(np.sum(hits, 0) >= 52), report
    assert np.all(np.sqrt(np.mean(z**2, 0)) > 0.6), report  # and not by being wide
    assert np.all(np.abs(z.mean(0)) < 0.55), report  # four standard errors
