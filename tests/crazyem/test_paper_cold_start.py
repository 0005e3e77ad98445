"""Cold starts in closed loop: take-off, judging against slow plain forms, short flights, the file of the study."""

import json
import math
from dataclasses import replace
from pathlib import Path

import cold_start as study
import numpy as np
import pytest
from cold_start_study import (
    BANDS,
    NAMES,
    SETTLED_SECONDS,
    SMOOTH_SETTINGS,
    ColdStart,
    Loop,
    Settling,
    cold_start,
    settling,
    spread,
    summarise,
)
from hypothesis import given
from hypothesis import strategies as st

from crazyem.errors import UsageError
from crazyem.paper.flight import LIFTED_HEIGHT, THRUST_RAMP, Flight
from crazyem.paper.product import estimator_for
from crazyem.paper.settings import P5

ROOT = Path(__file__).parents[2]
# up by a metre and stay there: long enough to judge, short enough for a test
SHORT = replace(P5, duration=1.5, waypoints=((0.5, 1.0, 1.0),))
TRUE = np.array([P5.mass, *P5.inertia])
inf, nan = math.inf, math.nan


@pytest.fixture(scope="module")
def from_air():
    return cold_start(0, "C", settings=SHORT)


@pytest.fixture(scope="module")
def from_floor():
    return cold_start(1, "A", ground=True, smooth=False, settings=replace(SHORT, duration=2.5))


# taking off -------------------------------------------------------------------------------------------------------


def test_thrust_ramps_up_from_the_floor_and_waits_for_a_mass():
    flight = Flight(SHORT, 3, ground=True)
    flight.advance(SHORT.steps, mass=None, inertia=SHORT.inertia)
    assert flight.lift_off == -1
    lifted = flight.readings[:-1, 2] > LIFTED_HEIGHT
    first = int(np.argmax(lifted))
    ramp = THRUST_RAMP * SHORT.dt * np.arange(first)
    np.testing.assert_allclose(flight.wrench[:first, 0], ramp, atol=1e-12)
    assert flight.wrench[first, 0] == flight.wrench[first - 1, 0]
    # it stood until thrust carried it, and rose as thrust over weight says: dz'''/dt = THRUST_RAMP / m
    left = int(np.flatnonzero(flight.contact)[-1])
    assert left * SHORT.dt == pytest.approx(SHORT.mass * 9.81 / THRUST_RAMP, abs=0.03)
    height = THRUST_RAMP / SHORT.mass * ((first - left) * SHORT.dt) ** 3 / 6
    assert flight.truth[first, 2] == pytest.approx(height, abs=0.04)


def test_the_reference_begins_when_a_mass_is_known():
    waiting = Flight(SHORT, 3, ground=True)
    waiting.advance(280, mass=None, inertia=SHORT.inertia)
    waiting.advance(1, mass=SHORT.mass, inertia=SHORT.inertia)
    assert waiting.lift_off == 280
    at_once = Flight(SHORT, 3, ground=True)
    at_once.advance(281, mass=SHORT.mass, inertia=SHORT.inertia)
    assert at_once.lift_off == int(np.argmax(at_once.readings[:, 2] > LIFTED_HEIGHT))
    rows = slice(0, at_once.lift_off)
    np.testing.assert_array_equal(waiting.truth[rows], at_once.truth[rows])


def test_on_the_way_up_the_angles_are_held_with_the_inertia_believed_in():
    held = Flight(SHORT, 5, ground=True)
    held.advance(260, mass=None, inertia=SHORT.inertia_start)
    free = Flight(SHORT, 5, ground=True)
    free.advance(260, mass=None, inertia=(1e-9, 1e-9, 1e-9))
    tilt = [float(np.abs(f.truth[: f.size, 6:8]).max()) for f in (held, free)]
    assert tilt[0] < 0.5 < tilt[1]


def test_in_the_air_a_mass_must_be_given():
    lifted = Flight(SHORT, 0, ground=True)
    lifted.advance(SHORT.steps, mass=SHORT.mass, inertia=SHORT.inertia)
    for flight in (Flight(SHORT, 0), lifted):
        with pytest.raises(UsageError, match="cannot wait"):
            flight.advance(1, mass=None, inertia=SHORT.inertia)


# short flights ----------------------------------------------------------------------------------------------------


def test_from_the_air(from_air):
    assert not from_air.crashed
    assert from_air.lift_off == from_air.left_floor == from_air.time[0] == 0.0
    np.testing.assert_allclose(from_air.ratio[0] * TRUE, [P5.mass_start, *P5.inertia_start])
    assert from_air.settling["mass within 5 %"].stays < 0.12
    assert abs(from_air.ratio[-1, 0] - 1) < 0.02
    assert np.all(from_air.ratio > 0)
    assert from_air.sag < 0.2
    assert len(from_air.heights) == SHORT.steps + 1
    np.testing.assert_allclose(np.diff(from_air.time[1:]), SHORT.every * SHORT.dt)
    assert math.isnan(from_air.rms)  # it ends before 4 s
    assert all(map(math.isnan, from_air.over_bound))  # and before 2.5 s
    json.dumps(from_air.to_json(), allow_nan=False)


