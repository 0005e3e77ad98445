"""The compiled filter, smoother and sensitivities against the textbook twin and finite differences."""

import numpy as np
import pytest
import reference
import synthetic
from hypothesis import given, settings
from hypothesis import strategies as st
from rigid_body import State, step, step_jacobians

from crazyem.estimation import kernels
from crazyem.estimation.tape import BREAK, START_VARIANCE, Tape
from crazyem.vehicle import GRAVITY

MASS = 0.036
INERTIA = np.array([[2.0e-5, 1e-6, -5e-7], [1e-6, 2.1e-5, 8e-7], [-5e-7, 8e-7, 3.6e-5]])
OFFSET = np.array([3e-6, -2e-6, 1e-6])  # N m
THETA = np.array([MASS, 2.0e-5, 2.1e-5, 3.6e-5, 0.06, 0.003, *OFFSET])
UNIT = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1e-3, 1e-5, 1e-5, 1e-5])  # of the linear parameters: s, N m
Q = np.array([0.02, 0.03, 0.05, 0.3, 0.25, 0.15]) ** 2
R = np.repeat(np.array([1e-3, 1e-2, 3e-3, 2e-3]) ** 2, 3)
R_FORCE = 0.3**2  # (m/s^2)^2
LEADS = [0.0, 0.3, 0.5, 1.0]
P0 = np.repeat([1e-4, 1e-3, 1e-3, 1e-2], 3)


def filled_tape(seed: int, n: int = 40, *, missing: float = 0.3, dither: float = 2e-4) -> Tape:
    """A tape with a flight on it: uneven steps, and each group of measurements lost at times."""
    rng = np.random.default_rng(seed)
    truth = synthetic.Truth(mass=MASS, inertia=(2.0e-5, 2.1e-5, 3.6e-5, 1e-6, -5e-7, 8e-7), dither=dither)
    flight = synthetic.fly(truth, seed=seed, duration=2.0)
    rows = np.cumsum(rng.integers(3, 25, n))
    tape = Tape(n)
    for k, row in enumerate(rows):
        y = flight.fine_y[row].copy()
        for columns in synthetic.COLUMNS.values():
            if rng.uniform() < missing and k > 0:
                y[columns] = np.nan
        tape.append(flight.fine_time[row], y, starts=k == 0, keep=n)
        before = rows[k - 1] if k else 0
        tape.mean[k] = flight.fine_acting[before:row].mean(0)
        tape.mean_tau[k] = rng.normal(size=4) * [1.0, 2e-3, 2e-3, 2e-3]
        tape.mean_delay[k] = rng.normal(size=4) * [1.0, 2e-3, 2e-3, 2e-3]
    tape.spread_inputs(0, n, OFFSET)
    tape.kind[0] = 0
    tape.xp[0] = flight.fine_y[rows[0]]
    tape.pp[0] = np.diag(P0)
    return tape


def forward(tape, first=0, last=None, *, restart=True, mass=MASS, inertia=INERTIA, q=Q, r=R, r_force=R_FORCE, lead=0.5):
    t, last = tape, tape.size if last is None else last
    return kernels.forward(
        first, last, restart, t.time, t.kind, t.y, t.force, t.thrust, t.torque, mass, inertia, np.linalg.inv(inertia),
        q, r, r_force, lead, START_VARIANCE, t.xp, t.pp, t.xf, t.pf, t.gain, t.s, t.e, t.blocks, t.middle, t.loglik,
    )  # fmt: skip


def backward(tape, first=0, last=None, *, q=Q, r=R, r_force=R_FORCE, lead=0.5):
    t, last = tape, tape.size if last is None else last
    kernels.backward(
        first, last, t.time, t.kind, t.usable, t.force, t.thrust, t.torque, t.thrust_tau, t.torque_tau, t.thrust_delay,
        t.torque_delay, THETA[4], THETA[5], OFFSET, MASS, INERTIA, np.linalg.inv(INERTIA), q, r, r_force, lead, t.xf,
        t.pf, t.gain, t.s, t.e, t.blocks, t.middle, t.stats, t.moments,
    )  # fmt: skip


