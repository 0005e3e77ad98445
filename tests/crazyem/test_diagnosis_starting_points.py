"""Where effects with many maxima are begun, and what swings on through steps that the filter leaves out.

Loads are those of `closed_loop.py`: plane pendulums, which share no line with the catalogue's.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import THRUST, data_of, start_point
from hypothesis import given
from hypothesis import strategies as st

from crazyem.diagnosis.fitting.candidates import Candidate, variants
from crazyem.diagnosis.fitting.fit import nominal
from crazyem.diagnosis.fitting.model import Model, diverges
from crazyem.diagnosis.fitting.nuisances import refine_base
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.naming import starting_points
from crazyem.diagnosis.naming.select import at_linear_size, shortlist
from crazyem.diagnosis.naming.starting_points import best_starting_points, likeliest_start, peaks
from crazyem.diagnosis.naming.trials import Trial
from crazyem.diagnosis.settings import SELECTION
from crazyem.diagnosis.workers import Workers
from crazyem.physics.effects.catalogue import CATALOGUE

LOAD = CATALOGUE["suspended_load"]
POINT = start_point()


@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=30))
def test_of_many_beginnings_the_highest_peaks_are_kept(gains):
    kept = peaks(gains)
    assert 1 <= len(kept) <= SELECTION.peaks
    assert gains[kept[0]] == max(gains)
    for i in kept:
        assert i == 0 or gains[i - 1] < gains[i]
        assert i == len(gains) - 1 or gains[i + 1] <= gains[i]


def fitted(data, point, candidate):
    start = point.with_effects({"suspended_load": {**dict(candidate.begin), "mass": 0.001}})
    return refine_base(data.twin(), start, [candidate], rounds=6, noise=False)


@pytest.mark.slow
@pytest.mark.parametrize("length", [0.27, 0.5])  # at 0.15 m the plane pendulum itself is 5 % from the real one
def test_a_load_is_begun_at_the_length_whose_swing_the_flight_shows(length):
    recording = fly(Hidden(load=(0.0015, length)), seconds=20.0, seed=3)
    data = data_of(recording)
    point = refine_base(data, nominal(data, POINT), ()).point
    candidates = [*variants(LOAD, point, data.signals), THRUST]
    left = best_starting_points(data, point, (), candidates)
    assert candidates[-1] in left  # has one beginning only
    begun = left[:-1]
    assert 1 <= len(begun) <= SELECTION.peaks
    fits = [fitted(data, point, c) for c in begun]
    right = [f for f in fits if f.point.effects["suspended_load"]["length"] == pytest.approx(length, rel=0.04)]
    assert len(right) == 1
    assert right[0].loglik > max(f.loglik for f in fits) - 1.0  # 0.5 m: half of that fits as well, within 0.1 nats
    assert right[0].point.effects["suspended_load"]["mass"] == pytest.approx(0.0015, rel=0.1)


class Likely:
    """Flights whose log-likelihood has one peak, at a mass and a length, and asks for the thrust that carries it."""

    workers = Workers(1)

    def __init__(self, mass, length, height):
        self.mass, self.length, self.height = mass, length, height

    def twin(self):
        return self

    def loglik(self, point):
        load = point.effects.get("suspended_load")
        if load is None:
            return 0.0
        lifted = point.effects["thrust_scale"]["scale"] / (0.9 * (1 + load["mass"] / DRONE.mass))
        assert lifted == pytest.approx(1.0)  # beside what thrust the model had already
        off = np.log(load["mass"] / self.mass) ** 2 + (20 * np.log(load["length"] / self.length)) ** 2
        return self.height - 100.0 * off


@pytest.mark.parametrize(("height", "found"), [(100.0, True), (-50.0, False)])  # the latter: nothing is likelier
def test_a_load_that_is_followed_only_by_one_as_heavy_is_begun_with_its_mass(height, found):
    point = POINT.with_effects({"thrust_scale": {"scale": 0.9}})
    family = variants(LOAD, point, frozenset({"position", "velocity"}))
    begun = likeliest_start(Likely(0.0018, 0.25, height), point, family)
    assert (begun is not None) == found
    if begun is not None:
        assert begun.likeliest
        assert dict(begun.begin)["length"] == pytest.approx(0.25, rel=0.05)
        assert dict(begun.begin)["mass"] == 0.002  # the nearest, by ratio
        started = at_linear_size(POINT, begun, SimpleNamespace(theta=np.array([9.0, -0.004, 0.2])))
        assert started.effects["suspended_load"] == dict(begun.begin)  # whatever derivatives say


def test_what_is_begun_by_its_likelihood_is_tried_whatever_derivatives_say():
    def entry(name, gain, **begun):
        return Trial(Candidate(name, (), ("mass",), **begun), gain, 0.0, 1.0, gain - 1.0), None

    others = [entry(n, g) for n, g in (("payload", 90.0), ("wind", 80.0), ("thrust_scale", 70.0))]
    load = entry("suspended_load", -5.0, likeliest=True)
    assert shortlist([*others, load])[-1] is load
    assert len(shortlist([*others, entry("suspended_load", -5.0)])) == len(others)


@pytest.mark.parametrize("chaotic", [False, True])
def test_where_a_flight_drives_loads_astray_the_likeliest_is_begun_with_alone(monkeypatch, chaotic):
    data = data_of(fly(Hidden(load=(0.0015, 0.5)), seconds=10.0))
    point = refine_base(data, nominal(data, POINT), ()).point
    data.models[0]._diverging["suspended_load"] = chaotic
    family = variants(LOAD, point, data.signals)
    likeliest = replace(family[7], begin=(*family[7].begin, ("mass", 0.004)))
    monkeypatch.setattr(starting_points, "likeliest_start", lambda data, point, family: likeliest)
    begun = best_starting_points(data, point, (), family)
    assert (begun == [likeliest]) == chaotic
    assert chaotic or set(begun) <= set(family)


@pytest.mark.parametrize(("shaken", "chaotic"), [(0.0, False), (0.6, True)])  # m/s
def test_only_a_load_that_is_shaken_strays_from_its_path(shaken, chaotic):
    flight = flight_of(fly(seconds=20.0), DRONE)
    if shaken:
        y = flight.y.copy()
        y[:, 3:6] = shaken * np.sin([5.6, 6.1, 9.0] * flight.time[:, None] + [0.0, 1.0, 0.0]) * [1, 1, 0.2]
        flight = replace(flight, y=y)
    assert diverges(flight, DRONE, "suspended_load") == chaotic
    assert not diverges(flight, DRONE, "payload")  # nothing to be lost


@pytest.mark.parametrize("chaotic", [False, True])
def test_a_load_is_followed_by_its_pull_only_where_a_flight_drives_it_astray(chaotic):
    """A pull that the path does not know of, seen in one second, is believed in the next or not at all."""
    model = Model(flight_of(fly(seconds=8.0), DRONE))
    point = POINT.with_effects({"suspended_load": {"mass": 0.002, "length": 0.3}})
    model.settle(point)
    model._diverging["suspended_load"] = chaotic
    before = model.accelerations(point)[0]
    at = model.flight.time.size // 2
    model.observed_force = model.observed_force.copy()
    model.observed_force[at : at + 100, 0] += 0.5
    after = model.accelerations(point)[0]
    assert np.array_equal(before[: at + 1], after[: at + 1])
    assert np.array_equal(before, after) != chaotic


def test_what_swings_goes_on_through_steps_that_are_left_out():
    flight = flight_of(fly(seconds=8.0), DRONE)
    point = POINT.with_effects({"suspended_load": {"mass": 0.002, "length": 0.3}})
    middle = np.arange(flight.time.size) == flight.time.size // 2
    as_it_is, left_out, torn = (
        Model(f).accelerations(point)[0]
        for f in (
            flight,
            replace(flight, starts=flight.starts | middle),
            replace(flight, starts=flight.starts | middle, gaps=flight.gaps | middle),
        )
    )
    assert np.array_equal(as_it_is, left_out)
    assert np.abs(as_it_is - torn)[middle.argmax() :].max() > 0.01


def test_long_flights_are_swept_in_pieces_of_one_path():
    flight = flight_of(fly(seconds=70.0, seed=2), DRONE)
    assert flight.starts.sum() == 2
    assert flight.gaps.sum() == 1


def test_a_weight_that_only_tilts_begins_with_some_weight():
    """The linear approximation may want a moment and no weight: of none, where it sits has no derivatives, and the fit
    would stay there for ever."""
    load = Candidate("payload", (), ("mass", "x", "y", "z"), (("mass", 5e-4),))
    for mass in (0.0, -1e-3, 1e-6):
        assert load.started(POINT, [mass, 0.01, 0.02, 0.0]) == {"mass": 5e-4, "x": 0.01, "y": 0.02, "z": 0.0}
    twice = load.started(
        POINT, [1e-3, 0.01, 0.02, 0.0]
    )  # twice the weight where derivatives were taken: half as far out
    assert twice == pytest.approx({"mass": 1e-3, "x": 0.005, "y": 0.01, "z": 0.0})
