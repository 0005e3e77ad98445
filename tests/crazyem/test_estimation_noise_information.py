"""Information and score of the noise scales: against the whole covariance of the data, differences and simulation."""

import numpy as np
import pytest
import reference
import test_estimation_kernels as plain
from hypothesis import given, settings
from hypothesis import strategies as st
from rigid_body import step_jacobians
from test_estimation_accelerometer import measured_tape
from test_estimation_kernels import INERTIA, MASS, P0, R_FORCE, Q, R, filled_tape

from crazyem.estimation import kernels
from crazyem.vehicle import GRAVITY

SCALES = 11


def filtered(tape, *, lead=0.5, logs=None, smooth=False):
    """Filter, and smoother, with the scales' logarithms moved by logs (11,). Log-likelihood."""
    logs = np.zeros(SCALES) if logs is None else logs
    noise = {"q": Q * np.exp(2 * logs[:6]), "r": R * np.repeat(np.exp(2 * logs[6:10]), 3)}
    noise |= {"r_force": R_FORCE * np.exp(2 * logs[10]), "lead": lead}
    value = plain.forward(tape, **noise)
    if smooth:
        plain.backward(tape, **noise)
    return value


def information(tape, first=0, last=None, *, lead=0.5, r=R):
    t = tape
    return kernels.noise_information(
        first, t.size if last is None else last, t.time, t.kind, t.usable, t.force, t.torque, INERTIA,
        np.linalg.inv(INERTIA), Q, r, R_FORCE, lead, t.xf, t.gain, t.s, t.blocks, t.middle,
    )  # fmt: skip


def score(tape, *, r=R):
    """Score of the logarithms of the scales by Fisher's identity, from the smoother's statistics."""
    rows, scales = tape.stats, np.append(r[::3], R_FORCE)
    impulse = rows[:, kernels.IMPULSE : kernels.IMPULSE + 6] + rows[:, kernels.BRIDGE : kernels.BRIDGE + 6]
    residual = rows[:, kernels.RESIDUAL : kernels.RESIDUAL + 5]
    seen = rows[:, kernels.MEASURED : kernels.MEASURED + 5]
    count = rows[:, kernels.COUNT : kernels.COUNT + 1]
    return np.concatenate([(impulse / Q - count).sum(0), (residual / scales - seen).sum(0)])


def information_of_all_data_at_once(tape, *, lead):
    """tr(V^-1 V_a V^-1 V_b) / 2 with the covariance V of all measurements, each a sum of independent noises.

    Nothing recursive: every noise there ever was has a column, and its effect on every measurement is a number.
    """
    variance, owner = [1.0] * 12, [-1] * 12
    effects = np.linalg.cholesky(tape.pp[0])  # of the noises (columns) on the error of the state
    rows = []

    def more(columns, variances, owners):
        nonlocal effects
        effects = np.hstack([effects, columns])
        variance.extend(variances)
        owner.extend(owners)

    for k in range(tape.size):
        if k:
            dt = tape.time[k] - tape.time[k - 1]
            reading = tape.force[k] - [0.0, 0.0, tape.thrust[k] / MASS]
            impulse = np.zeros(6)  # linearised where the filter is
            impulse[:3] = np.nan_to_num(reading) * Q[:3] / (Q[:3] / dt + R_FORCE)
            phi, g = step_jacobians(
                reference.state_of(tape.xf[k - 1]), tape.thrust[k], tape.torque[k], dt=dt, mass=MASS, inertia=INERTIA,
                impulse=impulse, lead=lead,
            )  # fmt: skip
            effects = phi @ effects
            more(g, Q * dt, range(6))
            impulses = range(len(variance) - 6, len(variance))
            if lead == 0.5:
                within = np.zeros((12, 6))
                within[:3, :3], within[6:9, 3:] = g[3:6, :3], g[6:9, 3:] / (dt / 2)
                more(within, Q * dt**3 / 12, range(6))
            for i in np.flatnonzero(~np.isnan(reading)):
                more(np.zeros((12, 1)), [R_FORCE], [10])
                row = np.zeros(len(variance))
                row[impulses[i]], row[-1] = 1 / dt, 1.0
                rows.append(row)
        there = ~np.isnan(reference.difference(reference.state_of(tape.y[k]), reference.state_of(tape.xp[k])))
        for i in np.flatnonzero(there):
            more(np.zeros((12, 1)), [R[i]], [6 + i // 3])
            row = effects[i].copy()
            row[-1] = 1.0
            rows.append(row)
    maps = np.array([np.append(row, np.zeros(len(variance) - len(row))) for row in rows])
    variance, owner = np.array(variance), np.array(owner)
    inverse = np.linalg.inv(maps * variance @ maps.T)
    parts = [
        inverse @ (maps[:, owner == a] * (2 * variance[owner == a])) @ maps[:, owner == a].T for a in range(SCALES)
    ]
    return np.array([[np.sum(x * y.T) / 2 for y in parts] for x in parts])


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.4, 0.8]), st.sampled_from([0.5, 0.0, 1.0]))
@settings(max_examples=6)
def test_it_is_the_information_in_the_covariance_of_all_data(seed, missing, lead):
    tape = measured_tape(seed, 15, missing=missing)
    filtered(tape, lead=lead)
    ours, expected = information(tape, lead=lead), information_of_all_data_at_once(tape, lead=lead)
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(ours / size, expected / size, atol=1e-9)
    np.testing.assert_array_equal(ours, ours.T)