def sensitivities(tape, *, lead=0.5):
    t = tape
    return kernels.sensitivities(
        0, t.size, t.time, t.kind, t.usable, t.force, t.thrust, t.torque, t.thrust_tau, t.torque_tau, t.thrust_delay,
        t.torque_delay, THETA, UNIT, INERTIA, np.linalg.inv(INERTIA), Q, R_FORCE, lead, t.xf, t.gain, t.s, t.e,
        t.blocks, t.middle, t.score,
    )  # fmt: skip


def twin(tape, *, lead=0.5) -> tuple[reference.Filtered, reference.Smoothed]:
    filtered = reference.extended_kalman_filter(
        tape.time, tape.y, tape.thrust, tape.torque, prior=reference.state_of(tape.xp[0]), prior_cov=tape.pp[0],
        mass=MASS, inertia=INERTIA, q=Q, r=R, lead=lead,
    )  # fmt: skip
    return filtered, reference.rauch_tung_striebel(tape.time, filtered, q=Q)


def simulated(rng, n, *, lead, dt=0.02, error=1.0) -> Tape:
    """A drone under the model's own noise, within the step too, measured with the filter's noise times `error`."""
    tape = Tape(n)
    start = State(np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
    x = start.plus(rng.normal(size=12) * np.sqrt(P0))
    for k in range(n):
        if k:
            thrust, torque = MASS * GRAVITY * rng.uniform(0.8, 1.2), INERTIA @ (-3.0 * x.body_rate + rng.normal(size=3))
            impulse = rng.normal(size=6) * np.sqrt(Q * dt)
            values = {"dt": dt, "mass": MASS, "inertia": INERTIA, "impulse": impulse, "lead": lead}
            before, x = x, step(x, thrust, torque, **values)
            if lead == 0.5:
                _, g = step_jacobians(before, thrust, torque, **values)
                within = rng.normal(size=6) * np.sqrt(Q * dt**3 / 12)
                x = x.plus(np.concatenate([g[3:6, :3] @ within[:3], np.zeros(3), g[6:9, 3:] @ within[3:] / (dt / 2),
                                           np.zeros(3)]))  # fmt: skip
        seen = x.plus(error * rng.normal(size=12) * np.sqrt(R))
        tape.append(k * dt, np.concatenate([*seen]), starts=False, keep=n)
        if k:
            tape.mean[k] = [thrust, *torque]
            tape.force[k] = [0.0, 0.0, thrust / MASS] + impulse[:3] / dt + rng.normal(size=3) * np.sqrt(R_FORCE)
    tape.spread_inputs(0, n, np.zeros(3))
    tape.kind[0] = 0
    tape.xp[0] = np.concatenate([*start])
    tape.pp[0] = np.diag(P0)
    return tape


def assert_same_state(row, state):
    np.testing.assert_allclose(row[:6], np.concatenate([state.position, state.velocity]), atol=1e-9)
    np.testing.assert_allclose(row[10:], state.body_rate, atol=1e-8)
    np.testing.assert_allclose(np.abs(row[6:10] @ state.attitude), 1.0, atol=1e-13)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3, 0.8]), st.sampled_from(LEADS))
@settings(max_examples=8)
def test_filter_is_the_textbook_filter(seed, missing, lead):
    """Scalar updates and joint updates agree to rounding, missing data, uneven steps, products of inertia and all."""
    tape = filled_tape(seed, missing=missing, dither=1e-3)  # turns of up to 0.1 rad a step
    value = forward(tape, lead=lead)
    ours, _ = twin(tape, lead=lead)
    assert value == pytest.approx(ours.log_likelihood, rel=1e-9, abs=1e-6)
    assert value == pytest.approx(tape.loglik.sum(), rel=1e-12)
    for k in range(tape.size):
        assert_same_state(tape.xp[k], ours.predicted[k])
        assert_same_state(tape.xf[k], ours.filtered[k])
    np.testing.assert_allclose(scaled(tape.pp), scaled(ours.predicted_cov, tape.pp), atol=1e-7)
    np.testing.assert_allclose(scaled(tape.pf), scaled(ours.filtered_cov, tape.pf), atol=1e-7)


