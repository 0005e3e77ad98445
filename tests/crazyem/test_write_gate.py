"""Writes only in the air: what the gate lets pass, what becomes of a set it interrupts, and every way out of a session.

The drone here is a script on a clock of its own: time passes when the test says so, and no test sleeps for it.
"""

import math
import time
from types import SimpleNamespace

import fake_drone as fake
import pytest
from fake_flight import FakeFlight
from test_live_push import NOMINAL, ORIGINALS, Drone, a_set

from crazyem.live.attach import Attachment
from crazyem.live.controllers import LEE
from crazyem.live.guard import Decision, Guard
from crazyem.live.history import History
from crazyem.live.policy import EndRules, Policy, WriteRules
from crazyem.live.push import Pusher
from crazyem.live.session import Session
from crazyem.live.telemetry import FLYING, Telemetry
from crazyem.live.write_gate import FRESH_TELEMETRY_SECONDS as FRESH
from crazyem.live.write_gate import WriteGate
from crazyem.signals.sample import Sample
from crazyem.vehicle import load_vehicle


def at(height, *, flying=True, duty=0.5, telemetry=None, heard=10.0):
    """Telemetry after one more instant."""
    telemetry = telemetry or Telemetry()
    telemetry.info, telemetry.heard = FLYING if flying else 0, heard
    telemetry.take(Sample("motor_command", 0.0, (duty,) * 4))
    telemetry.take(Sample("position", 0.0, (0.0, 0.0, height)))
    return telemetry


def flown():
    """Telemetry of a drone that took off from 0.3 m and is 1 m above that."""
    return at(1.3, telemetry=at(0.3, flying=False, duty=0.0))


# --- the gate -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("purpose", ["push", "undo", "revert"])
def test_what_belongs_into_the_air_passes_there_and_nowhere_else(purpose):
    telemetry = flown()
    gate = WriteGate(telemetry, now=lambda: 10.0)
    assert gate.objection(purpose) == ""
    at(0.32, telemetry=telemetry)  # down again, rotors turning, and the firmware says that it flies
    assert gate.objection(purpose) == "the drone is not in the air"
    at(1.3, telemetry=telemetry)
    assert gate.objection(purpose) == ""
    at(0.8, duty=0.0, telemetry=telemetry)  # landed on something: the firmware says for 2 s more that it flies
    assert gate.objection(purpose) != ""
    at(1.3, telemetry=telemetry)
    gate.motors_cut = True  # telemetry says that it flies, for 0.3 s or so
    assert gate.objection(purpose) == "the motors were cut"
    gate.motors_cut = False
    at(1.3, flying=False, telemetry=telemetry)
    assert gate.objection(purpose) != ""


@pytest.mark.parametrize(
    ("above", "climb", "passes"),
    [
        (0.3, -0.5, True), (0.15, -0.5, False), (0.15, 0.0, True), (0.15, 0.5, True), (0.6, -2.5, False),
        (0.6, math.nan, True),
    ],
)  # fmt: skip
def test_nothing_is_sent_to_a_drone_that_is_down_when_it_arrives(above, climb, passes):
    """0.3 s at its present descent: telemetry is late, and so is a write."""
    telemetry = at(0.3 + above, telemetry=flown())
    telemetry.take(Sample("velocity", 0.0, (0.0, 0.0, climb)))
    gate = WriteGate(telemetry, now=lambda: 10.0)
    assert gate.objection("push") == ("" if passes else "the drone is about to land")


def test_values_are_put_back_on_the_ground_only():
    gate = WriteGate(flown(), now=lambda: 10.0)
    assert gate.objection("restore") == "the drone still flies"
    at(0.3, flying=False, duty=0.0, telemetry=gate.telemetry)
    assert gate.objection("restore") == ""


