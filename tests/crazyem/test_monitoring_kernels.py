"""The kernels of the monitor against plain numpy: the same sums, and signatures against a filter run twice."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from crazyem.monitoring import kernels


def transition(blocks: NDArray, dt: float, h: float) -> NDArray:
    """Phi (12, 12) of one step, from its definition."""
    phi = np.zeros((12, 12))
    phi[0:3, 0:3] = np.eye(3)
    phi[3:6, 3:6] = np.eye(3)
    phi[3:6, 6:9], phi[3:6, 9:12] = blocks[0], blocks[1]
    phi[6:9, 6:9], phi[6:9, 9:12], phi[9:12, 9:12] = blocks[2], blocks[3], blocks[4]
    phi[0:3] += h * phi[3:6]
    phi[0:3, 3:6] += (dt - h) * np.eye(3)
    return phi


class Made:
    """Random rows of a tape: `n` steps, some measurements missing, C columns in two hypotheses, M nuisances."""

    def __init__(self, seed: int, n: int = 9, m: int = 3) -> None:
        random = np.random.default_rng(seed)
        self.n, self.m, self.first = n, m, np.array([0, 1, 4])
        c = 4
        self.time = np.cumsum(random.uniform(0.008, 0.012, n + 1))
        self.usable = np.ones(n + 1, bool)
        self.s = random.uniform(0.5, 2.0, (n + 1, 12)) * (random.random((n + 1, 12)) < 0.8)
        self.e = np.where(self.s > 0, random.standard_normal((n + 1, 12)), 0.0)
        self.gain = 0.1 * random.standard_normal((n + 1, 12, 12))
        self.blocks = 0.1 * random.standard_normal((n + 1, 5, 3, 3))
        self.blocks[:, 2] += np.eye(3)
        self.blocks[:, 4] += np.eye(3)
        self.middle = np.linalg.qr(random.standard_normal((n + 1, 3, 3)))[0]
        self.acting = random.standard_normal((n, c, 6))
        self.sensed = random.standard_normal((n, c, 12)) * (np.arange(c) == 3)[None, :, None]
        self.acting_n = random.standard_normal((n, m, 6))
        self.sensed_n = random.standard_normal((n, m, 12)) * (np.arange(m) == 1)[None, :, None]
        self.once = np.array([False, False, True, False])
        self.block = np.array([0, 1, 1, 1])
        # column 1 is a force that the onboard filter does not know, column 3 a delay of its fixes
        self.onboard, self.seconds, self.later = np.array([1, 3]), np.array([0.05, 0.03]), np.array([False, True])
        self.turn_seconds, self.motion = 0.02, random.standard_normal((n + 1, 6))
        self.slow = np.stack([random.uniform(-0.3, 0.8, 12), random.uniform(0, 1, 12), random.uniform(0.5, 1.5, 12)])

    def filter_errors(self) -> NDArray:
        """(n, C, 12) errors of the onboard filter by columns 1 and 3: the linear systems in small steps.

        Between rows the delayed motion is constant, and it changes at the end of a step.
        """
        out, t = np.zeros_like(self.sensed), self.time
        for a, time, later in zip(self.onboard, self.seconds, self.later):
            rate = np.array([[-2 / time, 1.0], [-2 / time**2, 0.0]])
            error, turned = np.zeros((2, 3)), np.zeros(3)
            for k in range(1, self.n + 1):
                ahead = self.motion[k - 1] if later else np.zeros(6)
                drive = np.zeros(3) if later else -self.middle[k][:, :2] @ self.acting[k - 1, a, :2]
                pull = np.stack([2 / time * ahead[:3], drive + 2 / time**2 * ahead[:3]])
                step = (t[k] - t[k - 1]) / 1000
                for _ in range(1000):
                    middle = error + 0.5 * step * (rate @ error + pull)
                    error = error + step * (rate @ middle + pull)
                    half = turned + 0.5 * step * (ahead[3:] - turned) / self.turn_seconds
                    turned = turned + step * (ahead[3:] - half) / self.turn_seconds
                out[k - 1, a] = np.concatenate([error.ravel(), turned, np.zeros(3)])
        return out

    def signatures(self, acting: NDArray, sensed: NDArray, once: NDArray) -> NDArray:
        """(n, 12, C) what each column adds to the normalised innovations, NaN where nothing was measured."""
        d = np.zeros((12, acting.shape[1]))
        out = np.full((self.n, 12, acting.shape[1]), np.nan)
        for k in range(1, self.n + 1):
            dt = self.time[k] - self.time[k - 1]
            h = 0.5 * dt
            d = transition(self.blocks[k], dt, h) @ d
            size = np.where(once, 1.0 if k == 1 else 0.0, dt)
            push = self.middle[k] @ (acting[k - 1, :, :3] * size[:, None]).T
            turn = (acting[k - 1, :, 3:] * size[:, None]).T
            d[0:3] += h * push
            d[3:6] += push
            d[6:9] += h * turn
            d[9:12] += turn
            for i in range(12):
                if self.s[k, i] == 0.0:
                    continue
                g = d[i] + sensed[k - 1, :, i]
                d = d - np.outer(self.gain[k, i], g)
                out[k - 1, i] = g / np.sqrt(self.s[k, i])
        return out

    def whitened(self, values: NDArray) -> NDArray:
        """(n, 12, ...) less what the slow error predicts, a sum over all that was measured before; 0 where missing."""
        out = np.zeros_like(values)
        phi, gain, weight = self.slow
        for i in range(12):
            rows = np.flatnonzero(self.s[1:, i] > 0)
            for j, k in enumerate(rows):
                past = [
                    phi[i] * gain[i] * (phi[i] * (1 - gain[i])) ** (j - 1 - a) * values[rows[a], i] for a in range(j)
                ]
                out[k, i] = weight[i] * (values[k, i] - sum(past))
        return out


@pytest.mark.parametrize("seed", [1, 2])
def test_sums_are_those_of_plain_numpy(seed: int) -> None:
    made = Made(seed)
    c, m, n = 4, made.m, made.n
    late = np.random.default_rng([seed, 1]).standard_normal((n, 12))
    arrays = {
        "d": np.zeros((3, 12, c)), "path": np.zeros((3, 6, 2)), "turned": np.zeros((3, 3)),
        "d_slow": np.zeros((3, 12, c)), "n": np.zeros((12, m)),
        "n_slow": np.zeros((12, m)), "n_now": np.zeros((12, m)), "e_slow": np.zeros(12), "e_now": np.zeros(12),
        "score": np.zeros((3, c)), "score_n": np.zeros(m), "among": np.zeros((3, c, c)),
        "cross": np.zeros((3, c, m)), "among_n": np.zeros((m, m)),
    }  # fmt: skip
    rows, drift = np.zeros(3, np.int64), np.zeros((12, 1))
    for first, last in ((1, 4), (4, n + 1)):  # in two parts, as updates come
        kernels.absorb(
            first, last, 0.5, made.time, made.usable, made.gain, made.s, made.e, made.blocks, made.middle,
            made.acting[first - 1 : last - 1], made.sensed[first - 1 : last - 1], made.acting_n[first - 1 : last - 1],
            made.sensed_n[first - 1 : last - 1], np.zeros((last - first, 1, 6)), late[first - 1 : last - 1], drift,
            made.once, made.block, made.onboard, made.seconds, made.later, made.turn_seconds,
            made.motion[first - 1 : last], np.array([1]), rows, made.slow, *arrays.values(),
        )  # fmt: skip
    sensed = made.sensed + made.filter_errors()
    mine = made.whitened(made.signatures(made.acting, sensed, made.once)).reshape(-1, c)
    nuisance = made.whitened(
        made.signatures(made.acting_n, made.sensed_n, np.zeros(m, bool))
    ).reshape(-1, m)  # fmt: skip
    error = made.signatures(np.zeros((n, 1, 6)), late[:, None], np.zeros(1, bool))[..., 0]  # of measurements
    measured = np.where(made.s[1:] > 0, made.e[1:] / np.sqrt(np.where(made.s[1:] > 0, made.s[1:], 1.0)), np.nan)
    left = made.whitened(measured - error).ravel()
    inside = made.block[:, None] == made.block[None, :]
    np.testing.assert_allclose(arrays["score"][1], mine.T @ left, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(arrays["score_n"], nuisance.T @ left, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(arrays["cross"][1], mine.T @ nuisance, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(np.tril(arrays["among"][1]), np.tril(mine.T @ mine * inside), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(np.tril(arrays["among_n"]), np.tril(nuisance.T @ nuisance), rtol=1e-9, atol=1e-12)
    assert rows[1] == n
    assert not arrays["score"][[0, 2]].any()


@pytest.mark.parametrize("seed", [3, 4])
def test_the_judgement_is_that_of_dense_algebra(seed: int) -> None:
    """Nuisances integrated out by the Gaussian marginal covariance, sizes by the posterior."""
    random = np.random.default_rng(seed)
    c, m, first = 4, 3, np.array([0, 1, 4])
    x, n, y = random.standard_normal((40, c)), random.standard_normal((40, m)), random.standard_normal(40)
    prior, prior_n = random.uniform(0.5, 2.0, c), random.uniform(0.5, 2.0, m)
    normal = prior * random.uniform(1.0, 100.0, c)
    excess = np.zeros((1, 2))
    out = [np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, c)), np.zeros((1, c))]
    kernels.judge(
        np.array([0]), first, prior, normal, prior_n, (x.T @ y)[None], n.T @ y, (x.T @ x)[None], (x.T @ n)[None],
        n.T @ n, excess, *out,
    )  # fmt: skip
    covariance = np.eye(40) + n @ np.diag(1 / prior_n) @ n.T
    for h, (lo, hi) in enumerate(itertools.pairwise(first)):
        a, p = x[:, lo:hi], np.diag(prior[lo:hi])
        information = a.T @ np.linalg.solve(covariance, a)
        score = a.T @ np.linalg.solve(covariance, y)
        with_it = covariance + a @ np.linalg.inv(p) @ a.T
        ratio = y @ np.linalg.solve(covariance, y) - y @ np.linalg.solve(with_it, y)
        assert out[0][0, h] == pytest.approx(ratio, rel=1e-8)
        without_it = covariance + a @ np.diag(1.0 / normal[lo:hi]) @ a.T
        more = y @ np.linalg.solve(without_it, y) - y @ np.linalg.solve(with_it, y)
        assert excess[0, h] == pytest.approx(more, rel=1e-8)
        assert out[1][0, h] == pytest.approx(np.linalg.slogdet(with_it)[1] - np.linalg.slogdet(covariance)[1], rel=1e-8)
        np.testing.assert_allclose(out[2][0, lo:hi], np.linalg.solve(information + p, score), rtol=1e-8)
        np.testing.assert_allclose(out[3][0, lo:hi], np.diag(np.linalg.inv(information + p)), rtol=1e-8)