def scaled(cov, by=None):
    """Covariances as correlations (of `by`)."""
    by = cov if by is None else by
    d = np.sqrt(np.einsum("kii->ki", by))
    return cov / (d[:, :, None] * d[:, None, :])


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3, 0.8]), st.sampled_from(LEADS))
@settings(max_examples=8)
def test_smoother_and_statistics_are_those_of_rauch_tung_striebel(seed, missing, lead):
    """Expected squares of impulses and measurement residuals from the twin's covariances, not from the kernel's."""
    tape = filled_tape(seed, missing=missing)
    forward(tape, lead=lead)
    backward(tape, lead=lead)
    _, smoothed = twin(tape, lead=lead)
    force, acceleration = reference.expected_accelerations(
        tape.time, tape.thrust, tape.torque, smoothed, mass=MASS, inertia=INERTIA
    )
    inside = slice(1, None)
    spread = np.sqrt(Q / 0.01)
    loose = 10.0 if missing > 0.5 else 1.0
    # the kernel smooths errors in the tangent space of the filtered state, the twin takes the manifold's differences:
    # equal to second order in the correction of the attitude (1e-3 rad), hence a few per cent of a standard deviation,
    # more where most measurements are missing and corrections are large
    np.testing.assert_allclose(tape.moments[inside, :3] / spread[:3], force[inside] / spread[:3], atol=0.02 * loose)
    np.testing.assert_allclose(
        tape.moments[inside, 3:6] / spread[3:], acceleration[inside] / spread[3:], atol=0.03 * loose, rtol=5e-3
    )
    rates = np.array([s.body_rate for s in smoothed.states])
    np.testing.assert_allclose(tape.moments[inside, 6:9], rates[:-1], atol=2e-4 * loose)

    dt = np.diff(tape.time)[:, None]
    expected = (smoothed.impulse[1:] ** 2 + np.einsum("kii->ki", smoothed.impulse_cov)[1:]) / dt
    impulses = slice(kernels.IMPULSE, kernels.IMPULSE + 6)
    np.testing.assert_allclose(tape.stats[inside, impulses] / Q, expected / Q, atol=0.03 * loose)

    residual, seen = np.zeros((tape.size, 4)), np.zeros((tape.size, 4))
    for k in range(tape.size):
        error = reference.difference(reference.state_of(tape.y[k]), smoothed.states[k])
        there = ~np.isnan(error)
        second = np.where(there, error**2 + np.diag(smoothed.cov[k]), 0.0)
        residual[k], seen[k] = second.reshape(4, 3).sum(1), there.reshape(4, 3).sum(1)
    measured = slice(kernels.MEASURED, kernels.MEASURED + 4)
    np.testing.assert_array_equal(tape.stats[:, measured], seen)
    residuals = slice(kernels.RESIDUAL, kernels.RESIDUAL + 4)
    np.testing.assert_allclose(tape.stats[:, residuals] / R[::3], residual / R[::3], atol=0.05 * loose)


