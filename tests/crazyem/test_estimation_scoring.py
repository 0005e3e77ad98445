"""Joint scoring: scores are slopes, steps converge where EM does not, and the way there is as promised.

Flights are those of zhao_flight.py: an explicit Euler simulation that shares nothing with the estimator.
"""

from dataclasses import replace

import numpy as np
import pytest
import reference
import zhao_flight
from hypothesis import given
from hypothesis import strategies as st

from crazyem.errors import UsageError
from crazyem.estimation import initial_state
from crazyem.estimation.em import WindowEM, displaced
from crazyem.estimation.inputs import InputHistory
from crazyem.estimation.maximum import Maximum, maximise_posterior
from crazyem.estimation.model import NAMES, SMALLEST_SCALES, KnownNoise, Noise, Parameters, setup_for
from crazyem.estimation.online import OnlineEstimator
from crazyem.estimation.scoring import (
    COORDINATES,
    POSTERIOR_SLACK,
    P,
    limit_step,
    log_posterior,
    moved,
    point,
    scoring_steps,
)
from crazyem.estimation.tape import Tape
from crazyem.physics.lag import HOLD
from crazyem.vehicle import load_vehicle

ZHAO = load_vehicle("zhao")
FORCE, TORQUE = 5e-4, 2e-5  # N sqrt(s), N m sqrt(s): measurement noise dominates
OFF = np.array([1.2, 0.7, 1.3, 0.7])
SENSOR_A = ("position", "body_rate")


def true_noise(force: float, torque: float) -> Noise:
    impulse = np.array([1e-4, 1e-4, force / zhao_flight.MASS, *(torque / zhao_flight.INERTIA)])
    return Noise(impulse, np.array([7.07e-3, 7.07e-3, 7.07e-3, 7.07e-2, 7.07e-2]))


def window(flight: zhao_flight.Flight, *, signals=SENSOR_A, known: KnownNoise | None = None) -> WindowEM:
    """The flight on a tape, filtered once with the vehicle file's parameters."""
    n = len(flight.time)
    tape, inputs = Tape(n), InputHistory(HOLD)
    for k in range(n):
        inputs.append(float(flight.time[k]), flight.wrench[k], needed_from=0.0)
        y = np.full(13, np.nan)
        for name in signals:
            if name != "specific_force":
                y[zhao_flight.COLUMNS[name]] = flight.y[k, zhao_flight.COLUMNS[name]]
        tape.append(float(flight.time[k]), y, starts=k == 0, keep=n)
        if "specific_force" in signals:
            tape.force[k] = flight.force[k]
    em = WindowEM(setup_for(ZHAO, integration="euler", known_noise=known), tape, inputs)
    em.refill_inputs(0, n)
    em.forward(0, n, restart=True)
    return em


def put(em: WindowEM, theta: np.ndarray, noise: Noise) -> Parameters:
    """Place `em` at mass and inertia (4,) and noise; known scales follow."""
    full = np.append(theta, np.zeros(len(NAMES) - 4))
    em.parameters = Parameters(full, em.setup.noise_at(full, noise.logs))
    return em.parameters


def placed(
    seed: int, *, seconds: float = 4.0, force: float = FORCE, torque: float = TORQUE, off: np.ndarray | float = 1.0,
    noise: Noise | None = None, **settings
) -> tuple[WindowEM, int]:  # fmt: skip
    """A flight on a tape with its number of rows, placed at the truth times `off`, by default with the true noise."""
    flight = zhao_flight.fly(seed=seed, seconds=seconds, force=force, torque=torque)
    em = window(flight, **settings)
    put(em, zhao_flight.TRUE * off, noise or true_noise(force, torque))
    return em, len(flight.time)


KNOWN = KnownNoise(force=FORCE, torque=TORQUE, lateral_force=3e-4)


