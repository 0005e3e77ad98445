"""The filter of the diagnosis against a plain one: dense matrices, Jacobians by differences, one joint update a row.

The score is checked against differences of the log-likelihood, and the information against outer products of
differenced innovations, both of the plain filter.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from crazyem.diagnosis.fitting.kernel import sweep

Array = NDArray[np.float64]
G = 9.81


@dataclass(frozen=True)
class Given:
    """What `sweep` is given, by name."""

    time: Array
    starts: NDArray[np.bool_]
    y: Array
    specific: Array
    angular: Array
    offset: Array
    q: Array
    r: Array
    disturbance: Array
    memory: Array
    p0: Array
    thrust_only: bool = False

    @property
    def coupled(self) -> bool:
        """Whether position and velocity have errors with memory."""
        return bool(self.disturbance[6] > 0 and self.disturbance[9] > 0)


def made(
    seed: int, *, rows: int = 60, disturbed: bool = False, missing: float = 0.0, torques: bool = False,
    coloured: tuple[int, ...] = (),
) -> Given:  # fmt: skip
    """A short flight that tumbles a little, with steps of unequal length and noise on all that is measured."""
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.004, 0.012, rows))
    phase = rng.uniform(0, 6, 6)
    wave = np.sin(5 * time[:, None] + phase)
    specific = np.array([0.4, 0.3, 1.5]) * wave[:, :3] + [0, 0, G]
    angular = np.array([8.0, 7.0, 3.0]) * wave[:, 3:]
    r = np.repeat(np.square([2e-3, 1e-2, 4e-3, 2e-2]), 3)
    x = np.concatenate([[0.1, -0.2, 1.0, 0.2, 0.1, -0.1], Rotation.from_euler("xyz", [0.1, -0.2, 0.5]).as_quat(),
                        [0.4, -0.3, 0.6], np.zeros(18)])  # fmt: skip
    y = np.zeros((rows, 13))
    starts = np.zeros(rows, bool)
    starts[[0, rows // 2]] = True
    for k in range(rows):
        if k:
            x = stepped(x, time[k] - time[k - 1], specific[k] + [0.1, 0.0, -0.1], angular[k] + [0.5, 0.0, 0.2], 1.0)
        noise = rng.normal(size=12) * np.sqrt(r)
        y[k, :6] = x[:6] + noise[:6]
        y[k, 6:10] = (Rotation.from_quat(x[6:10]) * Rotation.from_rotvec(noise[6:9])).as_quat()
        y[k, 10:] = x[10:13] + noise[9:]
        if rng.random() < 0.5:
            y[k, 6:10] *= -1  # the same attitude
    for columns in (slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13)):
        lost = rng.random(rows) < missing
        if columns.start == 6:  # a filter that has to find its attitude from nothing is not near any linear one
            lost &= ~starts
        y[lost, columns] = np.nan
    return Given(
        time, starts, y, specific, angular, 0.01 * rng.normal(size=(rows, 12)), rng.uniform(0.5, 2, 6) ** 2 * [0.1] * 6,
        r, np.concatenate([np.square([0.2, 0.1, 0.3, 1.0, 2.0, 0.5]) * (np.arange(6) >= 3 * torques) * disturbed,
                           4.0 * r * np.repeat(np.isin(np.arange(4), coloured), 3)]),
        np.concatenate([[0.3, 0.2, 0.5, 0.05, 0.1, 1.0], np.repeat([0.03, 0.1, 0.05, 0.01], 3)]),
        np.square([1.0] * 3 + [2.0] * 3 + [0.5] * 3 + [3.0] * 3),
    )  # fmt: skip


def stepped(
    x: Array,
    dt: float,
    specific: Array,
    angular: Array,
    memory: Array,
    coupled: bool = False,
    thrust_only: bool = False,
) -> Array:
    """States (..., 31) a step later: velocity by the attitude in the middle, position and attitude by mean rates.

    coupled: the error of the position integrates that of the velocity.
    thrust_only: of an estimate by thrust and attitude.
    """
    turn = Rotation.from_quat(x[..., 6:10])
    middle = turn * Rotation.from_rotvec(x[..., 10:13] * dt / 2)
    v = x[..., 3:6] + dt * (middle.apply(specific + x[..., 13:16]) - [0, 0, G])
    w = x[..., 10:13] + dt * (angular + x[..., 16:19])
    end = (turn * Rotation.from_rotvec(dt * (x[..., 10:13] + w) / 2)).as_quat()
    lasting = np.exp(-dt / memory) * x[..., 13:]
    turned = np.cross(x[..., 25:28], specific + x[..., 13:16])  # thrust, by the error of the attitude
    unknown = dt * thrust_only * coupled * middle.apply(turned - x[..., 13:16] * [1, 1, 0])
    lasting[..., 6:9] += dt * coupled * x[..., 22:25] + dt / 2 * unknown
    lasting[..., 9:12] += unknown
    return np.concatenate([x[..., :3] + dt * (x[..., 3:6] + v) / 2, v, end, w, lasting], axis=-1)


def plus(x: Array, error: Array) -> Array:
    """The state (31,) moved by errors (..., 30), the attitude by rotation vectors on the right."""
    turned = (Rotation.from_quat(x[6:10]) * Rotation.from_rotvec(error[..., 6:9])).as_quat()
    return np.concatenate([x[:6] + error[..., :6], turned, x[10:] + error[..., 9:]], axis=-1)


def minus(a: Array, b: Array) -> Array:
    """The errors (..., 30) that lead from b (31,) to a."""
    turned = (Rotation.from_quat(b[6:10]).inv() * Rotation.from_quat(a[..., 6:10])).as_rotvec()
    return np.concatenate([a[..., :6] - b[:6], turned, a[..., 10:] - b[10:]], axis=-1)


def process_noise(given: Given, x: Array, end: Array, dt: float) -> Array:
    """Covariance (30, 30) of white accelerations over a step, integrated by Gauss and Legendre."""
    middle = (Rotation.from_quat(x[6:10]) * Rotation.from_rotvec(x[10:13] * dt / 2)).as_matrix()
    turn = Rotation.from_rotvec(dt * (x[10:13] + end[10:13]) / 2)
    jacobian = (turn.inv() * Rotation.from_rotvec(turn.as_rotvec() + 1e-6 * np.eye(3))).as_rotvec().T / 1e-6
    total = np.zeros((30, 30))
    points, weights = np.polynomial.legendre.leggauss(3)
    for point, weight in zip(points, weights, strict=True):
        left = dt * (1 - point) / 2
        g = np.zeros((30, 6))
        g[0:3, 0:3], g[3:6, 0:3] = left * middle, middle
        g[6:9, 3:6], g[9:12, 3:6] = left * jacobian, np.eye(3)
        if given.coupled and given.thrust_only:
            g[18:24, :2] = -g[:6, :2]
        total += 0.5 * dt * weight * g @ np.diag(given.q) @ g.T
    total[12:, 12:] += np.diag((1 - np.exp(-2 * dt / given.memory)) * given.disturbance)
    return total


@dataclass(frozen=True)
class Plain:
    """(n, 12) innovations made sequential and their variances; (n, 19) filtered states; the log-likelihood; by row the
    gain and the Cholesky factor of the innovations' covariance."""

    e: Array
    s: Array
    filtered: Array
    loglik: float
    gains: dict[int, tuple[Array, Array]]


