"""The M-step: derivatives of its objective, its optimum against scipy's, closed forms, and absurd starts."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.stats import norm

from crazyem.estimation import kernels
from crazyem.estimation.mstep import maximise, objective

N = kernels.PARAMETERS
TRUTH = np.array([0.036, 2.0e-5, 2.1e-5, 3.6e-5, 0.06, 0.003, 2e-6, -1e-6, 5e-7])
UNIT = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1e-3, 1e-5, 1e-5, 1e-5])
ALL = np.ones(N, bool)
NO_LAG = np.array([True] * 4 + [False] * 5)
seeds = st.integers(0, 2**32 - 1)


def add_outer(sums: np.ndarray, base: int, z: np.ndarray, dt: float) -> None:
    """Upper triangles, row by row, of sum z z' dt; z (n, width)."""
    total = z.T @ z * dt
    upper = total[np.triu_indices(z.shape[1])]
    sums[base : base + len(upper)] += upper


def statistics(seed: int, *, n: int = 400, noise: float = 1.0, lag: bool = True, truth: np.ndarray = TRUTH):
    """Sums as the smoother would give them for a drone with parameters `truth`, nothing hidden; and the raw signals."""
    rng = np.random.default_rng(seed)
    dt = 0.01
    rate = rng.normal(size=(n, 3)) * 1.0
    mass, inertia, (tau, delay), offset = truth[0], truth[1:4], truth[4:6], truth[6:9]
    slopes = rng.normal(size=(n, 2)) * [1.0, 3.0] if lag else np.zeros((n, 2))
    torque_slopes = rng.normal(size=(n, 2, 3)) * [[[2e-3] * 3, [5e-3] * 3]] if lag else np.zeros((n, 2, 3))
    # the disturbance is independent of the input, and enters the acceleration
    thrust = mass * (9.81 + rng.normal(size=n))
    acceleration = (thrust + noise * 0.01 * rng.normal(size=n)) / mass
    gyroscopic = np.stack([rate[:, (i + 1) % 3] * rate[:, (i + 2) % 3] for i in range(3)], 1)
    difference = np.array([inertia[(i + 2) % 3] - inertia[(i + 1) % 3] for i in range(3)])
    torque = rng.normal(size=(n, 3)) * 8.0 * inertia
    alpha = (torque + noise * 5e-5 * rng.normal(size=(n, 3)) - difference * gyroscopic) / inertia

    sums = np.zeros(kernels.SIZE)
    sums[kernels.COUNT] = n
    base = thrust - slopes @ [tau, delay]
    add_outer(sums, kernels.MASS, np.stack([acceleration, base, slopes[:, 0], slopes[:, 1]], 1), dt)
    for i in range(3):
        free = torque[:, i] - torque_slopes[:, :, i] @ [tau, delay] - offset[i]
        z = np.stack([alpha[:, i], gyroscopic[:, i], free, *torque_slopes[:, :, i].T, np.ones(n)], 1)
        add_outer(sums, kernels.AXIS + kernels.AXIS_SIZE * i, z, dt)
    return sums, acceleration, thrust


def displaced(theta, step):
    """Theta moved by a step of logarithms (first five) and units (the rest)."""
    return np.where(np.arange(N) < 5, theta * np.exp(step), theta + UNIT * step)


def moved(theta, origin=TRUTH):
    """Inverse of `displaced`."""
    return np.concatenate([np.log(theta[:5] / origin[:5]), ((theta - origin) / UNIT)[5:]])


NOTHING = np.zeros(5)


def evaluate(theta, sums, *, free=ALL, centre=TRUTH, precision=None, known=NOTHING):
    gradient, hessian, squares = np.zeros(N), np.zeros((N, N)), np.zeros(4)
    precision = np.full(N, 0.5) if precision is None else precision
    value = objective(theta, UNIT, sums, free, centre, precision, known, gradient, hessian, squares)
    return value, gradient, hessian, squares


