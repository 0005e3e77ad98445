"""What a real effect is expected to gain on flights to which it was not fitted; by closed forms and by simulation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import optimize

from crazyem.diagnosis.naming.evidence import _inverse, expected_gain


def information_of(rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Of columns of unequal scale that go together."""
    root = rng.normal(size=(size, size + 3))
    scale = 10.0 ** rng.uniform(-1.0, 1.0, size)
    matrix: NDArray[np.float64] = root @ root.T * np.outer(scale, scale)
    return matrix


@given(st.integers(0, 10**6), st.integers(1, 3), st.integers(0, 3), st.integers(0, 3))
def test_the_rest_is_profiled_out_and_a_usual_spread_is_a_prior_variance(
    seed: int, count: int, before: int, after: int
) -> None:
    """The block of the inverse is the inverse of the Schur complement; the prior variance is added to it."""
    rng = np.random.default_rng(seed)
    information, own = information_of(rng, before + count + after), slice(before, before + count)
    variance = np.linalg.inv(information)[own, own]
    away = rng.normal(size=count)
    for share in (
        np.zeros(count),
        rng.uniform(0.1, 3.0, count),
        rng.uniform(0.1, 3.0, count) * (rng.random(count) < 0.5),
    ):
        spread = share * np.sqrt(np.diag(variance))
        wanted = 0.5 * away @ np.linalg.inv(variance + np.diag(spread**2)) @ away
        assert expected_gain(information, own, away, spread) == pytest.approx(wanted, rel=1e-6)


@given(st.integers(0, 10**6), st.integers(1, 6), st.sets(st.integers(0, 6), max_size=3))
def test_what_is_not_known_has_an_inverse_of_exactly_zero(seed: int, size: int, unknown: set[int]) -> None:
    """Rounding would become a huge information in the inverse of the inverse."""
    matrix = information_of(np.random.default_rng(seed), size)
    gone = [i for i in unknown if i < size]
    matrix[gone], matrix[:, gone] = 0.0, 0.0
    found = _inverse(_inverse(matrix))
    assert not found[gone].any()
    assert not found[:, gone].any()
    np.testing.assert_allclose(found, matrix, rtol=1e-3, atol=1e-6 * np.abs(matrix).max())


def test_it_is_the_mean_gain_of_likelihoods_whose_other_columns_are_fitted() -> None:
    """Of 20000 flights with a real effect, with normal scores: the model with it against the model without."""
    rng, own, rest = np.random.default_rng(1), slice(1, 3), [0, 3]
    information, size = information_of(rng, 4), np.array([0.0, 0.6, -0.9, 0.0])
    size[own] /= np.sqrt(np.diag(information)[own])
    score = rng.multivariate_normal(information @ size, information, size=20000)
    free = np.linalg.inv(information[np.ix_(rest, rest)])

    def likely(there: NDArray[np.float64]) -> NDArray[np.float64]:
        left = (score - information @ there)[:, rest]
        best: NDArray[np.float64] = score @ there - 0.5 * there @ information @ there
        return best + 0.5 * np.einsum("ni,ij,nj->n", left, free, left)

    gain = likely(size) - likely(np.zeros(4))
    wanted = expected_gain(information, own, size[own], np.zeros(2))
    assert gain.mean() == pytest.approx(wanted, abs=4.0 * gain.std() / 20000**0.5)
    assert gain.var() == pytest.approx(2.0 * wanted, rel=0.05)


def test_a_nuisance_gains_its_part_without_the_effect() -> None:
    """What remains when the other columns and, by its prior, the effect's own take up as much as they can."""
    rng = np.random.default_rng(2)
    information, away, spread = information_of(rng, 5), np.array([0.4, -0.2]), np.array([0.3, 0.05])

    def lost(taken: NDArray[np.float64]) -> float:
        left = np.append(away, np.zeros(3)) - taken
        return 0.5 * float(left @ information @ left + np.sum((taken[:2] / spread) ** 2))

    least = optimize.minimize(lost, np.zeros(5), method="BFGS", options={"gtol": 1e-8}).fun
    assert expected_gain(information, slice(0, 2), away, spread) == pytest.approx(least, rel=1e-6)


def test_flights_that_show_nothing_of_an_effect_are_expected_to_say_nothing() -> None:
    """As a hover of a damping; a column that no flight shows changes nothing."""
    information = information_of(np.random.default_rng(3), 3)
    blind = np.zeros((4, 4))
    blind[:3, :3] = information
    one, none = np.array([0.7]), np.zeros(1)
    assert expected_gain(blind, slice(3, 4), one, none) == 0.0
    assert expected_gain(blind, slice(0, 1), one, none) == pytest.approx(
        expected_gain(information, slice(0, 1), one, none)
    )
    both = np.ones((2, 2))  # two columns that say the same: without one effect, the other explains all
    assert expected_gain(both, slice(0, 1), one, none) == pytest.approx(0.0, abs=1e-12)