@pytest.mark.parametrize("known", [None, KNOWN, KnownNoise(force=FORCE, body_rate=0.0707)], ids=["none", "all", "some"])
@pytest.mark.parametrize("signals", [SENSOR_A, (*SENSOR_A, "specific_force"), ("position", "velocity", "attitude")])
def test_the_score_is_the_slope_of_the_posterior(known, signals):
    """In every free coordinate, parameters and noise scales, off the maximum; in standard deviations."""
    em, n = placed(
        2, seconds=1.5, off=np.array([1.01, 0.97, 1.03, 0.98]), noise=too_much(), signals=signals, known=known
    )
    start = em.parameters
    with initial_state.known_initial_state(em, 0, n):  # with an attitude known to 20 degrees only, no filter is linear
        here = point(em, 0, n, log_posterior(em, 0, n, start))
        for i in np.flatnonzero(here.free):
            values = [
                log_posterior(em, 0, n, moved(em, start, sign * 1e-3 * np.eye(COORDINATES)[i])) for sign in (1, -1)
            ]
            slope = (values[0] - values[1]) / 2e-3
            sd = 1 / np.sqrt(here.information[i, i])
            assert here.score[i] * sd == pytest.approx(slope * sd, abs=0.1, rel=0.02), i  # an extended filter


def too_much(factor: float = 1.3) -> Noise:
    """The true noise times `factor`; more along x and y, where there is none."""
    noise = true_noise(FORCE, TORQUE)
    return Noise(factor * noise.impulse * [30, 30, 1, 1, 1, 1], factor * noise.measurement)


def test_known_scales_are_not_free_and_follow_mass_and_inertia():
    em = window(zhao_flight.fly(seed=2, seconds=0.5), known=KNOWN)
    start = put(em, zhao_flight.TRUE, true_noise(1.0, 1.0))
    assert start.noise.impulse[2] == pytest.approx(FORCE / zhao_flight.MASS)
    np.testing.assert_allclose(start.noise.impulse[3:], TORQUE / zhao_flight.INERTIA)
    heavier = moved(em, start, np.log(2.0) * np.eye(COORDINATES)[0])
    assert heavier.noise.impulse[2] == pytest.approx(0.5 * FORCE / zhao_flight.MASS)
    assert heavier.noise.impulse[0] == pytest.approx(0.5 * 3e-4 / zhao_flight.MASS)
    here = point(em, 0, 100, log_posterior(em, 0, 100, start))
    assert not here.free[P : P + 6].any()
    assert here.free[P + 6 :].all()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [({"force": 0.0}, "force"), ({"torque": (1.0, -1.0, 1.0)}, "torque"), ({"position": float("nan")}, "position"),
     ({"lateral_force": -1e-9}, "lateral force"), ({"body_rate": float("inf")}, "body rate")],
)  # fmt: skip
def test_known_noise_that_cannot_be_is_refused(arguments, word):
    with pytest.raises(UsageError, match=f"known noise of {word} must be a positive number"):
        KnownNoise(**arguments)


def test_no_lateral_force_is_possible_and_says_nothing_of_mass():
    setup = setup_for(ZHAO, known_noise=KnownNoise(lateral_force=0.0))
    assert setup.known_scales.tolist() == [True, True] + [False] * 9
    assert not setup.carried.any()
    assert not setup.known_squares.any()


@pytest.mark.parametrize("integration", ["midpoint", "euler", "semi-implicit"])
def test_the_rule_of_integration_reaches_the_setup(integration):
    lead = {"midpoint": 0.5, "euler": 0.0, "semi-implicit": 1.0}[integration]
    assert setup_for(ZHAO, integration=integration).lead == lead


def test_unknown_integration_is_refused():
    for build in (lambda: setup_for(ZHAO, integration="rk4"), lambda: OnlineEstimator(ZHAO, integration="rk4")):
        with pytest.raises(UsageError, match="unknown integration 'rk4'"):
            build()


def with_accelerometer(flight, *, wanted=True):
    """The estimator after a flight with accelerometer."""
    estimator = OnlineEstimator(ZHAO, integration="euler", accelerometer=wanted, every=10**9)
    for sample in zhao_flight.samples(flight, (*SENSOR_A, "specific_force")):
        estimator.feed(sample)
    estimator.finish()
    return estimator