def plain(given: Given, gains: dict[int, tuple[Array, Array]] | None = None) -> Plain:
    """An extended Kalman filter as it stands in textbooks; with the gains of another run, if given."""
    n, used = len(given.time), {}
    e, s, filtered, loglik = np.zeros((n, 12)), np.zeros((n, 12)), np.zeros((n, 31)), 0.0
    x, p = np.zeros(31), np.zeros((30, 30))
    for k in range(n):
        known = np.isfinite(given.y[k][[0, 1, 2, 3, 4, 5, 6, 6, 6, 10, 11, 12]])
        if given.starts[k]:
            x = begun(given.y[k], given.offset[k])
            p = np.diag(np.concatenate([np.where(known, given.r, given.p0), given.disturbance]))
            shared = np.diag(
                np.where(known, given.disturbance[6:], 0.0)
            )  # the state is what was measured less its errors
            p[:12, :12] += shared
            p[:12, 18:] -= shared
            p[18:, :12] -= shared
            filtered[k] = x
            continue
        dt = given.time[k] - given.time[k - 1]

        def move(state: Array, k: int = k, dt: float = dt) -> Array:
            return stepped(
                state, dt, given.specific[k], given.angular[k], given.memory, given.coupled, given.thrust_only
            )

        end = move(x)
        width = 1e-6
        both = minus(move(plus(x, width * np.concatenate([np.eye(30), -np.eye(30)]))), end)
        transition = (both[:30] - both[30:]).T / (2 * width)
        p = transition @ p @ transition.T + process_noise(given, x, end, dt)
        x = end
        if not known.any():
            filtered[k] = x
            continue
        y = np.concatenate([given.y[k], np.zeros(18)])
        if not known[6]:
            y[6:10] = x[6:10]
        innovation = (minus(y, x)[:12] - given.offset[k] - x[19:])[known]
        h = (np.eye(12, 30) + np.eye(12, 30, 18))[known]
        joint = h @ p @ h.T + np.diag(given.r[known])
        gain, lower = (gains or {}).get(k) or (p @ h.T @ np.linalg.inv(joint), np.linalg.cholesky(joint))
        used[k] = gain, lower
        e[k, known] = np.linalg.solve(lower, innovation) * np.diag(lower)
        s[k, known] = np.diag(lower) ** 2
        loglik -= 0.5 * float(innovation @ np.linalg.solve(joint, innovation) + np.linalg.slogdet(2 * np.pi * joint)[1])
        x = plus(x, gain @ innovation)
        p = (np.eye(30) - gain @ h) @ p
        p = 0.5 * (p + p.T)
        filtered[k] = x
    return Plain(e, s, filtered, loglik, used)