def test_from_the_floor(from_floor):
    assert not from_floor.crashed
    assert 0.85 < from_floor.left_floor < from_floor.lift_off < 1.6
    assert from_floor.contact_used == 0
    assert from_floor.touch_downs == 0
    assert from_floor.settling["mass within 5 %"].stays < 0.12
    assert abs(from_floor.ratio[-1, 0] - 1) < 0.02
    # the start is from before it lifted; the first estimate from the moment the controller could take over
    assert from_floor.time[0] == pytest.approx(-from_floor.lift_off)
    assert from_floor.time[1] <= 0.0


def test_the_same_seed_flies_the_same_flight():
    settings = replace(SHORT, duration=0.3)
    a, b, other = (cold_start(seed, "B", settings=settings) for seed in (7, 7, 8))
    np.testing.assert_array_equal(a.ratio, b.ratio)
    np.testing.assert_array_equal(a.heights, b.heights)
    assert a.to_json() == b.to_json()
    assert not np.array_equal(a.heights, other.heights)


def test_new_parameters_act_at_once():
    loop = Loop(replace(SHORT, duration=0.2), 2, "B", ground=False)
    said = None
    while said is None:
        said = loop.advance()
    row = loop.history[-1][0]
    assert row == loop.flight.size - 1
    assert loop.history[-1][1:] == tuple(said[name].value for name in NAMES)
    begun = loop.flight.wrench[row - 1, 0]
    loop.advance()
    assert loop.flight.wrench[row, 0] > 2 * begun  # much heavier than 1 g


def test_a_drone_that_turns_over_is_a_crash_and_still_a_record():
    flight = cold_start(0, "C", settings=replace(SHORT, torque_noise=0.2))
    assert flight.crashed
    assert len(flight.heights) < SHORT.steps
    json.dumps(flight.to_json(), allow_nan=False)
    assert summarise([flight]) == {"flights": 1, "crashed": [0], "contact_used": 0, "touch_downs": 0}


@pytest.mark.parametrize(("seed", "sensor"), [(0, "D"), (0, ""), (0, "AB"), (-1, "A")])
def test_what_cannot_be_flown(seed, sensor):
    with pytest.raises(UsageError):
        cold_start(seed, sensor)


@pytest.mark.parametrize("sensor", ["A", "B", "C"])
def test_a_touch_down_in_flight_is_taken_out_of_the_window(sensor):
    """Up, down to the floor because the controller believes in too light a drone, and up again."""
    settings = replace(SHORT, duration=4.5, every=20)
    flight = Flight(settings, 4, ground=True)
    estimator = estimator_for(settings, sensor)
    used, judged = np.zeros(settings.steps + 1, bool), 0
    for _ in range(settings.steps):
        light = 440 < flight.size < 640
        flight.advance(1, mass=0.02 if light else settings.mass, inertia=settings.inertia)
        for sample in flight.samples(sensor, flight.size - 2):
            estimator.feed(sample)
        if estimator.counters.nodes > judged:
            judged = estimator.counters.nodes
            used[judged - 1] = estimator.airborne
    stood = flight.contact
    assert np.count_nonzero(stood[450:]) > 20
    assert flight.truth[-1, 2] > 0.5
    assert not np.any(used & stood)
    assert np.count_nonzero(used[640:]) > 100
    mass = estimator.finish()["mass"]
    assert mass.value == pytest.approx(settings.mass, rel=0.02)
    assert abs(mass.value - settings.mass) < 4 * mass.sd


# judging ----------------------------------------------------------------------------------------------------------


def plain_settling(time, inside, until):
    """Looks at every instant from 0 to `until` on a fine grid; each value holds until the next."""

    def at(t):
        return [i for i, s in zip(inside, time) if s <= t][-1]

    steps = [t for t in time if 0.0 < t <= until]
    grid = [0.0, *steps]
    first = next((t for t in grid if at(t)), inf)
    stays = next((t for i, t in enumerate(grid) if all(at(u) for u in grid[i:])), inf)
    return Settling(first, stays, any(not i for i, t in zip(inside, time) if t > until))


@given(st.lists(st.booleans(), min_size=1, max_size=40), st.integers(0, 10), st.integers(0, 30))
def test_settling_is_what_looking_at_every_instant_says(inside, before, until):
    time = np.arange(len(inside)) - float(min(before, len(inside) - 1))
    assert settling(time, np.array(inside), until=float(until)) == plain_settling(time, inside, float(until))


@given(st.lists(st.floats(0, 1e6) | st.just(inf), min_size=1, max_size=200))
def test_spread_counts(values):
    said = spread(values)
    assert said["worst"] == max(values)
    for name, share in (("median", 0.5), ("p95", 0.95)):
        below = sum(v <= said[name] for v in values)
        assert said[name] in values
        assert below >= share * len(values) - 1e-9
        assert sum(v < said[name] for v in values) < share * len(values)