@pytest.mark.parametrize(("later", "rate", "fresh"), [(0.9 * FRESH, 1.0, True), (1.1 * FRESH, 1.0, False),
                                                      (0.5 * FRESH, 3.0, False), (-60.0, 1.0, False)])  # fmt: skip
@pytest.mark.parametrize("purpose", ["push", "restore"])
def test_old_telemetry_lets_nothing_pass(later, rate, fresh, purpose):
    """On the drone's clock, which may run fast; and not where the host's clock was set back."""
    telemetry = flown() if purpose == "push" else at(0.0, flying=False)
    gate = WriteGate(telemetry, rate=lambda: rate, now=lambda: 10.0 + later)
    assert (gate.objection(purpose) == "") is fresh


def test_nothing_passes_before_anything_was_heard():
    assert WriteGate(Telemetry()).objection("push") == "no telemetry comes"


def test_rotors_that_stop_in_a_fall_do_not_make_that_height_the_ground():
    telemetry = flown()
    at(1.2, duty=0.0, telemetry=telemetry)
    assert not telemetry.airborne
    at(1.1, telemetry=telemetry)
    assert telemetry.airborne


# --- a set that the gate interrupts ---------------------------------------------------------------------------------


def written_through(gate, drone, monkeypatch, decision=None):
    """What became of one set: guard, history, reasons."""
    for name, seconds in (("RETRY_PAUSE", 0.001), ("TELEMETRY_POLL", 0.001)):
        monkeypatch.setattr(f"crazyem.live.push.{name}", seconds)
    guard, history, said = Guard(LEE, nominal=NOMINAL, originals=ORIGINALS), History(), []
    pusher = Pusher(drone, guard, gate=gate, history=history, timeout=0.005, known=ORIGINALS,
                    on_done=lambda d, why: said.append(why))  # fmt: skip
    pusher.submit(decision or a_set())
    pusher.close()
    return guard, history, said, pusher


def closes_after(count, *, stale="", misplaced=""):
    """A gate that lets `count` writes pass."""
    asked = []

    def stale_now():
        asked.append(1)
        return stale if len(asked) > count else ""

    return SimpleNamespace(stale=stale_now, misplaced=lambda purpose: misplaced if len(asked) > count else "")


@pytest.mark.parametrize("reason", [{"stale": "old"}, {"misplaced": "down"}])
def test_a_set_of_which_nothing_passed_is_dropped_and_decided_anew(reason, monkeypatch):
    drone = Drone()
    guard, history, said, _ = written_through(closes_after(0, **reason), drone, monkeypatch)
    assert drone.attempts == 0
    assert history.pushes == []
    assert said == list(reason.values())
    assert not guard.stopped


def test_a_drone_that_lands_within_a_set_gets_nothing_more_of_it(monkeypatch):
    drone = Drone()
    guard, history, said, pusher = written_through(closes_after(3, misplaced="down"), drone, monkeypatch)
    assert drone.log == list(a_set().writes[:3])
    assert said == ["down"]
    assert "was not sent (down)" in guard.stopped
    assert all(p.verified for p in history.pushes)
    assert pusher.known == drone.values  # so it is known what is in the drone
    assert any("could not be written back (down): it stays" in n for n in history.notices)


def test_a_set_waits_for_telemetry_that_comes_back(monkeypatch):
    drone, ages = Drone(), iter([0.0] * 4 + [1.0] * 3 + [0.0] * 50)
    gate = WriteGate(flown(), now=lambda: 10.0 + next(ages))
    guard, _, said, _ = written_through(gate, drone, monkeypatch)
    assert said == [""]
    assert drone.log == list(a_set().writes)
    assert not guard.stopped


def test_a_repetition_passes_the_gate_as_well(monkeypatch):
    """The echo of the second write stays away, and the drone lands: the write is not sent again."""
    drone = Drone(lambda n: n >= 2)
    guard, _, said, pusher = written_through(closes_after(2, misplaced="down"), drone, monkeypatch)
    assert drone.attempts == 2
    assert said == ["down"]
    assert math.isnan(pusher.known[a_set().writes[1][0]])
    assert "not confirmed" in guard.stopped