def begun(y: Array, offset: Array) -> Array:
    """What was measured, less what the sensors show beyond it; the rest is zero."""
    x = np.zeros(31)
    x[9] = 1.0
    for place in (slice(0, 3), slice(3, 6)):
        if np.isfinite(y[place]).all():
            x[place] = y[place] - offset[place]
    if np.isfinite(y[10:]).all():
        x[10:13] = y[10:] - offset[9:]
    if np.isfinite(y[6:10]).all():
        x[6:10] = (Rotation.from_quat(y[6:10]) * Rotation.from_rotvec(-offset[6:9])).as_quat()
    return x


@dataclass(frozen=True)
class Result:
    """What `sweep` fills."""

    filtered: Array
    e: Array
    s: Array
    rows: Array
    loglik: float
    score: Array
    information: Array


def swept(
    given: Given, acting: Array | None = None, showing: Array | None = None, block: NDArray[np.int64] | None = None
) -> Result:
    n = len(given.time)
    acting = np.zeros((n, 6, 0)) if acting is None else acting
    showing = np.zeros((n, 12, 0)) if showing is None else showing
    block = np.zeros(n, np.int64) if block is None else block
    m, blocks = acting.shape[2] + showing.shape[2], int(block[-1]) + 1
    predicted, filtered, e, s = np.zeros((n, 31)), np.zeros((n, 31)), np.zeros((n, 12)), np.zeros((n, 12))
    rows, score, information = np.zeros(n), np.zeros((blocks, m)), np.zeros((blocks, m, m))
    loglik = sweep(
        given.time, given.starts, given.y, given.specific, given.angular, given.offset, acting, showing, given.q,
        given.r, given.disturbance, given.memory, given.p0, block, int(given.thrust_only), predicted, filtered, e, s,
        rows, score, information,
        np.zeros((0, 12, 12)), np.zeros((0, 18, 12)), np.zeros((0, 0, 12)),
    )  # fmt: skip
    return Result(filtered, e, s, rows, loglik, score, information)


