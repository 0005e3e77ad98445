"""`crazyem paper`: settings by name, the plan, and how flights feed back."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.cli import main
from crazyem.errors import UsageError
from crazyem.paper import experiments
from crazyem.paper.experiments import Task, plan, run_task
from crazyem.paper.flight import Flight, fly
from crazyem.paper.settings import LITERAL, Settings, _text, describe_text, described, settings_with

SMALL = replace(Settings(), duration=1.5, window=200, every=20)


# settings -----------------------------------------------------------------------------------------------------
def test_every_setting_can_be_set_to_what_it_is() -> None:
    for field in fields(Settings):
        value = getattr(Settings(), field.name)
        assert settings_with([f"{field.name}={_text(value)}"]) == Settings(), field.name


def test_settings_are_listed_with_their_reasons(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["paper", "--settings", "--set", "mass=0.2"]) == 0
    said = capsys.readouterr().out
    assert "mass = 0.2 kg" in said
    for entry in described(Settings()):
        assert entry["name"] in said
        assert entry["reason"] in said
    assert "changed from 0.18 (printed (VI-B))" in said
    assert said.strip() == describe_text(replace(Settings(), mass=0.2))


def test_the_other_reading(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["paper", "--settings", "--reading", "literal", "--set", "smooth=true"]) == 0
    assert capsys.readouterr().out.strip() == describe_text(replace(LITERAL, smooth=True))


@pytest.mark.parametrize(
    ("assignment", "says"),
    [
        ("mass", "not NAME=VALUE"), ("weight=1", "no setting 'weight'"), ("mass=heavy", "not a number between"),
        ("mass=nan", "not a number between"), ("mass=-0.18", "not a number between"),
        ("window=100.5", "not a whole number"),
        ("window=19", "not a number between 20 and 20000"),
        ("window=5000", "longer than the flight"),
        ("every=801", "leaves gaps"), ("inertia=1e-4,2e-4", "not 3 numbers"),
        ("inertia=1e-4,1e-4,3e-4", "largest moment of inertia"),
        ("smooth=perhaps", "neither true nor false"),
        ("waypoints=" + ";".join(["1,2,3"] * 101), "too many"),
        ("dt=0.0001", None), ("duration=600", None), ("waypoints=1,2,3;4,5,6", None),
    ],
)  # fmt: skip
def test_settings_that_are_refused(assignment: str, says: str | None) -> None:
    if says is None:
        settings_with([assignment])
        return
    with pytest.raises(UsageError, match=says):
        settings_with([assignment])


@pytest.mark.parametrize("together", [("duration=600", "dt=0.0001"), ("duration=200", "dt=0.001", "substeps=100")])
def test_a_flight_that_is_too_long_together(together: tuple[str, ...]) -> None:
    with pytest.raises(UsageError, match="too long"):
        settings_with(together)


@given(st.sampled_from([f.name for f in fields(Settings)]), st.text(max_size=40))
def test_any_text_is_a_value_or_one_sentence(name: str, text: str) -> None:
    try:
        found = settings_with([f"{name}={text}"])
    except UsageError as error:
        said = str(error)
        found = None
    if found is None:
        assert len(said.splitlines()) == 1
        return
    assert type(getattr(found, name)) is type(getattr(Settings(), name))


@given(st.floats(1e-4, 100.0))
def test_numbers_come_through_exactly(value: float) -> None:
    assert settings_with([f"mass={value!r}"]).mass == value


# tasks --------------------------------------------------------------------------------------------------------
def test_plan_has_what_was_asked_for() -> None:
    everything = plan(("table1", "offline", "online"), "ABC", ("published", "crazyem"), 2)
    assert len(everything) == len(set(everything)) == 2 * (1 + 3 * 3 + 3 * 2)
    assert plan(("table1",), "B", ("crazyem",), 3) == [Task("table1", "A", "filter", k) for k in range(3)]
    assert {t.method for t in plan(("offline",), "C", ("crazyem",), 1)} == {"bound", "crazyem"}


def faked(monkeypatch, task, *, mass_as_printed=0.18):
    """The record of a flight whose estimator says the truth, but for a mass where it is not clamped; what was asked."""
    sizes, made = [], []

    class Fake:
        def __init__(self, settings, sensor, *, clamp=False):
            made.append((sensor, clamp))
            self.mass = 0.18 if clamp else mass_as_printed

        def update(self, flight):
            sizes.append(flight.size)
            return self.mass, np.array([2.5e-4, 3.1e-4, 2.0e-4])

    monkeypatch.setattr(experiments, "PublishedOnline", Fake)
    return run_task(task, SMALL), sizes, made


def test_online_flight_feeds_back_what_the_estimator_says(monkeypatch):
    """From the first update on the controller knows the truth, as a flight by hand does."""
    record, sizes, made = faked(monkeypatch, Task("online", "B", "published", 3))
    by_hand = Flight(SMALL, 3)
    by_hand.advance(20, mass=0.001, inertia=(1e-4, 2e-4, 1e-4))
    by_hand.advance(SMALL.steps, mass=0.18, inertia=(2.5e-4, 3.1e-4, 2.0e-4))
    assert made == [("B", False)]
    assert sizes == list(range(21, SMALL.steps + 2, 20))
    step = max(1, SMALL.steps // experiments.PATH_POINTS)
    np.testing.assert_allclose(record["path"], by_hand.truth[::step, :3], atol=1e-4)
    assert record["times"]["mass_1"] == {"first": 0.1, "stays": 0.1}
    assert record["theta"] == [[0.18, 2.5e-4, 3.1e-4, 2.0e-4]] * 15
    known = fly(SMALL, 3)
    error = known.truth[150:, :3] - known.reference[150:, :3]
    assert record["tracking_rms_known_m"] == pytest.approx(np.sqrt(np.mean(np.sum(error**2, axis=1))), rel=1e-6)


def test_a_published_flight_that_crashes_is_flown_again_and_says_so(monkeypatch):
    record, _, made = faked(monkeypatch, Task("online", "A", "published", 0), mass_as_printed=-0.18)
    assert made == [("A", False), ("A", True)]
    assert record["crashed_as_printed_after_s"] > 0
    assert not record["crashed"]
    assert len(record["windows"]) == 1


def test_times_are_the_first_and_the_last_crossing() -> None:
    theta = np.tile([0.18, 2.5e-4, 3.1e-4, 2.0e-4], (6, 1))
    theta[:, 0] *= [0.01, 1.04, 1.2, 1.04, 1.005, 1.0]
    theta[5, 3] = np.nan
    found = experiments._times(theta, replace(Settings(), every=4))
    assert found["mass_5"] == {"first": 0.04, "stays": 0.08}
    assert found["mass_1"] == {"first": 0.1, "stays": 0.1}
    assert found["Ixx_25"] == {"first": 0.02, "stays": 0.02}
    assert found["Izz_25"] == {"first": 0.02, "stays": None}
