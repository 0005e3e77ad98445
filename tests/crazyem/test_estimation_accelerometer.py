"""The accelerometer, a measurement of a step's mean specific force: against the augmented filter, by simulation."""

import numpy as np
import pytest
import reference
import test_estimation_kernels as plain
from hypothesis import given, settings
from hypothesis import strategies as st
from test_estimation_kernels import INERTIA, MASS, R_FORCE, Q, R, filled_tape, scaled

from crazyem.estimation import kernels

ACCELEROMETER = 4  # group of its noise


def measured_tape(seed: int, n: int = 40, *, missing: float = 0.3, force_missing: float = 0.3):
    """A tape with readings of an accelerometer that scatter as much as the filter expects, axes missing at times."""
    tape = filled_tape(seed, n, missing=missing)
    rng = np.random.default_rng(seed + 1)
    for k in range(1, tape.size):
        dt = tape.time[k] - tape.time[k - 1]
        spread = np.sqrt(Q[:3] / dt + R_FORCE)
        tape.force[k] = [0.0, 0.0, tape.thrust[k] / MASS] + rng.normal(size=3) * spread
        tape.force[k, rng.uniform(size=3) < force_missing] = np.nan
    tape.force[0] = 1e3  # of no step on the tape: must not be looked at
    return tape


def twin(tape, *, lead=0.5):
    return reference.augmented_smoother(
        tape.time, tape.y, tape.force, tape.thrust, tape.torque, prior=reference.state_of(tape.xp[0]),
        prior_cov=tape.pp[0], mass=MASS, inertia=INERTIA, q=Q, r=R, r_force=R_FORCE, lead=lead,
    )  # fmt: skip


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3, 0.8]), st.sampled_from([0.0, 0.5, 1.0]))
@settings(max_examples=10)
def test_filter_is_that_of_the_state_augmented_by_the_impulse(seed, missing, lead):
    tape = measured_tape(seed, missing=missing)
    value = plain.forward(tape, lead=lead)
    expected = twin(tape, lead=lead)
    assert value == pytest.approx(expected.log_likelihood, rel=1e-9, abs=1e-6)
    assert value == pytest.approx(tape.loglik.sum(), rel=1e-12)
    for k in range(tape.size):
        plain.assert_same_state(tape.xf[k], expected.filtered[k])
    np.testing.assert_allclose(scaled(tape.pf), scaled(expected.filtered_cov, tape.pf), atol=1e-6)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3]), st.sampled_from([0.5, 0.0]))
@settings(max_examples=6)
def test_smoothed_impulses_and_residuals_are_those_of_the_augmented_smoother(seed, missing, lead):
    tape = measured_tape(seed, missing=missing)
    plain.forward(tape, lead=lead)
    plain.backward(tape, lead=lead)
    smoothed = twin(tape, lead=lead)
    dt = np.diff(tape.time)[:, None]
    model = np.zeros((tape.size - 1, 3))
    model[:, 2] = tape.thrust[1:] / MASS
    force = model + smoothed.impulse[1:, :3] / dt
    variance = np.einsum("kii->ki", smoothed.impulse_cov)[1:]
    spread = np.sqrt(Q / 0.01)
    # equal to second order in the smoother's correction of the attitude, as without accelerometer
    np.testing.assert_allclose(tape.moments[1:, :3] / spread[:3], force / spread[:3], atol=0.02)
    impulses = slice(kernels.IMPULSE, kernels.IMPULSE + 6)
    expected = (smoothed.impulse[1:] ** 2 + variance) / dt
    np.testing.assert_allclose(tape.stats[1:, impulses] / Q, expected / Q, atol=0.03)
    seen = slice(kernels.IMPULSE_SEEN, kernels.IMPULSE_SEEN + 6)
    np.testing.assert_allclose(tape.stats[1:, seen], (1 - variance / (Q * dt)) ** 2, atol=0.01)

    there = ~np.isnan(tape.force[1:])
    left = variance[:, :3] / dt**2
    residual = np.where(there, (tape.force[1:] - force) ** 2 + left, 0.0).sum(1)
    ours = tape.stats[1:, kernels.RESIDUAL + ACCELEROMETER]
    np.testing.assert_allclose(ours / R_FORCE, residual / R_FORCE, atol=0.05)
    np.testing.assert_array_equal(tape.stats[1:, kernels.MEASURED + ACCELEROMETER], there.sum(1))
    known = np.where(there, (1 - left / R_FORCE) ** 2, 0.0).sum(1)
    np.testing.assert_allclose(tape.stats[1:, kernels.RESIDUAL_SEEN + ACCELEROMETER], known, atol=0.01)

    squares = ((force[:, 2] ** 2 + left[:, 2]) * dt[:, 0]).sum()
    assert tape.stats[1:, kernels.MASS].sum() == pytest.approx(squares, rel=1e-3)


def test_a_worthless_accelerometer_changes_nothing_and_a_perfect_one_says_all():
    bare, worthless, perfect = filled_tape(2), measured_tape(2), measured_tape(2, force_missing=0.0)
    for tape, r_force in ((bare, R_FORCE), (worthless, 1e12), (perfect, 1e-12)):
        plain.forward(tape, r_force=r_force)
        plain.backward(tape, r_force=r_force)
    np.testing.assert_allclose(worthless.xf, bare.xf, atol=1e-8)
    np.testing.assert_allclose(worthless.moments, bare.moments, atol=1e-5)
    np.testing.assert_allclose(perfect.moments[1:, :3], perfect.force[1:], atol=1e-6)


@pytest.mark.parametrize("name", range(9))
def test_score_and_information_against_finite_differences(name):
    plain.assert_score_and_information(lambda: measured_tape(7, missing=0.2), name)


def test_alone_it_tells_of_mass_what_its_noise_and_that_of_the_thrust_leave():
    """Without position and velocity the only news of mass is F/m against the readings: a closed form."""
    tape = measured_tape(7, force_missing=0.0)
    tape.y[:, :6] = np.nan
    plain.forward(tape)
    variance = Q[2] / np.diff(tape.time) + R_FORCE
    model = tape.thrust[1:] / MASS
    assert plain.sensitivities(tape)[0, 0] == pytest.approx(np.sum(model**2 / variance), rel=1e-9)
    score = -np.sum((tape.force[1:, 2] - model) * model / variance)
    assert tape.score[:, 0].sum() == pytest.approx(score, rel=1e-9)


@given(st.lists(st.tuples(st.integers(0, 39), st.integers(0, 2)), max_size=60), st.integers(0, 39), st.booleans())
def test_missing_readings_breaks_and_unusable_steps_never_spread(holes, special, breaks):
    tape = measured_tape(4, force_missing=0.0)
    for row, axis in holes:
        tape.force[row, axis] = np.nan
    tape.kind[special] = plain.BREAK if breaks else tape.kind[special]
    tape.usable[special] = False
    assert np.isfinite(plain.forward(tape))
    plain.backward(tape)
    info = plain.sensitivities(tape)
    for name in ("xp", "pp", "xf", "pf", "stats", "moments", "score", "loglik"):
        assert np.all(np.isfinite(getattr(tape, name))), name
    assert np.all(np.isfinite(info))
    assert np.linalg.eigvalsh(tape.pf).min() > -1e-12
    assert tape.stats[special, kernels.MEASURED + ACCELEROMETER] == 0.0
    counted = ~np.isnan(tape.force)
    counted[[0, special]] = False
    assert tape.stats[:, kernels.MEASURED + ACCELEROMETER].sum() == counted.sum()
