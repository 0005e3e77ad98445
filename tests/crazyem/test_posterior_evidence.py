"""The evidence of a model against plain numerical integration, and what units must not change."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate

from crazyem.diagnosis.posterior.evidence import Gaussian, Pass, Shared, box


def made_pass(seed: int, columns: int, *, blocks: int = 12) -> Pass:
    """A flight whose log-likelihood is a parabola: score and information by block, at a point off neutral."""
    random = np.random.default_rng(seed)
    roots = random.normal(size=(blocks, columns + 2, columns))
    information = np.einsum("bri,brj->bij", roots, roots) / columns
    return Pass(-3.0, random.normal(size=(blocks, columns)), information, 0.2 * random.normal(size=columns))


def loglik(flight: Pass, theta: np.ndarray) -> float:
    d = theta - flight.here
    return float(flight.loglik + flight.score.sum(0) @ d - 0.5 * d @ flight.information.sum(0) @ d)


def normal(x: float, sd: float) -> float:
    return float(np.exp(-0.5 * (x / sd) ** 2) / (np.sqrt(2 * np.pi) * sd))


@pytest.mark.parametrize(
    ("low", "high", "together"),
    [
        ((-9.0, -9.0), (9.0, 9.0), 0.0),
        ((0.0, -9.0), (9.0, 0.15), 0.0),
        ((0.0, -9.0), (9.0, 0.15), 0.9),  # a box that cuts a correlated prior
        ((-0.1, -0.1), (9.0, 9.0), -0.8),
    ],
)
def test_evidence_is_the_integral_over_a_bounded_prior(low, high, together) -> None:
    flight, own = made_pass(1, 2), np.array([0.5, 0.8])
    covariance = np.array([[1.0, together], [together, 1.0]]) * np.outer(own, own)
    shared = Shared([flight], np.zeros((1, 2)))
    found = shared.posterior([0, 1], Gaussian(covariance, np.array(low), np.array(high)))
    base, precision = loglik(flight, np.zeros(2)), np.linalg.inv(covariance)

    def prior(y: float, x: float) -> float:
        theta = np.array([x, y])
        return float(np.exp(-0.5 * theta @ precision @ theta) / (2 * np.pi * np.sqrt(np.linalg.det(covariance))))

    def density(y: float, x: float) -> float:
        return np.exp(loglik(flight, np.array([x, y])) - base) * prior(y, x)

    ends = [(max(lo, -6 * s), min(hi, 6 * s)) for lo, hi, s in zip(low, high, own, strict=True)]
    area, inside = (
        integrate.dblquad(f, *ends[0], *ends[1], epsabs=1e-10, epsrel=1e-6)[0] for f in (density, prior)
    )  # fmt: skip
    assert found.gain == pytest.approx(np.log(area / inside), abs=0.02)
    assert shared.nothing == pytest.approx(base)


def test_what_differs_between_flights_is_integrated_out() -> None:
    """Two flights, one parameter: what they share (cut at 0) and a deviation of each, against a threefold integral."""
    flights, own, usual = [made_pass(2, 1), made_pass(3, 1)], 0.6, np.array([[0.3], [0.5]])
    shared = Shared(flights, usual)
    found = shared.posterior([0], Gaussian(np.array([[own**2]]), np.array([0.0]), np.array([np.inf])))

    def of_flight(flight: Pass, sd: float, phi: float) -> float:
        grid = np.linspace(-7 * sd, 7 * sd, 301)
        away = phi + grid - flight.here[0]
        score, information = flight.score.sum(), flight.information.sum()
        values = np.exp(flight.loglik + score * away - 0.5 * information * away**2 + 6.0 - 0.5 * (grid / sd) ** 2)
        return float(integrate.simpson(values, x=grid) / (np.sqrt(2 * np.pi) * sd))

    def of_both(phi: float) -> float:
        return of_flight(flights[0], 0.3, phi) * of_flight(flights[1], 0.5, phi)

    grid = np.linspace(0.0, 5 * own, 81)
    total = integrate.simpson([of_both(p) * 2.0 * normal(p, own) for p in grid], x=grid)
    assert found.gain + shared.nothing == pytest.approx(np.log(total) - 12.0, abs=1e-3)
    assert shared.nothing == pytest.approx(np.log(of_both(0.0)) - 12.0, abs=1e-6)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(-6, 6), st.floats(-6, 6))
def test_units_change_nothing(seed: int, first: float, second: float) -> None:
    flight, own, usual = made_pass(seed, 3), np.array([0.5, 0.8, 0.3]), np.array([[0.1, 0.0, 0.2]])
    low, high = np.array([0.0, -np.inf, -0.2]), np.array([np.inf, np.inf, 0.4])
    unit = np.array([10.0**first, 10.0**second, 1.0])
    other = Pass(
        flight.loglik, flight.score / unit, flight.information / np.outer(unit, unit), flight.here * unit
    )  # fmt: skip
    one = Shared([flight], usual).posterior(range(3), Gaussian(np.diag(own**2), low, high))
    two = Shared([other], usual * unit).posterior(
        range(3), Gaussian(np.diag((own * unit) ** 2), low * unit, high * unit)
    )
    assert two.gain == pytest.approx(one.gain, abs=1e-6)
    assert two.mean / unit == pytest.approx(one.mean, abs=1e-6)
    assert Shared([other], usual * unit).nothing == pytest.approx(Shared([flight], usual).nothing, abs=1e-6)


def test_a_column_that_nothing_shows_costs_and_brings_nothing() -> None:
    flight = made_pass(5, 2)
    score, information = flight.score.copy(), flight.information.copy()
    score[:, 1] = information[:, 1] = information[:, :, 1] = 0.0
    shared = Shared([Pass(0.0, score, information, flight.here)], np.zeros((1, 2)))
    wide = np.full(2, np.inf)
    alone = shared.posterior([0], Gaussian(np.eye(1), -wide[:1], wide[:1]))
    both = shared.posterior([0, 1], Gaussian(np.eye(2), -wide, wide))
    assert both.gain == pytest.approx(alone.gain)
    assert both.covariance[1, 1] == pytest.approx(1.0)


def test_a_box_far_out_keeps_its_digits() -> None:
    inside, mean, covariance = box(np.array([-20.0]), np.eye(1), np.array([0.0]), np.array([np.inf]))
    assert inside == pytest.approx(-203.9172, abs=1e-3)  # tables of the normal tail
    assert 0.0 < mean[0] < 0.06
    assert 0.0 < covariance[0, 0] < 0.06**2


def test_the_maximum_is_where_scores_and_priors_balance() -> None:
    """Evidence is the same from any point of a parabola; scores at the maximum are those of the prior."""
    flight, usual = made_pass(9, 3), np.array([[0.3, 0.2, 0.0]])
    shared, phi = Shared([flight], usual), np.array([0.0, 0.0, 0.4])
    (there,) = shared.there([flight], phi)
    again = Shared([there], usual)
    assert again.nothing == pytest.approx(shared.nothing)
    assert again.score == pytest.approx(shared.score)
    assert there.score.sum(0)[:2] == pytest.approx((there.here - phi)[:2] / usual[0, :2] ** 2)


def test_scatter_of_blocks_is_one_where_the_model_holds() -> None:
    random, ratio, none = np.random.default_rng(7), [], np.zeros((1, 2))
    for _ in range(40):
        information = np.repeat(np.eye(2)[None], 200, axis=0)
        score = random.normal(size=(200, 2))
        flights = [Pass(0.0, k * score, information, none[0]) for k in (1.0, 2.0)]
        ratio.append([Shared([flight], none).scatter.mean() for flight in flights])
    assert np.mean(ratio, axis=0) == pytest.approx([1.0, 4.0], rel=0.15)