def test_statistics_hold_the_expected_squares_of_the_m_step():
    """E[(m a - F)^2] for any m and (tau, delay) is the quadratic form of the mass block, from the twin's moments."""
    tape = filled_tape(5)
    forward(tape)
    backward(tape)
    _, smoothed = twin(tape)
    force, _ = reference.expected_accelerations(
        tape.time, tape.thrust, tape.torque, smoothed, mass=MASS, inertia=INERTIA
    )
    sums = np.zeros(kernels.SIZE)
    kernels.total(1, tape.size, tape.stats, sums)
    a = np.zeros((4, 4))
    a[np.triu_indices(4)] = sums[kernels.MASS : kernels.MASS + 10]
    a = a + a.T - np.diag(np.diag(a))
    for mass, tau, delay in ((0.036, 0.06, 0.003), (0.03, 0.05, 0.001)):
        c = np.array([mass, -1.0, -tau, -delay])
        dt = np.diff(tape.time)
        thrust = (tape.thrust + tape.thrust_tau * (tau - THETA[4]) + tape.thrust_delay * (delay - THETA[5]))[1:]
        variance = smoothed.impulse_cov[1:, 2, 2] / dt**2
        expected = np.sum(((mass * force[1:, 2] - thrust) ** 2 + mass**2 * variance) * dt)
        assert c @ a @ c == pytest.approx(expected, rel=2e-3)


@given(st.integers(1, 39), st.integers(0, 100))
@settings(max_examples=10)
def test_going_on_equals_one_pass(split, seed):
    tape, other = filled_tape(seed), filled_tape(seed)
    one = forward(tape)
    two = forward(other, 0, split) + forward(other, split, restart=False)
    assert one == pytest.approx(two, rel=1e-14)
    np.testing.assert_array_equal(tape.xf, other.xf)
    np.testing.assert_array_equal(tape.pf, other.pf)
    # restarting from the prior on the tape is the same too
    three = forward(other, 0, split) + forward(other, split, restart=True)
    assert three == pytest.approx(two, rel=1e-14)
    np.testing.assert_array_equal(tape.xf, other.xf)


def test_smoothing_the_newest_rows_is_smoothing_them_all():
    tape, other = filled_tape(2), filled_tape(2)
    forward(tape)
    forward(other)
    backward(tape)
    backward(other, 25)
    np.testing.assert_array_equal(tape.stats[26:], other.stats[26:])
    np.testing.assert_array_equal(tape.moments[26:], other.moments[26:])


def test_a_break_isolates_what_lies_on_both_sides():
    """Rows after a break do not know what was before, nor the other way round, and the break itself counts nothing."""

    def passed(change):
        tape = filled_tape(3, missing=0.0)
        tape.kind[20] = BREAK
        tape.usable[20] = False
        tape.y[change, :6] += 0.1
        forward(tape)
        backward(tape)
        sensitivities(tape)
        return tape

    plain, early, late = passed(slice(0, 0)), passed(slice(5, 15)), passed(slice(25, 35))
    for name in ("xf", "pf", "stats", "loglik", "score"):
        np.testing.assert_array_equal(getattr(plain, name)[20:], getattr(early, name)[20:])
        np.testing.assert_array_equal(getattr(plain, name)[:20], getattr(late, name)[:20])
    assert plain.loglik[20] == 0.0
    assert plain.stats[20, kernels.COUNT] == 0.0
    assert not plain.score[20].any()
    np.testing.assert_allclose(plain.xp[20], plain.y[20], atol=1e-12)


@given(st.lists(st.tuples(st.integers(0, 39), st.integers(0, 12)), max_size=60), st.booleans())
def test_nan_in_any_measurement_never_spreads(holes, starts):
    tape = filled_tape(4, missing=0.0)
    for row, column in holes:
        tape.y[row, column if column < 6 or column > 9 else slice(6, 10)] = np.nan
    tape.kind[0] = BREAK if starts else 0
    assert np.isfinite(forward(tape))
    backward(tape)
    info = sensitivities(tape)
    for name in ("xp", "pp", "xf", "pf", "stats", "moments", "score", "loglik"):
        assert np.all(np.isfinite(getattr(tape, name))), name
    assert np.all(np.isfinite(info))
    assert np.linalg.eigvalsh(tape.pf).min() > -1e-12
    missing = np.isnan(tape.y[:, 0]).sum()
    assert tape.stats[1:, kernels.MEASURED].sum() + (0 if starts else tape.stats[0, kernels.MEASURED]) <= (
        3 * (tape.size - missing) + 2 * missing
    )


