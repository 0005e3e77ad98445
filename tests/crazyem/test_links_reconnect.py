"""Outages in flight: the window is kept, the recording goes on, writes are made up for, and a fall is told as one."""

import itertools
import math
import re
import time

import fake_drone as fake
import numpy as np
import pytest
from relayed import down, now_on, relayed, up

from crazyem.control.trajectories import excite, hover
from crazyem.errors import CrazyemError, LinkError
from crazyem.estimation.online import OnlineEstimator
from crazyem.links.base import AnotherDroneError, LinkLost, LinkStatistics, Outage, link_account
from crazyem.links.crazyflie import CrazyflieLink
from crazyem.live.controllers import LEE
from crazyem.live.flight import Flight, FlightPlan
from crazyem.live.history import open_recorder
from crazyem.live.scheduler import Scheduler
from crazyem.live.session import Session
from crazyem.recordings import open_recording
from crazyem.vehicle import load_vehicle


class LosingLink(fake.FakeLink):
    """A FakeLink that is gone for a while, once, and comes back if it is asked to."""

    def __init__(self, *, gone_at=7000, comes_back=True, **options):
        super().__init__(**options)
        self.gone_at, self.comes_back = gone_at, comes_back
        self.gone, self.can_reconnect, self.refused = False, True, 0

    def send(self, packet):
        if self.gone_at is not None and self.fm > self.gone_at:
            self.gone_at, self.gone = None, True
            self.packets.put(LinkLost("it was away.", self.host_clock()))
        if not self.gone:
            self.packets.put(packet)

    def write_parameter(self, name, value, timeout=1.0):
        if self.gone:
            self.refused += 1
            raise LinkError("the link is lost.")
        return super().write_parameter(name, value, timeout)

    def send_full_state(self, *a):
        if self.gone:
            raise LinkError("the link is lost.")
        super().send_full_state(*a)

    def reconnect(self, timeout, abort):
        before = self.fm
        time.sleep(0.1)
        if not self.comes_back:
            raise LinkError("The drone did not come back.")
        self.gone = False
        return Outage("it was away.", 0.1, float(before), float(self.fm), 0)


@pytest.fixture(params=["a session's own threads", "a scheduler's"])
def scheduler(request):
    """One drone among others is received by the thread that receives for all; it must outlive an outage as well."""
    one = Scheduler(2) if request.param == "a scheduler's" else None
    yield one
    if one is not None:
        one.close()


def plan_of(kind, duration):
    return FlightPlan(lambda position, yaw: kind(position=position, yaw=yaw, duration=duration), LEE)


def fly(link, kind=excite, duration=8.0, scheduler=None):
    """The session of a flight, and what ended it early."""
    session = Session(link, vehicle=load_vehicle("cf2"), estimator=fake.FakeEstimator(), scheduler=scheduler)
    session.start()
    error = None
    try:
        Flight(session, plan_of(kind, duration)).fly()
    except LinkError as e:
        error = e
    finally:
        session.close()
        link.close()
    return session, error


def test_a_flight_goes_on_after_an_outage(scheduler):
    link = LosingLink(speed=5.0)
    session, error = fly(link, scheduler=scheduler)
    assert error is None
    assert [o.reason for o in session.outages] == ["it was away."]
    assert session.lost is None
    assert any("was gone for 0.1 s" in n for n in session.history.notices)
    assert link.calls[-1] == "stop"
    assert "land" in link.calls
    times = [e.time for e in session.history.estimates]
    assert min(times) < session.outages[0].before_ms / 1000 < session.outages[0].after_ms / 1000 < max(times)
    assert [e.samples for e in session.history.estimates] == sorted(e.samples for e in session.history.estimates)


@pytest.mark.parametrize(
    ("can_reconnect", "message"),
    [(True, r"^the drone at fake://0 was lost: it was away; the drone did not come back\.$"),
     (False, r"was lost: it was away\.$")],
    ids=["it stays away", "it cannot come back"],
)  # fmt: skip
def test_an_outage_that_lasts_ends_the_flight_in_one_sentence(scheduler, can_reconnect, message):
    link = LosingLink(speed=5.0, comes_back=False)
    link.can_reconnect = can_reconnect
    assert re.search(message, str(fly(link, scheduler=scheduler)[1]))


def test_after_a_restart_of_the_firmware_the_notes_agree(scheduler):
    """What was pushed is gone with the firmware that had it: nothing is called kept, put back or not put back."""
    link = LosingLink(speed=5.0, gone_at=None)
    write = link.write_parameter

    def write_and_restart(name, value, timeout=1.0):
        if name == "ctrlLee.mass" and value > 0.0359:
            link.gone_at = link.fm + 500
        return write(name, value, timeout)

    def another(timeout, abort):
        raise AnotherDroneError("The drone was restarted: what it knew of the flight is gone.")

    link.write_parameter, link.reconnect = write_and_restart, another
    session, error = fly(link, hover, 60.0, scheduler)
    assert "was restarted" in str(error)
    notes = session.history.notices
    assert [n for n in notes if "of its start" in n]
    assert not [n for n in notes if "put back" in n or "written back" in n or "may keep" in n]
    assert all(math.isnan(v) for v in session.history.guard["in_drone"].values())