def solve(theta, sums, *, free=ALL, centre=TRUTH, precision=None, iterations=60, known=NOTHING):
    theta, squares = theta.copy(), np.zeros(4)
    precision = np.full(N, 1e-9) if precision is None else precision
    maximise(theta, UNIT, sums, free, centre, precision, known, iterations, squares)
    return theta, squares


@given(seeds, st.lists(st.floats(-0.8, 0.8), min_size=N, max_size=N), st.booleans())
def test_gradient_and_hessian_are_those_of_finite_differences(seed, where, known):
    sums = statistics(seed)[0]
    sums[kernels.IMPULSE : kernels.IMPULSE + 2] = 0.3, 0.5
    known = np.array([1e-4, 1e-9, 0.0, 2e-9, 1e-3]) if known else NOTHING
    theta = displaced(TRUTH, np.array(where))
    _, gradient, hessian, _ = evaluate(theta, sums, known=known)
    h = 1e-5
    scale = np.sqrt(np.abs(np.diag(hessian))) + 1.0
    for u in range(N):
        d = np.eye(N)[u] * h
        (high, g_high, *_), (low, g_low, *_) = (evaluate(displaced(theta, s * d), sums, known=known) for s in (1, -1))
        assert gradient[u] == pytest.approx((high - low) / (2 * h), rel=1e-4, abs=1e-4 * scale[u])
        numeric = (g_high - g_low) / (2 * h)
        np.testing.assert_allclose(hessian[u] / scale[u] / scale, numeric / scale[u] / scale, atol=1e-5)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-9, atol=1e-9)


def test_objective_is_the_expected_log_likelihood_written_out():
    """-Q in plain numpy from the raw signals: N(m a; F, ...) with the noise intensity at its own optimum."""
    sums, acceleration, thrust = statistics(1, lag=False)
    n = sums[kernels.COUNT]
    none = np.zeros(N)
    heavy, light = TRUTH.copy(), TRUTH.copy()
    heavy[0], light[0] = 0.04, 0.03
    ours = evaluate(heavy, sums, precision=none)[0] - evaluate(light, sums, precision=none)[0]

    def written_out(mass):
        squares = np.sum((mass * acceleration - thrust) ** 2 * 0.01)
        return -n * np.log(mass) + n / 2 * np.log(squares)

    assert ours == pytest.approx(written_out(0.04) - written_out(0.03), rel=1e-9)


def test_objective_with_known_noise_is_the_expected_log_likelihood_written_out():
    """Every step adds log N(F - m a; 0, s^2 / dt) + log m, and a lateral acceleration likewise, all in newtons."""
    sums, acceleration, thrust = statistics(1, lag=False)
    sums[kernels.IMPULSE : kernels.IMPULSE + 2] = 0.3, 0.5
    n, s, lateral = sums[kernels.COUNT], 2e-3, 5e-4
    heavy, light = TRUTH.copy(), TRUTH.copy()
    heavy[0], light[0] = 0.04, 0.03
    known = np.array([s**2, 0.0, 0.0, 0.0, lateral**2])
    values = [evaluate(theta, sums, precision=np.zeros(N), known=known)[0] for theta in (heavy, light)]

    def written_out(mass):
        along = norm.logpdf(mass * acceleration - thrust, scale=s / 0.1) + np.log(mass)  # a step is 0.01 s
        return -along.sum() - 2 * n * np.log(mass) + 0.5 * mass**2 * 0.8 / lateral**2

    assert values[0] - values[1] == pytest.approx(written_out(0.04) - written_out(0.03), rel=1e-9)