# --- every way out --------------------------------------------------------------------------------------------------


class Script(fake.FakeLink):
    """A drone that somebody else flies: `pass_time` is its only clock."""

    def __init__(self):
        super().__init__()
        self.sent = []

    def subscribe(self, variables, rate_hz):
        self._thread = self  # so that none is started
        return super().subscribe(variables, rate_hz)

    def close(self):
        pass

    def write_parameter(self, name, value, timeout=1.0):
        self.sent.append((self.fm, self.motors and self.height > 0.05))
        return super().write_parameter(name, value, timeout)

    def pass_time(self, session, seconds, *, height, motors=True):
        """Samples of each 10 ms, taken in before the next come; it rises and sinks by 4 m/s at most."""
        self.motors = motors
        for _ in range(round(100 * seconds)):
            self.fm += 10
            self.height += max(-0.04, min(height - self.height, 0.04))
            for block in self.blocks:
                values = tuple(self.value(v.name) for v in block.variables)
                self.packets.put(fake.Packet(block.identifier, self.fm, self.host_clock(), values))
            self.until(lambda: session.clock.newest >= self.fm / 1000.0 and self.packets.empty())
            self.until(lambda: session.pusher is None or not session.pusher.busy)

    def until(self, true):
        end = time.monotonic() + fake.PATIENCE
        while not true() and time.monotonic() < end:
            time.sleep(0.0002)


class Behind(fake.FakeEstimator):
    """Keeps up until the flight has lasted `until` s; what comes later it works off only when the session closes."""

    def __init__(self, until):
        super().__init__()
        self.until, self.session = until, None

    def feed(self, sample):
        if sample.time > self.until:
            end = time.monotonic() + fake.PATIENCE
            while not self.session._closed and time.monotonic() < end:
                time.sleep(0.0005)
        return super().feed(sample)


def attached(behind_after):
    """An attachment with pushing, as `crazyem.attach` makes it, its drone in the air for a second."""
    link, estimator = Script(), Behind(behind_after)
    link.values["stabilizer.controller"] = 5.0
    session = Session(link, vehicle=load_vehicle("cf2"), estimator=estimator)
    estimator.session = session
    session.start()
    session.push_to_controller()
    session.pipeline.push_from = -math.inf
    link.pass_time(session, 0.5, height=0.0, motors=False)
    return link, Attachment(session)


@pytest.mark.parametrize("way", ["left in the air", "left on the ground", "exception", "Ctrl-C", "lost link"])
def test_an_attachment_whose_estimator_is_behind_writes_nothing_once_it_is_left(way):
    link, attachment = attached(behind_after=3.5)
    session = attachment.session
    errors = {"exception": ValueError("of the script"), "Ctrl-C": KeyboardInterrupt()}
    try:
        with attachment:
            link.pass_time(session, 4.0, height=1.0)
            link.until(lambda: not session._samples.empty())
            assert session.history.pushes == [] or all(air for _, air in link.sent)
            if way == "left on the ground":
                link.pass_time(session, 0.5, height=0.0)  # the firmware still says that it flies
            elif way == "lost link":
                link.packets.put(fake.LinkLost("gone.", link.host_clock()))
                link.until(lambda: session.lost is not None)
                assert session.write_supervisor.gate.objection("push")  # at once, also within a set
            before = len(link.sent)
            if way in errors:
                raise errors[way]
    except (ValueError, KeyboardInterrupt):
        pass
    assert session.pipeline.estimator.time > 3.5  # what waited was worked off
    assert len(link.sent) == before
    assert all(air for _, air in link.sent)


