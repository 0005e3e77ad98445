"""The flight loop against a fake drone: the order of things, and every way out of a flight."""

import threading
import time

import fake_drone as fake
import pytest

from crazyem.control.trajectories import excite, hover
from crazyem.errors import CrazyemError, DataError, LinkError, UsageError
from crazyem.live.controllers import LEE, LQG
from crazyem.live.flight import Flight, FlightInterruptedError, FlightPlan, Interrupts, MotorsCutError
from crazyem.live.session import Session
from crazyem.live.summary import build_summary
from crazyem.signals.vocabulary import block_plan
from crazyem.vehicle import load_vehicle


class ListRecorder:
    path = "flight.mcap"

    def __init__(self):
        self.items = []

    def __getattr__(self, name):
        return lambda *a: self.items.append((name, a))


def plan(kind=excite, duration=10.0, **kw):
    def make(position, yaw):
        return kind(position=position, yaw=yaw, duration=duration)

    return FlightPlan(trajectory=make, controller=kw.pop("controller", LEE), **kw)


class Run:
    def __init__(self, link, flight_plan, *, estimator=None, interrupt_at=()):
        self.link = link
        self.recorder = ListRecorder()
        self.session = Session(link, vehicle=load_vehicle("cf2"), estimator=estimator or fake.FakeEstimator(),
                               recorder=self.recorder)  # fmt: skip
        self.interrupts = Interrupts()
        self.phases = []
        self.flight = Flight(self.session, flight_plan, interrupts=self.interrupts)
        link.follow(self.session, self.flight)
        self.times = interrupt_at

    def __call__(self):
        self.session.start()
        for when in self.times:
            threading.Thread(target=self._interrupt, args=(when,), daemon=True).start()
        try:
            self.flight.fly()
        finally:
            self.session.close()
            self.link.close()

    def _interrupt(self, when):
        while self.link.fm < when:
            time.sleep(0.001)
        self.interrupts()


def order(link):
    """Calls without repeats."""
    return [c for i, c in enumerate(link.calls) if i == 0 or link.calls[i - 1] != c]


def landed(link):
    return not link.motors and link.height < 0.3


def test_a_whole_flight_pushes_and_lands():
    link = fake.FakeLink()
    run = Run(link, plan(hover, duration=25.0))
    run()
    assert order(link) == ["release", "take_off", "setpoint", *3 * ["land", "release"], "stop"]
    assert landed(link)
    assert link.values["stabilizer.controller"] == 5
    assert link.values["ctrlLee.mass"] == pytest.approx(0.036, rel=0.005)
    history = run.session.history
    assert history.pushes
    assert all(p.verified for p in history.pushes)
    assert min(p.time for p in history.pushes) >= history.marks["push_enabled"]
    rms, height = history.before_and_after()
    assert height["before_push"] == pytest.approx(-0.3, abs=0.02)
    assert abs(height["after_push"]) < 0.02
    assert rms["after_push"] < rms["before_push"] / 2
    kinds = {k for k, _ in run.recorder.items}
    assert {"blocks", "packet", "setpoint", "parameter_write", "estimate", "event"} <= kinds
    summary = build_summary(log=None, vehicle="cf2", estimate=run.session.pipeline.finish(), history=history,
                            update_seconds=[1e-4], received=1, lost=0)  # fmt: skip
    assert set(summary) >= {"log", "vehicle", "estimates", "pushes", "updates", "update_ms", "samples",
                            "tracking_rms_m"}  # fmt: skip


def test_without_push_nothing_but_the_controller_choice_is_written():
    link = fake.FakeLink()
    Run(link, plan(push=False, duration=5.0))()
    assert link.values["ctrlLee.mass"] == 0.029
    assert link.writes == 0
    assert landed(link)


def test_arms_a_drone_that_is_not():
    link = fake.FakeLink()
    link.armed = False
    Run(link, plan(duration=2.0))()
    assert link.calls[0] == "arm"


def test_an_unconfirmed_write_ends_pushing_but_not_the_flight():
    link = fake.FakeLink(lose_echo_after=2)
    run = Run(link, plan(hover, duration=8.0))
    run()
    pushes = run.session.history.pushes
    assert [p.verified for p in pushes] == [True, True, False, False]
    assert pushes[3].purpose == "undo"  # of the half-written set: tried, and reported
    assert pushes[3].parameter == pushes[0].parameter == "ctrlLee.mass"
    assert any("not confirmed" in n for n in run.session.history.notices)
    assert landed(link)


def test_a_controller_the_firmware_does_not_have_is_refused_on_the_ground():
    link = fake.FakeLink(controllers=(1, 5))
    with pytest.raises(UsageError, match="does not have the controller 'lqg'"):
        Run(link, plan(controller=LQG))()
    assert "take_off" not in link.calls


def test_a_path_that_cannot_be_flown_is_found_before_take_off():
    def bad(position, yaw):
        raise UsageError("no.")

    link = fake.FakeLink()
    with pytest.raises(UsageError, match="no"):
        Run(link, FlightPlan(trajectory=bad, controller=LEE))()
    assert "take_off" not in link.calls


def test_first_interrupt_lands():
    link = fake.FakeLink()
    with pytest.raises(FlightInterruptedError):
        Run(link, plan(duration=60.0), interrupt_at=(8000,))()
    assert order(link)[-3:] == ["land", "release", "stop"]
    assert landed(link)


def test_second_interrupt_cuts():
    link = fake.FakeLink()
    with pytest.raises(MotorsCutError):
        Run(link, plan(duration=60.0), interrupt_at=(8000, 8400))()
    assert link.calls[-1] == "stop"
    assert not link.motors


def test_drone_lost_in_flight_is_one_sentence():
    link = fake.FakeLink(lost_at=8000)
    with pytest.raises(LinkError, match=r"fake://0 was lost: the link closed; the recording flight.mcap is intact"):
        Run(link, plan(duration=60.0))()


def test_nan_in_a_log_lands_and_names_the_variable():
    link = fake.FakeLink(nan_at=8000)
    with pytest.raises(DataError, match=r"acc\.z is nan"):
        Run(link, plan(duration=60.0))()
    assert landed(link)


def test_a_failing_estimator_lands_the_drone():
    link = fake.FakeLink()
    with pytest.raises(CrazyemError, match="estimating failed"):
        Run(link, plan(duration=60.0), estimator=fake.FakeEstimator(error=ValueError("boom")))()
    assert landed(link)


def test_a_log_variable_that_is_missing_is_named():
    with pytest.raises(UsageError, match=r"no log variable motor\.m1"):
        block_plan([v for v in fake.FakeLink().log_variables if v != "motor.m1"])


def test_blocks_fit_a_packet():
    sizes = {"stateEstimateZ.quat": 4, "acc": 4, "gyro": 4, "ctrlLee": 4}
    for block in block_plan([*fake.FakeLink().log_variables, *(f"motor.m{i}_rpm" for i in range(1, 5))]):
        assert sum(sizes.get(v, sizes.get(v.split(".")[0], 2)) for v in block) <= 26
