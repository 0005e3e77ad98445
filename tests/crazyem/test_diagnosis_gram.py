"""Score and information by blocks: fits of columns against scipy, folds by hand, errors by simulation."""

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import optimize, stats

from crazyem.diagnosis.fitting.gram import Gram, bounded
from crazyem.diagnosis.naming.trials import dispersion_of
from crazyem.diagnosis.settings import FITTING

Array = NDArray[np.float64]


def positive(rng: np.random.Generator, size: int, spread: float = 1.0) -> Array:
    """A covariance of columns of unequal scale."""
    root = rng.normal(size=(size, size + 2))
    scale = 10.0 ** rng.uniform(-spread, spread, size)
    return root @ root.T * np.outer(scale, scale)


def simulated(
    seed: int, *, blocks: int = 60, columns: int = 3, truth: Array | None = None, dispersion: float = 1.0
) -> Gram:
    """Scores with mean A theta and covariance `dispersion` times the information, block by block."""
    rng = np.random.default_rng(seed)
    information = np.stack([positive(rng, columns, 0.3) for _ in range(blocks)])
    truth = np.zeros(columns) if truth is None else truth
    score = np.stack([a @ truth + np.sqrt(dispersion) * np.linalg.cholesky(a) @ rng.normal(size=columns)
                      for a in information])  # fmt: skip
    return Gram(score, information, np.zeros(blocks, int))


def nats(theta: Array, b: Array, a: Array) -> float:
    return float(b @ theta - 0.5 * theta @ a @ theta)


def test_a_fit_is_the_maximum_of_the_likelihood() -> None:
    gram = simulated(1, truth=np.array([0.3, -0.2, 0.1]))
    found = gram.solve([2, 0])
    b, a = gram.total([2, 0])
    np.testing.assert_allclose(b, gram.score[:, [2, 0]].sum(0))
    best = optimize.minimize(lambda t: -nats(t, b, a), np.zeros(2), method="BFGS", options={"gtol": 1e-9})
    np.testing.assert_allclose(found.theta, best.x, rtol=1e-5)
    assert found.gain == pytest.approx(-best.fun)


def test_priors_pull_to_where_they_say() -> None:
    gram = simulated(2, truth=np.array([0.5, 0.5, 0.5]))
    b, a = gram.total(range(3))
    precision, prior = np.array([0.0, 300.0, 50.0]), np.array([0.0, -0.2, 0.4])

    def posterior(t: Array) -> float:
        return nats(t, b, a) - 0.5 * float(precision @ (t - prior) ** 2)

    found = gram.solve(range(3), precision=precision, prior=prior)
    best = optimize.minimize(lambda t: -posterior(t), np.zeros(3), method="BFGS", options={"gtol": 1e-9})
    np.testing.assert_allclose(found.theta, best.x, rtol=1e-5)
    assert found.gain == pytest.approx(posterior(best.x) - posterior(np.zeros(3)))


@pytest.mark.parametrize("weight", [0.0, 5.0, 300.0])
def test_what_a_prior_has_taken_up_does_not_speak_against_an_effect(weight: float) -> None:
    """The same fit from where nothing has moved and from where the others are at their maximum under their prior."""
    gram = simulated(4, truth=np.array([0.0, 0.1, 0.2]))
    precision = np.array([weight, weight, 0.0])
    neutral = gram.solve(range(3), precision=precision, tested=[2])
    b, a = gram.total([0, 1])
    taken_up = np.append(np.linalg.solve(a + weight * np.eye(2), b), 0.0)
    there = Gram(gram.score - gram.information @ taken_up, gram.information, gram.flight)
    again = there.solve(range(3), precision=precision, prior=-taken_up, tested=[2])
    np.testing.assert_allclose(again.theta + taken_up, neutral.theta, rtol=1e-7)
    np.testing.assert_allclose(again.covariance, neutral.covariance, rtol=1e-7)
    assert again.dispersion == pytest.approx(neutral.dispersion)