def test_an_attachment_that_keeps_up_does_write():
    link, attachment = attached(behind_after=math.inf)
    with attachment:
        for _ in range(12):
            link.pass_time(attachment.session, 0.25, height=1.0)
            link.until(attachment.session._samples.empty)
    assert link.sent
    assert all(air for _, air in link.sent)
    assert link.values["ctrlLee.mass"] == pytest.approx(0.036, rel=0.01)


def test_an_estimator_that_catches_up_on_the_ground_writes_nothing():
    """The session goes on after the landing, and so do telemetry and estimates of the flight."""
    link, attachment = attached(behind_after=3.5)
    with attachment:
        session = attachment.session
        link.pass_time(session, 4.0, height=1.0)
        link.pass_time(session, 0.2, height=0.0)
        before = len(link.sent)
        session.pipeline.estimator.until = math.inf
        session._closed = True  # what the estimator waits for
        link.until(lambda: session._samples.empty() and not session.pusher.busy)
        session._closed = False
        assert len(link.sent) == before


class Watched(fake.FakeLink):
    """Notes of each write to the controller whether the drone was in the air."""

    def __init__(self, **options):
        super().__init__(**options)
        self.sent = []

    def write_parameter(self, name, value, timeout=1.0):
        if name.startswith("ctrl"):
            self.sent.append(self.motors and self.height > 0.05)
        return super().write_parameter(name, value, timeout)


@pytest.mark.parametrize(
    ("way", "outcome"),
    [("landed", "landed"), ("first Ctrl-C", "interrupted"), ("second Ctrl-C", "interrupted"),
     ("estimator fails", "failed"), ("link lost", "link_lost")],
)  # fmt: skip
def test_a_flight_writes_in_the_air_only_and_restores_on_the_ground(way, outcome):
    link = Watched(speed=40.0, lost_at=9000 if way == "link lost" else None)
    rules = WriteRules(Policy(end=EndRules(*["restore"] * 4)))
    flown = FakeFlight(link, duration=4.0, rules=rules)
    write = link.write_parameter

    def write_and_end(name, value, timeout=1.0):
        if name == "ctrlLee.mass":
            flown.interrupts.count = {"first Ctrl-C": 1, "second Ctrl-C": 2}.get(way, 0)
            flown.estimator.fail_at = 0 if way == "estimator fails" else None  # the next sample
        return write(name, value, timeout)

    link.write_parameter, stop, cut = write_and_end, link.stop, []

    def stop_motors():
        cut.append(flown.session.write_supervisor.gate.motors_cut)
        stop()

    link.stop = stop_motors
    assert (flown.fly().error is None) is (way == "landed")
    pushes = [p.purpose for p in flown.history.pushes]
    assert "push" in pushes
    assert len(link.sent) == len(pushes)
    for purpose, air in zip(pushes, link.sent, strict=True):
        assert air is (purpose != "restore")
    assert ("restore" in pushes) is (way != "link lost")
    if way == "link lost":
        assert any("were not written back: no telemetry comes" in n for n in flown.history.notices)
    else:
        before = flown.history.guard["at_connect"]
        assert {name: link.values[name] for name in before} == pytest.approx(before, rel=1e-6)
        asked = [d["reason"] for d in flown.history.guard["decisions"] if d["action"] == "restore"]
        assert asked == [f"{outcome}: restore"]
    assert cut[0] is (way in ("second Ctrl-C", "link lost"))  # known before the motors stop, not 0.3 s after


def test_a_decision_that_comes_after_the_end_is_dropped():
    """One that the estimating thread had in hand when pushing was stopped."""
    link, attachment = attached(behind_after=math.inf)
    with attachment:
        session = attachment.session
        link.pass_time(session, 1.0, height=1.0)
        session.stop_pushing()
        before = len(link.sent)
        session.pusher.submit(Decision(1.0, writes=(("ctrlLee.mass", 0.035),)))
        link.until(lambda: not session.pusher.busy)
        assert len(link.sent) == before
    assert session.history.guard["stopped"] == ""  # an end is no reason worth telling