@pytest.mark.parametrize("lead", [0.5, 0.0, 1.0])
@pytest.mark.parametrize("precise", [1.0, 0.3])
def test_the_score_from_the_smoother_is_the_slope_of_the_likelihood(lead, precise):
    """Fisher's identity, to a thousandth of a standard deviation or of the score; with precise sensors the noise
    within a step tells a good part."""
    tape = measured_tape(5, missing=0.1)
    start = np.zeros(SCALES)
    start[6:10] = np.log(precise)
    filtered(tape, lead=lead, logs=start, smooth=True)
    r = R * precise**2
    ours, sd = score(tape, r=r), np.sqrt(np.diag(information(tape, lead=lead, r=r)))
    h = 1e-4
    for a, unit in enumerate(np.eye(SCALES)):
        high, low = (filtered(tape, lead=lead, logs=start + sign * h * unit) for sign in (1, -1))
        assert ours[a] == pytest.approx((high - low) / (2 * h), abs=0.01 * sd[a], rel=2e-3)


def test_what_is_not_measured_has_no_information():
    tape = filled_tape(2)
    tape.y[:, 3:6] = np.nan
    tape.usable[:] = False
    filtered(tape)
    info = information(tape)
    empty = [0, 1, 2, 3, 4, 5, 7, 10]  # impulses of unusable steps, velocity, accelerometer
    assert not info[empty].any()
    assert not info[:, empty].any()
    assert np.linalg.eigvalsh(info[np.ix_([6, 8, 9], [6, 8, 9])]).min() > 0


def test_nothing_measured_at_all():
    tape = filled_tape(2)
    tape.y[:] = np.nan
    filtered(tape)
    assert not information(tape).any()


@pytest.mark.parametrize("row", [1, 20, 39])
def test_a_break_parts_the_information(row):
    tape = measured_tape(6)
    tape.kind[row], tape.usable[row] = plain.BREAK, False
    filtered(tape)
    parts = information(tape, 0, row) + information(tape, row)
    np.testing.assert_allclose(information(tape), parts, rtol=1e-9, atol=1e-12)


def test_many_precise_rates_tell_their_noise_or_that_of_the_torque():
    """Closed form: rates alone of a drone at rest are a random walk measured directly, a local-level model.

    Once steady its increments are a moving average of order one, e_t - (1 - K) e_(t-1) with variance S of e; a sample's
    information is 1 / (1 - (1 - K)^2) on the coefficient and 1/2 on log S (Box and Jenkins).
    """
    n, dt = 600, 0.01
    tape = plain.Tape(n)
    for k in range(n):
        y = np.full(13, np.nan)
        y[10:] = 0.0
        tape.append(k * dt, y, starts=False, keep=n)
        tape.mean[k] = [MASS * GRAVITY, 0.0, 0.0, 0.0]
    tape.spread_inputs(0, n, np.zeros(3))
    tape.kind[0] = 0
    tape.xp[0, 9] = 1.0
    tape.pp[0] = np.diag(P0)
    filtered(tape)
    half = 300
    info = (information(tape) - information(tape, 0, half)) / (n - half)  # the first half knows nothing of the second
    for axis in range(3):
        w, v = Q[3 + axis] * dt, R[9 + axis]
        p = (w + np.sqrt(w * w + 4 * w * v)) / 2
        gain, s = p / (p + v), p + v
        # derivatives by log sd of walk and of noise: of log s (half of 2 d log sd), of theta = gain - 1
        dp = np.array([w + (w * w + 2 * w * v) / np.sqrt(w * w + 4 * w * v), 2 * w * v / np.sqrt(w * w + 4 * w * v)])
        ds = dp + np.array([0.0, 2 * v])
        dtheta = (dp * s - p * ds) / s**2
        per_sample = np.outer(ds, ds) / (2 * s * s) + np.outer(dtheta, dtheta) / (1 - (1 - gain) ** 2)
        assert info[3 + axis, 3 + axis] == pytest.approx(per_sample[0, 0], rel=0.01)
        assert info[3 + axis, 9] == pytest.approx(per_sample[0, 1], rel=0.01)