def test_what_a_bound_holds_fast_does_not_take_an_effects_place() -> None:
    """As if the bound were the value of the other column, which the tested one then is beside alone; free, the other
    would explain nearly everything, and nothing would speak for the tested one."""
    gram = simulated(5, columns=2, truth=np.array([0.5, 0.0]))
    both = np.array([[1.0, 0.9], [0.0, 0.45]])  # the tested column is mostly the other one
    alike = Gram(gram.score @ both, np.einsum("ji,bjk,kl->bil", both, gram.information, both), gram.flight)
    bound = 0.1
    low, high = np.full(2, -np.inf), np.array([bound, np.inf])
    found = alike.solve([0, 1], low=low, high=high, tested=[1])
    assert found.theta[0] == bound
    shifted = alike.score[:, 1:] - bound * alike.information[:, 1:, 0]
    alone = Gram(shifted, alike.information[:, 1:, 1:], alike.flight).solve([0], tested=[0])
    assert found.theta[1] == pytest.approx(alone.theta[0])
    assert found.gain == pytest.approx(alone.gain + nats(found.theta[:1], *alike.total([0])))
    assert alone.gain > 15.0
    free = alike.solve([0, 1])  # the other takes its place
    assert free.gain - alike.solve([0]).gain < 2.0


def test_after_a_change_the_score_is_the_gradient_there() -> None:
    """Of the quadratic of each block, by differences."""
    gram, change, width = simulated(6), np.array([0.2, -0.1, 0.3]), 1e-3
    there = gram.moved(change)
    for block in (0, 17, 59):
        b, a = gram.score[block], gram.information[block]
        slopes = [(nats(change + step, b, a) - nats(change - step, b, a)) / (2.0 * width) for step in width * np.eye(3)]
        np.testing.assert_allclose(there.score[block], slopes, rtol=1e-8)
    np.testing.assert_array_equal(there.information, gram.information)
    np.testing.assert_array_equal(there.flight, gram.flight)
    np.testing.assert_allclose(gram.moved(gram.solve(range(3)).theta).score.sum(0), 0.0, atol=1e-6)


def by_enumeration(a: Array, b: Array, low: Array, high: Array) -> float:
    """The best of all solutions in which each column is free, at its lower or at its upper bound [nats]."""
    best = -np.inf
    for places in itertools.product((0, 1, 2), repeat=len(b)):
        at = np.array(places)
        theta = np.select([at == 1, at == 2], [low, high], 0.0)
        free, fixed = np.flatnonzero(at == 0), np.flatnonzero(at)
        if not np.all(np.isfinite(theta)):
            continue
        theta[free] = np.linalg.solve(a[np.ix_(free, free)], b[free] - a[np.ix_(free, fixed)] @ theta[fixed])
        if np.all(theta >= low - 1e-9) and np.all(theta <= high + 1e-9):
            best = max(best, nats(theta, b, a))
    return best


@given(st.integers(0, 10**6), st.integers(1, 4))
def test_with_bounds_nothing_better_exists(seed: int, size: int) -> None:
    """Against every combination of bounds; some columns have none, and some begin at theirs."""
    rng = np.random.default_rng(seed)
    a = positive(rng, size, 0.5)
    unit = 1 / np.sqrt(np.diag(a))
    b = a @ (3 * rng.normal(size=size) * unit)
    low, high = -rng.uniform(0, 1, size) * unit, rng.uniform(0.05, 1, size) * unit
    low[rng.random(size) < 0.2] = -np.inf
    high[rng.random(size) < 0.2] = np.inf
    low[rng.random(size) < 0.2] = 0.0
    found = bounded(a, b, low, high)
    assert np.all(found >= low)
    assert np.all(found <= high)
    assert nats(found, b, a) == pytest.approx(by_enumeration(a, b, low, high), rel=1e-6, abs=1e-9)


def test_without_columns_there_is_nothing_to_fit() -> None:
    assert bounded(np.zeros((0, 0)), np.zeros(0), None, None).size == 0