def made(seed, *, ratio=1.1, crashed=False):
    """A record without a flight."""
    bands = {name: Settling(0.1 * seed, 0.2 * seed, seed == 2) for name in BANDS}
    return ColdStart(
        seed=seed, sensor="C", ground=True, smooth=True, crashed=crashed, lift_off=1.25, left_floor=1.0, settling=bands,
        sag=0.01 * seed, highest_mass=1.5, rms=0.1 * ratio, rms_known=0.1, touch_downs=0, contact_used=seed == 3,
        largest_tilt=0.3, bound=(0.1,) * 4, over_bound=(1.0 * seed,) * 4, time=np.array([-1.25, 0.0, 0.02]),
        ratio=np.ones((3, 4)), heights=np.linspace(0.1, 0.2, 9),
    )  # fmt: skip


def test_a_summary_counts_crashes_and_takes_the_others():
    said = summarise([made(1), made(2), made(3), made(4, crashed=True)])
    assert said["flights"] == 4
    assert said["crashed"] == [4]
    assert said["contact_used"] == 1
    assert said["mass within 1 %"]["stays"] == {"median": 0.4, "p95": 0.6, "worst": 0.6}
    assert said["inertia within 25 %"]["leaves_later"] == 1
    assert said["tracking_ratio"]["median"] == pytest.approx(1.1)
    assert said["rms_over_bound"] == pytest.approx([math.sqrt(14 / 3)] * 4)
    assert said["after_floor"]["worst"] == pytest.approx(0.25)


# the study --------------------------------------------------------------------------------------------------------


def test_a_line_of_the_study_is_a_flight(from_air, from_floor):
    for flight in (from_air, from_floor, replace(made(2), settling={n: Settling(0.1, inf, True) for n in BANDS})):
        line = json.loads(json.dumps(study.line_of(flight, reference="smooth", code="x"), allow_nan=False))
        again = study.flight_of(line)
        assert again.to_json() == flight.to_json()
        np.testing.assert_allclose(again.ratio, flight.ratio, atol=1e-5)
        assert summarise([again]) == summarise([study.flight_of(line)])


@pytest.mark.slow
def test_an_interrupted_study_goes_on(tmp_path, monkeypatch, capsys):
    flown = []

    def fake(seed, sensor, *, ground, smooth, settings):
        flown.append(seed)
        return replace(made(seed, crashed=seed == 1), sensor=sensor, ground=ground, smooth=smooth)

    monkeypatch.setattr(study, "cold_start", fake)
    kinds = [("air", "smooth", "C")]
    assert not study.fly(tmp_path, kinds, range(2), seconds=-1.0)
    assert flown == []
    assert study.fly(tmp_path, kinds, range(2), seconds=60.0)
    path = tmp_path / "flights.jsonl"
    lines = path.read_text().splitlines()
    # the second line was cut off, and there is one of other code
    other = json.dumps({**json.loads(lines[1]), "code": "older"})
    path.write_text(f"{lines[0]}\n{other}\n{lines[1][:50]}\n")
    assert study.fly(tmp_path, kinds, range(2), seconds=60.0)
    assert flown == [0, 1, 1]
    assert sorted(seed for _, seed in study.read(path, code=study.version())) == [0, 1]
    assert "CRASHED" in capsys.readouterr().out
    study.plot(tmp_path / "plot.png", study.read(path), sensor="C", reference="smooth")
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")


def test_the_check_tells_what_changed(monkeypatch):
    said = study.summary({(("floor", "smooth", "C"), s): made(s) for s in (1, 2, 3)})
    monkeypatch.setattr(study, "cold_start", lambda seed, *_, **__: made(seed))
    assert list(study.differences(said, 2)) == []
    monkeypatch.setattr(study, "cold_start", lambda seed, *_, **__: made(seed, ratio=1.2, crashed=True))
    assert len(list(study.differences(said, 1))) == 2
    monkeypatch.setattr(study, "cold_start", lambda seed, *_, **__: made(seed + 1))
    assert any("mass within 5 %" in text for text in study.differences(said, 1))


def test_the_page_says_what_the_stored_flights_say():
    """Every number in the tables of docs/results/cold_start.md comes from docs/results/cold_start.json."""
    stored = json.loads((ROOT / "docs" / "results" / "cold_start.json").read_text())
    page = (ROOT / "docs" / "results" / "cold_start.md").read_text()
    assert study.put_table(page, study.table(stored)) == page


@pytest.mark.slow
def test_whole_flights_track_as_with_known_parameters():
    for sensor, ground in (("A", False), ("B", True), ("C", False), ("C", True)):
        flight = cold_start(11, sensor, ground=ground)
        assert not flight.crashed
        assert flight.contact_used == 0
        assert flight.rms < 1.15 * flight.rms_known
        assert flight.settling["mass within 1 %"].stays < SETTLED_SECONDS
    assert SMOOTH_SETTINGS.smooth
