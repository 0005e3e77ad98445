"""The product's estimator on the paper's flights: it is given samples, and nothing of the truth."""

import numpy as np
import pytest

from crazyem.errors import UsageError
from crazyem.paper.flight import Flight, fly
from crazyem.paper.product import PARAMETERS, ProductOnline, estimator_for, product_offline
from crazyem.paper.settings import Settings

SHORT = Settings(duration=3.0, window=200)


@pytest.fixture(scope="module")
def flight() -> Flight:
    return fly(SHORT, 1)


def truth(settings: Settings) -> np.ndarray:
    return np.array([settings.mass, *settings.inertia])


@pytest.mark.parametrize("sensor", "ABC")
def test_a_stretch_of_flight_gives_its_parameters(flight, sensor):
    fit = product_offline(flight, sensor)
    assert fit.converged
    assert np.all(np.abs(np.log(fit.value / truth(SHORT))) < 4 * fit.sd / fit.value)
    assert np.all(fit.ci95[:, 0] < fit.value)
    assert np.all(fit.value < fit.ci95[:, 1])
    assert fit.sd[0] / fit.value[0] == pytest.approx(0.005 / (0.18 * 9.81 * np.sqrt(3.0)), rel=0.3)


def test_nothing_of_the_truth_is_looked_at(flight):
    blind = fly(SHORT, 1)
    blind.truth[:] = np.nan
    blind.estimate[:] = np.nan
    blind.reference[:] = np.nan
    blind.settings = Settings(duration=3.0, window=200, mass=1.0, inertia=(1.0, 1.0, 1.0), force_noise=9.0)
    assert np.array_equal(product_offline(blind, "C").value, product_offline(flight, "C").value)


def test_another_drone_is_found_as_well():
    """Neither the preset's mass nor its inertia is where the estimate comes from."""
    other = Settings(duration=4.0, mass=0.3, inertia=(6e-4, 5e-4, 4e-4))
    fit = product_offline(fly(other, 2), "C")
    assert np.all(np.abs(np.log(fit.value / truth(other))) < 4 * fit.sd / fit.value)


@pytest.mark.parametrize("sensor", "ABC")
def test_the_start_is_the_papers_and_the_vehicle_holds_no_truth(sensor):
    vehicle = estimator_for(SHORT, sensor).vehicle
    assert vehicle.mass == SHORT.mass_start
    assert vehicle.inertia == SHORT.inertia_start
    product = ProductOnline(SHORT, sensor)
    fresh = Flight(SHORT, 0)
    mass, inertia = product.update(fresh)  # one row: nothing to say yet
    assert mass == SHORT.mass_start
    assert inertia.tolist() == list(SHORT.inertia_start)
    assert product.estimate is None


@pytest.mark.parametrize("sensor", "AC")
def test_rows_handed_over_in_pieces_are_those_of_the_whole(sensor):
    """The estimator in the loop gets every sample once and in order, whatever the size of the pieces."""
    settings = Settings(duration=1.0, window=100)
    said = []
    for piece in (4, 7, 50):
        flight = Flight(settings, 3)
        product = ProductOnline(settings, sensor)
        while flight.size <= settings.steps:
            flight.advance(piece, mass=settings.mass, inertia=settings.inertia)
            product.update(flight)
        counters = product.estimator.counters
        assert (counters.late, counters.missing, counters.grounded, counters.breaks) == (0, 0, 0, 1)
        assert counters.nodes == settings.steps - 1  # of steps + 1 rows the last two wait for what follows them
        assert product.estimate is not None
        said.append([product.estimate[name].value for name in PARAMETERS])
    whole = estimator_for(settings, sensor)
    last = None
    for sample in fly(settings, 3).samples(sensor):
        last = whole.feed(sample) or last
    assert last is not None
    said.append([last[name].value for name in PARAMETERS])
    assert all(row == said[0] for row in said)


def test_one_update_for_every_four_rows_two_rows_behind():
    settings = Settings(duration=1.0, window=100)
    flight, product = Flight(settings, 3), ProductOnline(settings, "C")
    for _ in range(29):
        flight.advance(4, mass=settings.mass, inertia=settings.inertia)
        mass, inertia = product.update(flight)
        assert len(product.update_seconds) == (flight.size - 2) // 4
    assert abs(mass / settings.mass - 1) < 0.05
    assert inertia.shape == (3,)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("D",), "unknown sensor 'D'"),
        (("A", 5, 5), "rows 5 to 5"),
        (("A", 0, 10**6), "not in a flight"),
        (("A", 0, 10), "too short"),
    ],
)
def test_what_does_not_exist_is_refused(flight, arguments, message):
    with pytest.raises(UsageError, match=message):
        product_offline(flight, *arguments)