def test_columns_that_say_the_same_share_what_there_is() -> None:
    """No inverse exists; the fit still has the gain of one of them."""
    gram = simulated(3, columns=1, truth=np.array([0.4]))
    twice = Gram(
        np.repeat(gram.score, 2, axis=1), np.repeat(np.repeat(gram.information, 2, axis=1), 2, axis=2), gram.flight
    )
    one, both = gram.solve([0]), twice.solve([0, 1])
    assert both.gain == pytest.approx(one.gain, rel=1e-6)
    assert both.theta.sum() == pytest.approx(one.theta[0], rel=1e-5)
    assert np.all(np.isfinite(both.covariance))


def test_held_out_is_what_the_other_folds_say_of_a_fold() -> None:
    gram = simulated(4, blocks=47, truth=np.array([0.1, 0.0, -0.1]))
    columns, total = [0, 2], 0.0
    for fold in range(FITTING.folds):
        inside = [k for k in range(47) if (k // FITTING.blocks_together) % FITTING.folds == fold]
        outside = [k for k in range(47) if k not in inside]
        b = sum(gram.score[k][columns] for k in outside)
        a = sum(gram.information[k][np.ix_(columns, columns)] for k in outside)
        theta = np.linalg.solve(a, b)
        total += sum(nats(theta, gram.score[k][columns], gram.information[k][np.ix_(columns, columns)]) for k in inside)
    found = gram.solve(columns)
    assert found.held_out == pytest.approx(total)
    assert found.held_out < found.gain  # what was seen is always explained better


def test_held_out_gain_of_nothing_is_a_loss() -> None:
    """k columns that mean nothing lose on average k/2 of what they seem to gain, and more: 200 flights, 4 sigma."""
    held, gain = [], []
    for seed in range(200):
        found = simulated(seed, blocks=30, columns=2).solve([0, 1])
        held.append(found.held_out)
        gain.append(found.gain)
    assert np.mean(gain) == pytest.approx(1.0, abs=4 * np.std(gain) / np.sqrt(200))
    assert np.mean(held) < -4 * np.std(held) / np.sqrt(200)


@pytest.mark.parametrize("dispersion", [1.0, 5.0])
def test_errors_are_those_of_the_scatter(dispersion: float) -> None:
    """95 % intervals hold the truth in 300 flights, whether or not scores scatter as the information says (1e-4)."""
    truth, held = np.array([0.2, -0.1, 0.3]), 0
    for seed in range(300):
        found = simulated(1000 + seed, truth=truth, dispersion=dispersion).solve(range(3))
        width = stats.t.ppf(0.975, 60 - 3) * np.sqrt(np.diag(found.covariance))
        held += int(abs(found.theta[1] - truth[1]) < width[1])
    assert held >= stats.binom.ppf(1e-4, 300, 0.95)
    found = simulated(7, truth=truth, blocks=400, dispersion=dispersion).solve(range(3))
    assert found.dispersion == pytest.approx(dispersion, rel=0.3)


@pytest.mark.parametrize("dispersion", [1.0, 6.0])
def test_what_other_columns_explain_is_no_scatter(dispersion: float) -> None:
    """Scores of a column that is correlated with a strong one scatter with it; beside it, as the model says."""
    strong = simulated(11, truth=np.array([3.0, 0.0, 0.0]), blocks=400, dispersion=dispersion)
    assert strong.solve([1]).dispersion > 3 * dispersion
    assert strong.solve(range(3), tested=[1]).dispersion == pytest.approx(dispersion, rel=0.3)


def test_the_dispersion_of_an_effect_is_that_of_its_own_parameters() -> None:
    """Independent columns whose scores scatter once, six times and a tenth as much as the model says."""
    true, blocks = np.array([1.0, 6.0, 0.1]), 600
    score = np.random.default_rng(3).normal(size=(blocks, 3)) * np.sqrt(true)
    gram = Gram(score, np.tile(np.eye(3), (blocks, 1, 1)), np.zeros(blocks, int))
    fitted: Any = SimpleNamespace(gram=gram, precision=np.array([0.0, 0.0, 2.0]))
    found = [dispersion_of(fitted, 1, offset=k) for k in range(3)]
    assert found == pytest.approx([1.0, 6.0, 1.0], rel=0.25)  # never less than 1
    assert dispersion_of(fitted, 2, offset=0) == pytest.approx(3.5, rel=0.25)  # the median of both


def test_scatter_in_few_blocks_is_neither_too_small_nor_too_large_beside_others() -> None:
    """12 blocks and 3 columns, 300 times: the mean is 1 (sd of the mean 0.03)."""
    found = [simulated(s, blocks=12).solve(range(3), tested=[2], effective=True).dispersion for s in range(300)]
    assert np.mean(found) == pytest.approx(1.0, abs=0.12)


def test_neighbours_that_go_together_widen_errors() -> None:
    """Scores of pairs of blocks that are equal carry the news of one: the variance is some 1.5 to 2 times larger."""
    plain = simulated(8, blocks=300)
    score = np.repeat(plain.score[:150], 2, axis=0)
    information = np.repeat(plain.information[:150], 2, axis=0)
    together = Gram(score, information, np.zeros(300, int))
    mixed = Gram(score[np.argsort(np.arange(300) % 2, kind="stable")],
                 information[np.argsort(np.arange(300) % 2, kind="stable")], np.zeros(300, int))  # fmt: skip
    ratio = np.diag(together.solve(range(3)).covariance) / np.diag(mixed.solve(range(3)).covariance)
    assert np.all(ratio > 1.25)
    assert np.all(ratio < 2.1)


@given(st.integers(0, 10_000), st.integers(2, 12), st.integers(1, 20))
def test_rounding_does_not_change_errors(seed: int, blocks: int, columns: int) -> None:
    """Also with fewer blocks than columns, where the scatter of the scores has no full rank."""
    gram = simulated(seed, blocks=blocks, columns=columns, dispersion=4.0)
    moved = Gram(gram.score * (1 + 1e-13), gram.information, gram.flight)
    one, other = (g.solve(range(columns), precision=np.ones(columns), effective=True).covariance for g in (gram, moved))
    sd = np.sqrt(np.diag(one))
    np.testing.assert_allclose(one / np.outer(sd, sd), other / np.outer(sd, sd), atol=1e-6)
    assert np.linalg.eigvalsh(one / np.outer(sd, sd)).min() > -1e-9


def test_errors_are_never_smaller_than_the_information_allows() -> None:
    """Scores that scatter less than they should are luck."""
    quiet = simulated(9, dispersion=0.01)
    b, a = quiet.total(range(3))
    assert np.all(np.diag(quiet.solve(range(3)).covariance) >= np.diag(np.linalg.inv(a)) * (1 - 1e-9))
    assert b.shape == (3,)


def differing(seed: int, flights: int, spread: float) -> Gram:
    """Flights of 20 blocks that each have parameters of their own, `spread` about 0."""
    parts = [
        simulated(1000 * seed + k, blocks=20, columns=2, truth=spread * np.random.default_rng((seed, k)).normal(size=2))
        for k in range(flights)
    ]
    which = np.repeat(np.arange(flights), 20)
    return Gram(np.concatenate([p.score for p in parts]), np.concatenate([p.information for p in parts]), which)


def test_errors_by_flights_are_those_of_parameters_that_differ_from_flight_to_flight() -> None:
    """Told by 9 flights, 200 times: what is said against how far the fits are from 0, and blocks that do not see it."""
    off, said, by_blocks = [], [], []
    for seed in range(200):
        gram = differing(seed, 9, 0.2)
        found = gram.solve(range(2))
        sd, freedom = gram.by_flights(found.theta, np.zeros(2))
        assert freedom == 8
        off.append(found.theta)
        said.append(sd)
        by_blocks.append(np.sqrt(np.diag(found.covariance)))
    rms, told, blind = (np.sqrt(np.mean(np.square(x), axis=0)) for x in (off, said, by_blocks))
    np.testing.assert_allclose(told, rms, rtol=0.15)
    assert np.all(blind < 0.6 * rms)
    within = np.abs(off) < stats.t.ppf(0.975, 8) * np.array(said)
    assert 0.90 < within.mean() < 0.98


def test_few_flights_do_not_tell_by_how_much_they_differ() -> None:
    sd, freedom = differing(1, FITTING.min_flights - 1, 1.0).by_flights(np.zeros(2), np.zeros(2))
    assert freedom == 0
    assert not sd.any()