def test_nothing_measured_at_all():
    tape = filled_tape(4)
    tape.y[1:] = np.nan
    forward(tape)
    backward(tape)
    np.testing.assert_allclose(tape.stats[1:, kernels.IMPULSE : kernels.IMPULSE + 6], np.tile(Q, (39, 1)), rtol=1e-9)
    assert not sensitivities(tape).any()


def displaced(name: int, step: float) -> np.ndarray:
    """Theta with one parameter moved in the coordinates of the score: logarithms, and units of the linear ones."""
    theta = THETA.copy()
    theta[name] = theta[name] * np.exp(step) if name < 5 else theta[name] + UNIT[name] * step
    return theta


def moved(tape, name, step, *, lead=0.5):
    """Log-likelihood, innovations, and those of the accelerometer's z axis, of a filter with one parameter moved."""
    theta = displaced(name, step)
    tau, delay, *offset = (theta - THETA)[4:]
    tape.thrust += tau * tape.thrust_tau + delay * tape.thrust_delay
    tape.torque += tau * tape.torque_tau + delay * tape.torque_delay + np.array(offset)
    value = forward(tape, mass=theta[0], inertia=INERTIA + np.diag(theta[1:4] - THETA[1:4]), lead=lead)
    return value, tape.e.copy(), tape.force[1:, 2] - tape.thrust[1:] / theta[0]


def assert_score_and_information(build, name, *, lead=0.5):
    """The score is the slope of the log-likelihood; information sums squared slopes of the innovations.

    What the sensitivities leave out is how the gains change with the parameters (through the Jacobians): small.
    """
    tape, h = build(), 1e-4
    forward(tape, lead=lead)
    info = sensitivities(tape, lead=lead)
    np.testing.assert_allclose(info, info.T, rtol=1e-9)
    (high, e_high, z_high), (low, e_low, z_low) = (moved(build(), name, s * h, lead=lead) for s in (1, -1))
    sd = 1 / np.sqrt(info[name, name])
    assert tape.score[:, name].sum() * sd == pytest.approx((high - low) / (2 * h) * sd, abs=0.05)
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = np.where(tape.s > 0, ((e_high - e_low) / (2 * h)) ** 2 / tape.s, 0.0).sum()
    squares += np.nansum(((z_high - z_low) / (2 * h)) ** 2 / (Q[2] / np.diff(tape.time) + R_FORCE))
    assert info[name, name] == pytest.approx(squares, rel=0.02)


@pytest.mark.parametrize("lead", [0.5, 0.0, 1.0])
@pytest.mark.parametrize("name", range(9))
def test_score_and_information_against_finite_differences(name, lead):
    assert_score_and_information(lambda: filled_tape(7, missing=0.2), name, lead=lead)


def test_information_is_positive():
    tape = filled_tape(9)
    forward(tape)
    info = sensitivities(tape)
    assert np.linalg.eigvalsh(info / np.sqrt(np.outer(np.diag(info), np.diag(info)))).min() > 0


def test_unusable_steps_are_filtered_but_count_nothing():
    tape, other = filled_tape(6), filled_tape(6)
    other.usable[15:25] = False
    for t in (tape, other):
        forward(t)
        backward(t)
    np.testing.assert_array_equal(tape.xf, other.xf)
    step_part = slice(0, kernels.RESIDUAL)
    assert not other.stats[15:25, step_part].any()
    np.testing.assert_array_equal(tape.stats[25:], other.stats[25:])
    np.testing.assert_array_equal(tape.stats[15:25, kernels.RESIDUAL], other.stats[15:25, kernels.RESIDUAL])


def test_attitude_sign_of_a_logged_quaternion_does_not_matter():
    tape, other = filled_tape(8), filled_tape(8)
    other.y[::2, 6:10] *= -1
    other.xp[0, 6:10] = tape.xp[0, 6:10]
    assert forward(tape) == pytest.approx(forward(other), rel=1e-12)
    np.testing.assert_allclose(tape.xf, other.xf, atol=1e-12)