@given(seeds)
@settings(max_examples=10)
def test_finds_the_optimum_that_scipy_finds(seed):
    sums = statistics(seed)[0]
    precision = np.full(N, 0.1)
    start = TRUTH.copy()
    theta, _ = solve(start, sums, precision=precision)
    value, gradient, hessian, _ = evaluate(theta, sums, precision=precision)
    assert np.max(np.abs(gradient) / np.sqrt(np.diag(hessian))) < 1e-4
    assert np.linalg.eigvalsh(hessian).min() > 0
    other = minimize(lambda x: evaluate(displaced(start, x), sums, precision=precision)[0], np.zeros(N), method="BFGS",
                     jac=lambda x: evaluate(displaced(start, x), sums, precision=precision)[1])  # fmt: skip
    assert value <= other.fun + 1e-6
    sd = np.sqrt(np.diag(np.linalg.inv(hessian)))
    assert np.max(np.abs(moved(theta) - other.x) / sd) < 0.01


@given(seeds)
def test_mass_without_lag_has_a_closed_form(seed):
    """m = sum F^2 / sum F a, from the joint maximum over mass and noise (noise enters with the acceleration)."""
    sums, acceleration, thrust = statistics(seed, lag=False)
    theta, squares = solve(TRUTH, sums, free=NO_LAG)
    closed = np.sum(thrust**2) / np.sum(thrust * acceleration)
    assert theta[0] == pytest.approx(closed, rel=1e-6)
    assert squares[0] == pytest.approx(np.sum((closed * acceleration - thrust) ** 2) * 0.01, rel=1e-5)


ABSURD = [(0.001, 1e-4, 2e-4, 1e-4), (10.0, 1e-4, 2e-4, 1e-4), (1e-6, 1e-9, 1e-9, 1e-9), (0.036, 1e-2, 1e-2, 1e-2),
          (0.2, 1e-7, 1e-2, 1e-5)]  # fmt: skip


@pytest.mark.parametrize("start", ABSURD)
def test_absurd_starts_lead_to_the_same_place(start):
    """The paper's cold start among them (m0 = 0.001 kg, I0 = diag(1, 2, 1)e-4)."""
    sums = statistics(3, lag=False)[0]
    good, _ = solve(TRUTH, sums, free=NO_LAG)
    theta = TRUTH.copy()
    theta[:4] = start
    for _ in range(20):  # the estimator calls it once per update
        theta, _ = solve(theta, sums, free=NO_LAG, iterations=30)
        assert np.all(theta[:5] > 0)
    np.testing.assert_allclose(theta[:4], good[:4], rtol=1e-4)


@given(seeds, st.lists(st.floats(-12, 12), min_size=4, max_size=4), st.integers(1, 5))
def test_never_negative_never_worse_never_nan(seed, where, iterations):
    sums = statistics(seed)[0]
    start = displaced(TRUTH, np.array([*where, 0, 0, 0, 0, 0]))
    precision = np.full(N, 0.5)
    theta, squares = solve(start, sums, precision=precision, iterations=iterations)
    assert np.all(np.isfinite(theta))
    assert np.all(theta[:5] > 0)
    assert np.all(squares >= 0)
    before, after = evaluate(start, sums, precision=precision)[0], evaluate(theta, sums, precision=precision)[0]
    assert after <= before + 1e-6


def test_what_is_held_fixed_stays():
    sums = statistics(4)[0]
    for held in range(N):
        free = ALL.copy()
        free[held] = False
        start = displaced(TRUTH, np.full(N, 0.1))
        theta, _ = solve(start, sums, free=free)
        assert theta[held] == start[held]
        assert np.all(theta[free] != start[free])


def test_statistics_of_states_that_diverged_move_nothing() -> None:
    """Without any attitude a filter may diverge; its infinite sums must not become a singular matrix."""
    for bad in (np.nan, np.inf):
        theta = TRUTH.copy()
        sums = np.full(kernels.SIZE, bad)
        sums[kernels.COUNT] = 400.0
        maximise(theta, UNIT, sums, ALL, TRUTH, np.ones(N), np.zeros(5), 30, np.zeros(4))
        np.testing.assert_array_equal(theta, TRUTH)
