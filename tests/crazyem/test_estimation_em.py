"""EM over a window: it climbs, full and incremental passes agree, scoring is right, and the noise is found.

The slow tests are the statistics: bias and coverage over many flights.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import synthetic
from scipy.stats import binom

from crazyem.estimation.em import WindowEM, displaced, offset
from crazyem.estimation.inputs import InputHistory
from crazyem.estimation.model import DELAY_UNIT, NAMES, Noise, setup_for
from crazyem.estimation.online import OnlineEstimator
from crazyem.estimation.tape import Tape
from crazyem.physics.lag import CAUSAL
from crazyem.vehicle import load_vehicle

LAGGED = replace(load_vehicle("cf2"), thrust_curve=(), rotor_constant=None, thrust_max=math.inf)
TRUTH = synthetic.Truth()
TRUE = np.array([TRUTH.mass, *TRUTH.inertia, TRUTH.lag])


def window(seed: int = 1, duration: float = 3.0) -> tuple[WindowEM, int]:
    """A flight on the tape, nothing filtered yet; and how many rows."""
    flight = synthetic.fly(TRUTH, seed=seed, duration=duration)
    n = len(flight.time)
    tape, inputs = Tape(n), InputHistory(CAUSAL)
    for k in range(n):
        inputs.append(float(flight.time[k]), flight.wrench[k], needed_from=0.0)
        tape.append(float(flight.time[k]), flight.y[k], starts=k == 0, keep=n)
    return WindowEM(setup_for(LAGGED), tape, inputs), n


def at_truth(em: WindowEM) -> None:
    """Put the parameters and the noise where they truly are."""
    theta = em.parameters.theta.copy()
    theta[:5] = TRUE
    impulse = np.array([1e-4, 1e-4, TRUTH.force_noise / TRUTH.mass, *(TRUTH.torque_noise / np.array(TRUTH.inertia))])
    em.parameters = replace(em.parameters, theta=theta, noise=Noise(impulse, np.array([*TRUTH.sensor, 0.1])))


def log_posterior(em: WindowEM, n: int, parameters) -> float:
    """Likelihood of the innovations times the priors, at other parameters."""
    em.parameters = parameters
    em.refill_inputs(0, n)
    prior = em.setup.prior
    value = em.forward(0, n, restart=True)
    far = offset(parameters.theta, prior.centre, em.setup.unit)[em.setup.free]
    noise = (parameters.noise.logs - prior.noise.logs) / prior.noise_sd
    return value - 0.5 * np.sum(far**2 * prior.precision[em.setup.free]) - 0.5 * np.sum(noise**2)


def test_em_climbs():
    """Every full EM pass raises the posterior until it is nearly flat. The lag's linearisation makes it EM almost."""
    em, n = window()
    values = []
    for _ in range(12):
        values.append(log_posterior(em, n, em.parameters))
        em.backward(0, n)
        em.parameters = em.maximise(0, n)
    gains = np.diff(values)
    assert gains[0] > 100
    assert np.all(gains > -0.5)
    assert values[-1] - values[0] > 500


def test_converged_is_a_maximum_of_the_posterior():
    """At the end, no parameter moved by its standard deviation either way is better; the drop is half a unit, about."""
    em, n = window()
    info = em.converge(0, n, passes=80)
    best = em.parameters
    top = log_posterior(em, n, best)
    # the standard deviation given the others: 1 / sqrt(diagonal of the information)
    curvature = np.diag(info.matrix) + em.setup.prior.precision
    for i in range(6):
        for sign in (1, -1):
            step = np.zeros(len(NAMES))
            step[i] = sign / np.sqrt(curvature[i])
            theta = displaced(best.theta, step, em.setup.unit)
            drop = top - log_posterior(em, n, replace(best, theta=theta))
            assert 0.25 < drop < 0.85, (NAMES[i], sign, drop)


def test_the_score_is_the_slope_of_the_likelihood():
    """At the truth, through filter, lag and delay and all; in units of a standard deviation."""
    em, n = window(seed=3)
    at_truth(em)
    em.refill_inputs(0, n)
    em.forward(0, n, restart=True)
    info = em.information(0, n)
    score = em.tape.score[:n].sum(0)
    base = em.parameters
    predictor_free = 5  # a delay moves which commands are known: its slope is checked in test_estimation_kernels
    for i in range(predictor_free):
        values = []
        for sign in (1, -1):
            step = np.zeros(len(NAMES))
            step[i] = sign * 1e-3
            em.parameters = replace(base, theta=displaced(base.theta, step, em.setup.unit))
            em.refill_inputs(0, n)
            values.append(em.forward(0, n, restart=True))
        sd = 1 / np.sqrt(info.matrix[i, i])
        assert score[i] * sd == pytest.approx((values[0] - values[1]) / 2e-3 * sd, abs=0.1), NAMES[i]


def test_scores_at_the_truth_have_mean_zero_and_the_variance_of_the_information():
    """20 flights: the sum of the score over its promised standard deviation is standard normal."""
    scores = []
    for seed in range(20):
        em, n = window(seed=100 + seed, duration=1.5)
        at_truth(em)
        em.refill_inputs(0, n)
        em.forward(0, n, restart=True)
        info = em.information(0, n)
        scores.append(em.tape.score[40:n, :4].sum(0) / np.sqrt(np.diag(info.matrix)[:4]))
    scores = np.array(scores)
    # mean of 20 standard normals: sd 0.22; four of these. Variance: chi2_20 / 20 within 0.3..2.3 but for 1 in 1000.
    assert np.all(np.abs(scores.mean(0)) < 0.9)
    assert np.all(scores.std(0) < 1.5)


