"""The flight loop against a fake drone: the order of things, and every way out of a flight."""

import time
from types import SimpleNamespace

import pytest
from fake_drone import FakeEstimator, FakeLink
from fake_flight import FakeFlight

from crazyem.errors import CrazyemError, DataError, LinkError, UsageError
from crazyem.live.controllers import LQG
from crazyem.live.flight import FlightInterruptedError, MotorsCutError


def order(link):
    """Calls without repeats."""
    return [c for i, c in enumerate(link.calls) if i == 0 or link.calls[i - 1] != c]


def landed(link):
    return not link.motors and link.height < 0.3


def test_a_whole_flight_pushes_and_lands():
    link = FakeLink()
    flown = FakeFlight(link, duration=25.0).fly()
    assert flown.error is None
    assert order(link) == ["release", "take_off", "setpoint", *3 * ["land", "release"], "stop"]
    assert landed(link)
    assert link.values["stabilizer.controller"] == 5
    assert link.values["ctrlLee.mass"] == pytest.approx(0.036, rel=0.005)
    history = flown.history
    assert history.pushes
    assert all(p.verified for p in history.pushes)
    assert min(p.time for p in history.pushes) >= history.marks["push_enabled"]
    rms, height = history.before_and_after()
    assert height["before_push"] == pytest.approx(-0.3, abs=0.02)
    assert abs(height["after_push"]) < 0.02
    assert rms["after_push"] < rms["before_push"] / 2
    kinds = {kind for kind, _ in flown.recorder.calls}
    assert {"blocks", "packet", "setpoint", "parameter_write", "estimate", "event"} <= kinds


def test_without_push_nothing_but_the_controller_choice_is_written():
    link = FakeLink()
    FakeFlight(link, push=False, duration=5.0).fly()
    assert link.values["ctrlLee.mass"] == 0.029
    assert link.writes == 0
    assert landed(link)


def test_arms_a_drone_that_is_not():
    link = FakeLink()
    link.armed = False
    FakeFlight(link, duration=2.0).fly()
    assert link.calls[0] == "arm"


def test_an_unconfirmed_write_ends_pushing_but_not_the_flight():
    flown = FakeFlight(FakeLink(lose_echo_after=2), duration=8.0).fly()
    pushes = flown.history.pushes
    assert [p.verified for p in pushes] == [True, True, False, False]
    assert pushes[3].purpose == "undo"  # of the half-written set: tried, and reported
    assert pushes[3].parameter == pushes[0].parameter == "ctrlLee.mass"
    assert any("not confirmed" in n for n in flown.history.notices)
    assert flown.error is None
    assert landed(flown.link)


def test_a_silent_drone_is_lost(monkeypatch):
    monkeypatch.setattr("crazyem.live.flight.LOST_AFTER_SILENCE", 0.3)
    flown = FakeFlight(FakeLink(silent_at=8000), duration=60.0).fly()
    assert isinstance(flown.error, LinkError)
    assert "nothing was received for 0.3 s" in str(flown.error)


def test_silence_counts_in_the_time_of_the_link(monkeypatch):
    """A simulated drone that waits for this process is not silent."""
    flown = FakeFlight(FakeLink(), duration=2.0).fly()
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + 60.0)
    monkeypatch.setattr("crazyem.live.flight.time", clock)
    flown.flight._watch()
    monkeypatch.setattr(flown.link, "fm", flown.link.fm + 60_000 * flown.link.speed)
    with pytest.raises(LinkError, match="nothing was received"):
        flown.flight._watch()


def bad_trajectory(**_):
    raise UsageError("no such path.")


@pytest.mark.parametrize(
    ("link", "options", "says"),
    [
        ({"controllers": (1, 5)}, {"controller": LQG}, "does not have the controller 'lqg'"),
        ({}, {"trajectory": bad_trajectory}, "no such path"),
    ],
)
def test_what_cannot_be_flown_is_refused_on_the_ground(link, options, says):
    flown = FakeFlight(FakeLink(**link), **options).fly()
    assert isinstance(flown.error, UsageError)
    assert says in str(flown.error)
    assert "take_off" not in flown.link.calls


@pytest.mark.parametrize(
    ("link", "interrupt", "fail_at", "error", "says"),
    [
        ({}, (11000,), None, FlightInterruptedError, ""),
        ({}, (11000, 11300), None, MotorsCutError, ""),
        ({"lost_at": 8000}, (), None, LinkError, "fake://0 was lost: the link closed; the recording flight.mcap is in"),
        ({"nan_at": 8000}, (), None, DataError, "acc.z is nan"),
        ({}, (), 300, CrazyemError, "estimating failed"),
    ],
    ids=["first interrupt", "second interrupt", "link lost", "NaN in a log", "estimator fails"],
)
def test_what_ends_a_flight_is_named_and_the_drone_lands_or_is_cut(link, interrupt, fail_at, error, says):
    flown = FakeFlight(FakeLink(**link), FakeEstimator(fail_at=fail_at), duration=60.0, interrupt=interrupt).fly()
    assert type(flown.error) is error
    assert says in str(flown.error)
    assert flown.link.calls[-1] == "stop"
    assert not flown.link.motors
    if interrupt:  # what was pushed is kept, by default
        assert flown.link.values["ctrlLee.mass"] > 0.03
    if error not in (MotorsCutError, LinkError):
        assert order(flown.link)[-3:] == ["land", "release", "stop"]
        assert landed(flown.link)