def test_an_accelerometer_is_used_only_if_asked_for():
    flight = zhao_flight.fly(seed=3, seconds=0.5)
    for wanted in (False, True):
        tape = with_accelerometer(flight, wanted=wanted)._tape
        seen = ~np.isnan(tape.force[: tape.size])
        assert seen[1:].all() if wanted else not seen.any()
        if wanted:
            np.testing.assert_array_equal(tape.force[1 : tape.size], flight.force[1 : tape.size])


def test_an_accelerometer_out_of_its_range_is_a_missing_one():
    flight = zhao_flight.fly(seed=3, seconds=0.5)
    flight.force[20, 1] = 5e3
    estimator = with_accelerometer(flight)
    assert np.isnan(estimator._tape.force[20]).tolist() == [False, True, False]
    assert estimator.counters.missing == 1


@given(st.lists(st.floats(-50, 50), min_size=COORDINATES, max_size=COORDINATES))
def test_steps_are_bounded_and_keep_their_direction(step):
    step = np.array(step)
    out = limit_step(step)
    assert np.all(np.abs(out) <= 1.5)
    assert np.all(np.abs(out[:P]) <= 0.5)
    assert np.all(np.sign(out) * np.sign(step) >= 0)


def test_short_steps_stay_what_they_are():
    step = 1e-4 * np.linspace(-1, 1, COORDINATES)
    np.testing.assert_allclose(limit_step(step), step, atol=2e-8)


def settled_from_afar(seed: int) -> tuple[Maximum, np.ndarray]:
    """A window with little process noise, begun 30 % off in parameters and scales; its end, errors in sds (4,)."""
    em, n = placed(seed, off=OFF, noise=too_much())
    settled = maximise_posterior(em, 0, n)
    sd = np.sqrt(np.diag(settled.information.covariance))[:4]
    return settled, np.log(em.parameters.theta[:4] / zhao_flight.TRUE) / sd


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_settles_from_thirty_per_cent_off(seed):
    """Where EM does not: the score test over parameters and scales together, all of them 30 % off at the start."""
    settled, errors = settled_from_afar(seed)
    assert settled.converged
    assert settled.maps <= 3
    assert settled.steps <= 10
    assert np.all(np.abs(errors) < 5)


def test_the_end_is_a_maximum():
    """Half a standard deviation off in any free coordinate is not better; in the parameters the fall is half of 1/4."""
    em, n = placed(4, noise=too_much(1.0))
    end = scoring_steps(em, 0, n, steps=25, tolerance=0.02)
    for i in np.flatnonzero(end.free):
        for sign in (0.5, -0.5):
            step = sign / np.sqrt(end.information[i, i]) * np.eye(COORDINATES)[i]
            fall = end.value - log_posterior(em, 0, n, moved(em, end.parameters, step))
            assert fall > 0, i
            if i < 4:
                assert fall == pytest.approx(0.125, rel=0.5), i


def test_no_step_loses_what_it_must_not():
    em, n = placed(5, seconds=2.0, off=OFF, noise=true_noise(0.1, 0.1))
    values = [log_posterior(em, 0, n, em.parameters)]
    for _ in range(12):
        values.append(scoring_steps(em, 0, n, steps=1, tolerance=0.0).value)
    assert np.all(np.diff(values) > -POSTERIOR_SLACK)


def test_em_with_known_noise_ends_where_scoring_ends():
    """Two ways to one maximum: the M-step with fixed scales in newtons, and the chain rule through the noise score."""
    known = KnownNoise(
        force=0.005, torque=0.002, lateral_force=0.0, position=7.07e-3, velocity=7.07e-3, body_rate=7.07e-2
    )
    signals = ("position", "velocity", "body_rate")
    em, n = placed(7, seconds=3.0, force=0.005, torque=0.002, signals=signals, known=known)
    for _ in range(60):
        em.forward(0, n, restart=True)
        em.backward(0, n)
        em.parameters = em.maximise(0, n)
    by_em = em.parameters.theta[:4]
    end = scoring_steps(em, 0, n, steps=25, tolerance=1e-3)
    assert np.all(np.abs(np.log(end.parameters.theta[:4] / by_em)) < 0.1 * end.sd[:4])


# Where a blind window begins ------------------------------------------------------------------------------------