@pytest.mark.parametrize("thrust_only", [False, True])
@pytest.mark.parametrize(
    ("disturbed", "missing", "torques", "coloured"),
    [(False, 0.0, False, ()), (True, 0.0, False, ()), (True, 0.4, False, ()), (True, 0.2, True, ()),
     (False, 0.2, False, (2,)), (True, 0.2, True, (0, 1, 2, 3)), (True, 0.2, False, (1, 3)),
     (False, 0.2, False, (0, 1)), (False, 0.2, False, (0, 1, 2))],
)  # fmt: skip
def test_innovations_and_likelihood_are_those_of_a_plain_filter(
    disturbed: bool, missing: float, torques: bool, coloured: tuple[int, ...], thrust_only: bool
) -> None:
    """To a thousandth of a standard deviation: how the attitude in the middle turns with the rate is first order."""
    given = replace(
        made(1, disturbed=disturbed, missing=missing, torques=torques, coloured=coloured), thrust_only=thrust_only
    )
    slow, fast = plain(given), swept(given)
    seen = slow.s > 0
    assert np.array_equal(fast.s > 0, seen)
    np.testing.assert_allclose(fast.s[seen], slow.s[seen], rtol=1e-4)
    assert np.max(np.abs(fast.e - slow.e)[seen] / np.sqrt(slow.s[seen])) < 1e-3
    assert fast.loglik == pytest.approx(slow.loglik, abs=0.02)
    assert fast.rows.sum() == pytest.approx(fast.loglik)
    assert np.all(fast.rows[given.starts] == 0)
    errors = np.array([minus(a, b) for a, b in zip(fast.filtered, slow.filtered, strict=True)])
    assert np.max(np.abs(errors[:, :12]) / np.sqrt(given.r)) < 1e-3
    if disturbed or coloured:
        assert np.max(np.abs(errors[:, 12:]) / np.sqrt(np.maximum(given.disturbance, 1e-20))) < 1e-3


def columns_of(given: Given) -> tuple[Array, Array]:
    """Two changes of the accelerations and two of what is shown, that vary in time."""
    n = len(given.time)
    rng = np.random.default_rng(9)
    wave = np.sin(3 * given.time[:, None] + rng.uniform(0, 6, 4))
    acting, showing = np.zeros((n, 6, 2)), np.zeros((n, 12, 2))
    acting[:, :3, 0] = 5 * rng.normal(size=3) * wave[:, :1]
    acting[:, 3:, 1] = rng.normal(size=3) * (1 + wave[:, 1:2])
    acting[:, 0, 1] = 0.1
    showing[:, 3:6, 0] = rng.normal(size=3) * (1 + 0.5 * wave[:, 2:3])
    showing[:, 6:, 1] = rng.normal(size=6) * wave[:, 3:4]
    return acting, showing


def displaced(given: Given, acting: Array, showing: Array, column: int, by: float) -> Given:
    if column < acting.shape[2]:
        return replace(
            given,
            specific=given.specific + by * acting[:, :3, column],
            angular=given.angular + by * acting[:, 3:, column],
        )
    return replace(given, offset=given.offset + by * showing[:, :, column - acting.shape[2]])