def test_offset_and_displaced_are_inverse():
    setup = setup_for(LAGGED)
    step = np.linspace(-0.5, 0.5, len(NAMES))
    moved = displaced(setup.start.theta, step, setup.unit)
    np.testing.assert_allclose(offset(moved, setup.start.theta, setup.unit), step, atol=1e-12)
    assert np.all(moved[:5] > 0)
    assert moved[5] - setup.start.theta[5] == pytest.approx(step[5] * DELAY_UNIT)


def test_a_vehicle_without_lag_holds_its_lag_and_delay_fixed():
    setup = setup_for(load_vehicle("zhao"))
    assert setup.free.tolist() == [True] * 4 + [False] * (len(NAMES) - 4)
    em = WindowEM(setup, Tape(10), InputHistory(CAUSAL))
    assert em.parameters.theta[4] == 0.0


def test_noise_never_collapses_on_perfect_data():
    """Data without any noise: scales end at or above their floors, and nothing is NaN."""
    quiet = replace(TRUTH, force_noise=0.0, torque_noise=0.0, sensor=(1e-9, 1e-9, 1e-9, 1e-9))
    flight = synthetic.fly(quiet, seed=2, duration=3.0)
    estimator = OnlineEstimator(LAGGED, every=25)
    for sample in synthetic.samples(flight):
        estimator.feed(sample)
    final = estimator.finish()
    assert all(np.isfinite(p.value) and p.value > 0 for p in list(final.parameters.values())[:5])
    assert all(v > 0 for v in final.noise.values())
    assert final["mass"].value == pytest.approx(TRUTH.mass, rel=0.005)


# Many flights --------------------------------------------------------------------------------------------------

SEEDS = 40


def fly_many(truth) -> tuple[np.ndarray, ...]:
    """Relative errors, relative sds, hits (SEEDS, 5), and how far the online estimate was from finish() in sds."""
    errors, sds, hits, gaps = [], [], [], []
    true = np.array([truth.mass, *truth.inertia, truth.lag])
    for seed in range(SEEDS):
        estimator = OnlineEstimator(LAGGED, every=12)
        last = None
        for sample in synthetic.samples(synthetic.fly(truth, seed=1000 + seed, duration=5.0)):
            last = estimator.feed(sample) or last
        final = estimator.finish()
        assert last is not None
        rows = [final[name] for name in NAMES[:5]]
        value, sd = np.array([p.value for p in rows]), np.array([p.sd for p in rows])
        low, high = np.array([p.ci95 for p in rows]).T
        errors.append(value / true - 1)
        sds.append(sd / value)
        hits.append((low <= true) & (true <= high))
        gaps.append(np.abs(np.array([last[n].value for n in NAMES[:5]]) - value) / sd)
    return tuple(map(np.array, (errors, sds, hits, gaps)))


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("dither", [2e-4, 0.0], ids=["dither", "hover"])
def test_intervals_cover_and_nothing_is_biased(dither):
    """40 flights of 5 s each: 95 % intervals cover, errors are no larger than promised, and their mean is near zero.

    With coverage 0.95 fewer than 34 hits of 40 have probability 0.0033 (binomial), so 85 % is the bound; the
    intervals may be conservative (noise of sampled commands is counted in), so 40 of 40 is fine.
    A mean of 40 errors has a standard deviation of 0.16 sd; 0.7 sd allows for the prior's pull and for the little bias
    that commands of a 500 Hz controller leave when they are logged at 100 Hz. (That bias grows with the noise that the
    controller feeds into its commands: white attitude noise of 3 mrad instead of 1 mrad makes it 2 % in dither.)
    """
    assert binom.cdf(33, SEEDS, 0.95) < 0.005
    errors, sds, hits, gaps = fly_many(replace(TRUTH, dither=dither, sensor=(1e-3, 1e-2, 1e-3, 2e-3)))
    typical = np.sqrt(np.mean(sds**2, 0))
    report = (
        f"bias {errors.mean(0)}, rms {np.sqrt(np.mean(errors**2, 0))}, sd {typical}, cover {hits.sum(0)} of {SEEDS}, "
        f"online to converged in sd: median {np.median(gaps, 0)}, largest {gaps.max(0)}"
    )
    print(report)
    assert np.all(hits.sum(0) >= 34), report
    assert np.all(np.abs(errors.mean(0)) < 0.7 * typical), report
    assert np.all(np.median(gaps, 0) < 0.25), report
    if dither:
        assert np.all(typical[1:4] < 0.05), report  # and they are not right by being wide


def test_incremental_passes_come_close_to_the_converged_one():
    """The last estimate on the way against finish(): same window, within a fraction of the standard deviation."""
    flight = synthetic.fly(TRUTH, seed=7, duration=4.5)
    estimator = OnlineEstimator(LAGGED, window=400)
    last = None
    for sample in synthetic.samples(flight):
        last = estimator.feed(sample) or last
    final = estimator.finish()
    assert last is not None
    for name in NAMES[:5]:
        assert abs(last[name].value - final[name].value) < 0.3 * final[name].sd, name