def test_the_smoothed_start_is_that_of_rauch_tung_striebel():
    em, n = placed(8, seconds=0.4)
    t, p = em.tape, em.parameters
    with initial_state.known_initial_state(em, 0, n):  # so that nothing is far from linear
        em.forward(0, n, restart=True)
        covariance = np.empty((12, 12))
        error = initial_state.smoothed_error(0, n, t.time, t.kind, 0.0, t.gain, t.s, t.e, t.blocks, t.pf, covariance)
    filtered = reference.extended_kalman_filter(
        t.time, t.y, t.thrust, t.torque, prior=reference.state_of(t.xp[0]), prior_cov=t.pp[0],
        mass=p.theta[0], inertia=p.inertia, q=p.noise.q, r=p.noise.r, lead=0.0,
    )  # fmt: skip
    smoothed = reference.rauch_tung_striebel(t.time, filtered, q=p.noise.q)
    expected = reference.difference(smoothed.states[0], filtered.filtered[0])
    sd = np.sqrt(np.diag(smoothed.cov[0]))
    np.testing.assert_allclose(error / sd, expected / sd, atol=0.05)
    np.testing.assert_allclose(covariance / np.outer(sd, sd), smoothed.cov[0] / np.outer(sd, sd), atol=0.02)


def test_a_blind_window_begins_where_it_has_its_attitude():
    """Tilted, and no attitude measured: found to within two degrees, and the tape is as before afterwards."""
    flight = zhao_flight.fly(seed=9)
    first = int(np.argmax(np.abs(flight.x[:600, 6])))  # the largest roll
    part = zhao_flight.Flight(*(a[first:] for a in (flight.time, flight.y, flight.force, flight.wrench, flight.x)))
    em, n = window(part), len(part.time)
    put(em, zhao_flight.TRUE, true_noise(FORCE, TORQUE))
    assert abs(part.x[0, 6]) > 0.05
    with initial_state.known_initial_state(em, 0, n):
        up = em.tape.xp[0, 6:10]
        tilt = np.array([2 * (up[0] * up[2] + up[1] * up[3]), 2 * (up[1] * up[2] - up[0] * up[3])])
    q = part.x[0, 6:10]
    true = np.array([2 * (q[0] * q[2] + q[1] * q[3]), 2 * (q[1] * q[2] - q[0] * q[3])])
    np.testing.assert_allclose(tilt, true, atol=0.03)
    assert em.tape.kind[0] == 1


def test_a_window_with_attitude_begins_as_measured():
    flight = zhao_flight.fly(seed=9, seconds=0.5)
    em = window(flight, signals=("position", "velocity", "attitude", "body_rate"))
    before = em.tape.xp[0].copy()
    with initial_state.known_initial_state(em, 0, len(flight.time)) as begin:
        begin()
        np.testing.assert_array_equal(em.tape.xp[0], before)


def test_settling_reports_its_way():
    flight = zhao_flight.fly(seed=10)
    em, n = window(flight), len(flight.time)
    settled = maximise_posterior(em, 0, n)
    assert settled.converged
    assert 0 <= settled.maps <= 3
    assert 0 < settled.steps <= 15
    assert len(settled.path) >= settled.maps + settled.steps + 1
    np.testing.assert_array_equal(settled.path[-1].theta, em.parameters.theta)
    # where it ended is a fixed point: settling again takes no step
    again = maximise_posterior(em, 0, n)
    assert (again.maps, again.steps) == (0, 0)
    assert np.all(np.abs(np.log(again.path[-1].theta[:4] / settled.path[-1].theta[:4])) < 1e-3)


def test_points_are_displaced_as_theta_is():
    em, _ = placed(2, seconds=0.3)
    start = em.parameters
    step = np.zeros(COORDINATES)
    step[:4] = 0.1, -0.2, 0.3, 0.05
    there = moved(em, start, step)
    np.testing.assert_array_equal(there.theta, displaced(start.theta, step[:P], em.setup.unit))
    low = moved(em, replace(start, noise=Noise.from_logs(start.noise.logs)), -100 * np.eye(COORDINATES)[P + 2])
    assert low.noise.impulse[2] == pytest.approx(SMALLEST_SCALES[2])