@pytest.mark.parametrize(
    ("disturbed", "missing", "coloured", "thrust_only"),
    [(False, 0.0, (), False), (True, 0.3, (), False), (True, 0.3, (0, 2), False), (True, 0.3, (0, 1), False),
     (True, 0.3, (0, 1, 2), True)],
)  # fmt: skip
def test_score_and_information_are_differences_of_the_plain_filter(
    disturbed: bool, missing: float, coloured: tuple[int, ...], thrust_only: bool
) -> None:
    """Scores within 0.02 standard deviations, information within 1 %, with the same gains.

    Scores of an attitude that is shown turned, within 0.1: it turns axes of errors and gains, too, which is left out.
    """
    given = replace(made(2, disturbed=disturbed, missing=missing, coloured=coloured), thrust_only=thrust_only)
    acting, showing = columns_of(given)
    block = (np.arange(len(given.time)) // 15).astype(np.int64)
    found = swept(given, acting, showing, block)
    slopes, likelihoods = [], []
    here = plain(given)
    sd = np.sqrt(np.where(here.s > 0, here.s, 1.0))
    for column in range(4):
        width = 1e-4
        up = plain(displaced(given, acting, showing, column, width))
        down = plain(displaced(given, acting, showing, column, -width))
        likelihoods.append((up.loglik - down.loglik) / (2 * width))
        up, down = (plain(displaced(given, acting, showing, column, by), here.gains) for by in (width, -width))
        slopes.append(-(up.e - down.e) / (2 * width) / sd)
    slope = np.stack(slopes)  # (4, n, 12)
    whole = np.einsum("akc,bkc->ab", slope, slope)
    scale = np.sqrt(np.diag(whole))
    assert np.all(scale > 1.0)  # the flight knows all four
    off = (found.score.sum(0) - np.array(likelihoods)) / scale
    assert np.all(np.abs(off) < [0.02, 0.02, 0.02, 0.1])
    for b in range(int(block[-1]) + 1):
        mine = slope[:, block == b]
        expected = np.einsum("akc,bkc->ab", mine, mine) / np.outer(scale, scale)
        np.testing.assert_allclose(np.triu(found.information[b]) / np.outer(scale, scale), np.triu(expected), atol=0.01)
        weighted = np.einsum("akc,kc->a", mine, (here.e / sd)[block == b])
        assert np.all(np.abs(found.score[b] - weighted) / scale < [0.02, 0.02, 0.02, 0.1])


@pytest.mark.parametrize("columns", [13, 60, 150])
def test_any_number_of_columns_says_the_same_of_each(columns: int) -> None:
    """Among many, whose products are added in several portions, a few columns have what they have alone."""
    given = made(2, disturbed=True, missing=0.3, rows=150)
    acting, showing = columns_of(given)
    block = (np.arange(len(given.time)) // 40).astype(np.int64)
    few = swept(given, acting, showing, block)
    others = np.random.default_rng(1).normal(size=(len(given.time), 6, columns - 4))
    many = swept(given, np.concatenate([acting, others], 2), showing, block)
    mine = [0, 1, columns - 2, columns - 1]
    scale = np.sqrt(np.diagonal(few.information.sum(0)))
    np.testing.assert_allclose(many.score[:, mine] / scale, few.score / scale, atol=1e-9)
    found, expected = (
        np.triu(i) / np.outer(scale, scale) for i in (many.information[:, mine][:, :, mine], few.information)
    )
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_columns_change_nothing_of_the_filter() -> None:
    given = made(3, disturbed=True, missing=0.2)
    without, beside = swept(given), swept(given, *columns_of(given))
    assert without.loglik == beside.loglik
    np.testing.assert_array_equal(without.filtered, beside.filtered)


def test_a_row_without_a_measurement_only_predicts() -> None:
    given = made(5)
    y = given.y.copy()
    y[10] = np.nan
    found = swept(replace(given, y=y))
    assert np.all(found.s[10] == 0)
    assert found.rows[10] == 0
    dt = given.time[10] - given.time[9]
    expected = stepped(found.filtered[9], dt, given.specific[10], given.angular[10], given.memory)
    assert np.max(np.abs(minus(found.filtered[10], expected))) < 1e-12