def test_a_write_that_falls_into_an_outage_is_made_up_for(scheduler):
    """The first push finds the link gone; it is written when the link is back, and pushing goes on."""
    link = LosingLink(speed=5.0, gone_at=None)
    write = link.write_parameter

    def lost_with_the_first_push(name, value, timeout=1.0):
        if name == "ctrlLee.mass" and not link.refused:
            link.gone_at = 0
            while not link.gone:
                time.sleep(0.001)
        return write(name, value, timeout)

    link.write_parameter = lost_with_the_first_push
    session, error = fly(link, hover, scheduler=scheduler)
    assert error is None
    assert link.refused
    assert session.history.pushes
    assert all(p.verified for p in session.history.pushes)
    assert link.values["ctrlLee.mass"] == pytest.approx(0.036, rel=0.01)


def test_the_account_of_a_link():
    statistics = LinkStatistics(
        100, 3, 1, {0: (100, 3, 1)}, delays={0: (0.001, 0.02)}, round_trip=0.004, clock_offset=5.0, clock_rate=1.00001
    )
    account = link_account(statistics, [Outage("gone.", 2.0, 100.0, 2100.0, 0)])
    assert account["clock.drift_ppm"] == "10.000"
    assert account["round_trip_s"] == "0.004000"
    assert account["outage.0"] == "100 ms to 2100 ms: gone."
    assert account["block.0.packets"] == "100 received, 3 lost, 1 late"
    assert account["block.0.delay_s"] == "0.001000 median, 0.020000 99th percentile"


# --- the simulated firmware -----------------------------------------------------------------------------------------


def flown(uri, faults, *, path="", kind=excite, duration=9.0, at=0.0):
    """A flight through a relay, recorded at `path`, with faults from `at` s of its trajectory on: session and error."""
    vehicle, recorder, begun, error = load_vehicle("cf2"), None, [], None
    with relayed(uri) as relay:
        link = CrazyflieLink(relay.uri)
        link.connect(30.0)
        if path:
            recorder = open_recorder(str(path), configuration={}, vehicle=vehicle, link=link)
        session = Session(link, vehicle=vehicle, estimator=OnlineEstimator(vehicle), recorder=recorder)

        def progress(phase, seconds):
            if phase == kind.__name__ and not begun and seconds > at:
                begun.append(seconds)
                now_on(relay, *faults)

        try:
            session.start()
            Flight(session, plan_of(kind, duration), progress=progress).fly()
        except CrazyemError as e:
            error = e
        session.close()
        if recorder is not None:
            recorder.close()
        link.close()
        assert begun
        return session, error


@pytest.mark.slow
def test_setpoints_that_the_plan_to_land_overtakes_do_not_drop_the_drone(simulator):
    """Every setpoint is 0.1 s late, whatever else passes at once: the last ones arrive after the command to land.

    The firmware forgets a plan when a setpoint comes, and stops the motors when it is released without one.
    """
    late = up("reorder", rate=1.0, distance=100, kinds=("setpoint.generic",))
    session, error = flown(simulator("--seed", "5").uri, [late], kind=hover, duration=3.0)
    assert error is None
    track = session.history.track_array()
    time_, height = track[:, 0], track[:, 3]
    falling = (height[:-10] - height[10:]) / (time_[10:] - time_[:-10])
    assert height.max() > 0.5
    assert falling.max() < 1.2  # m/s over a tenth of a second; cut at 1 m it would come down with 4


@pytest.mark.slow
def test_deaf_for_three_seconds_in_flight(simulator, tmp_path):
    """Only the way down is lost: setpoints go on, the drone flies on, the window is kept, the recording too."""
    drone = simulator("--seed", "3")
    session, error = flown(drone.uri, [down("silence", end=3.0)], path=tmp_path / "f.mcap", at=2.0)
    assert error is None
    (outage,) = session.outages
    assert 2.5 < (outage.after_ms - outage.before_ms) / 1000 < 4.5
    final = session.pipeline.finish()
    before = [e for e in session.history.estimates if e.time <= outage.before_ms / 1000 + 0.1][-1]
    first = next(e for e in session.history.estimates if e.time > outage.after_ms / 1000)
    assert first.samples >= before.samples
    assert final["mass"].value == pytest.approx(0.029, rel=0.03)
    recording = open_recording(tmp_path / "f.mcap")
    time_ = recording.signals["position"].time
    gaps = [b - a for a, b in itertools.pairwise(time_) if b - a > 0.5]
    assert len(gaps) == 1
    assert time_[-1] > outage.after_ms / 1000 + 2.0
    assert any("came back" in str(e.data.get("message", "")) for e in recording.events)
    # The relation of the clocks describes the arrivals, whatever they were: a simulator denied the processor runs slow.
    link = recording.metadata["link"]
    arrival = recording.signals["position"].host_time
    assert float(link["clock.rate"]) == pytest.approx(np.polyfit(time_, arrival, 1)[0], abs=0.1)
    expected = float(link["clock.offset_s"]) + float(link["clock.rate"]) * time_[-100:]
    assert np.median(arrival[-100:] - expected) == pytest.approx(0.0, abs=0.5)


@pytest.mark.slow
def test_a_drone_that_heard_nothing_for_three_seconds_has_fallen(simulator):
    """The firmware cuts the motors two seconds after the last setpoint: no return undoes that, but we say so."""
    drone = simulator("--seed", "4")
    session, error = flown(drone.uri, [down("silence", end=3.5), up("silence", end=3.5)], at=1.0)
    assert len(session.outages) == 1
    assert "fell while the link was gone" in str(error)
    assert "locked" in str(error)
