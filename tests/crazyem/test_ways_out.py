"""Every way out of `watch` and of a swarm's flight: pushing ends before anything else, and nothing is written after."""

import contextlib
import os
import signal
import threading

import fake_drone as fake
import pytest
from test_write_gate import Behind, Script, Watched

from crazyem.cli import main
from crazyem.commands import swarm, watch
from crazyem.live import runner
from crazyem.live.flight import Flight
from crazyem.live.session import Session


class Autopilot(Script):
    """A drone that takes a hover thrust, flown by somebody else."""

    hover_parameter, onboard_hover_estimator, cells = "MPC_THR_HOVER", "", 1

    def __init__(self):
        super().__init__()
        self.uri = "mavlink:udpin:127.0.0.1:1"
        self.values[self.hover_parameter] = 0.5


class Watch:
    """`crazyem watch --push` of an `Autopilot` whose estimator falls behind after 3.5 s, and what ends it."""

    def __init__(self, monkeypatch, way):
        self.way, self.link, self.before = way, Autopilot(), None
        self.session, self.started, self.broken = None, threading.Event(), threading.Event()
        self.ended_at_view = None  # whether pushing had ended when the view was closed
        estimator = Behind(3.5)

        def make_session(*arguments, **options):
            self.session = estimator.session = Session(*arguments, **options)
            return self.session

        def follow(session, *arguments):
            self.started.set()
            if way == "exception":
                self.broken.wait(fake.PATIENCE)
                raise ValueError("of the command")
            watch_follow(session, *arguments)

        @contextlib.contextmanager
        def live_view(*_):
            try:
                yield lambda: True
            finally:
                self.ended_at_view = self.session.write_supervisor._ended.is_set()

        watch_follow = watch.follow
        monkeypatch.setattr(watch, "open_link", lambda uri: self.link)
        monkeypatch.setattr(runner, "open_link", lambda uri: self.link)
        monkeypatch.setattr(watch, "compile_kernels", lambda vehicle: None)
        monkeypatch.setattr(watch, "new_estimator", lambda vehicle, arguments, **_: estimator)
        monkeypatch.setattr(runner, "Session", make_session)
        monkeypatch.setattr(watch, "follow", follow)
        monkeypatch.setattr(watch, "live_view", live_view)

    def fly(self):
        """The one who flies: 4 s in the air, down where the way says so, then what ends the command."""
        assert self.started.wait(fake.PATIENCE)
        link, session = self.link, self.session
        link.pass_time(session, 0.5, height=0.0, motors=False)
        link.pass_time(session, 4.0, height=1.0)
        link.until(lambda: not session._samples.empty())
        if self.way == "Ctrl-C on the ground":
            link.pass_time(session, 0.5, height=0.0)  # the firmware still says that it flies
        self.before = len(link.sent)
        if self.way.startswith("Ctrl-C"):
            os.kill(os.getpid(), signal.SIGINT)
        elif self.way == "lost link":
            link.packets.put(fake.LinkLost("gone.", link.host_clock()))
        elif self.way == "receiver fails":
            link.packets.put(fake.Packet(0, link.fm + 10, link.host_clock(), ("no number",)))
        elif self.way == "duration":  # is over with the next packet, whenever the command began to count
            link.packets.put(fake.Packet(9, link.fm + 60_000, link.host_clock(), ()))
        else:
            self.broken.set()

    def run(self):
        """Exit code, or the exception."""
        pilot = threading.Thread(target=self.fly)
        pilot.start()
        duration = ["--duration", "60"] if self.way == "duration" else []
        try:
            return main(["watch", self.link.uri, "--push", "--no-live", *duration])
        except ValueError as error:
            return str(error)
        finally:
            pilot.join()


@pytest.mark.parametrize(
    ("way", "code"),
    [("Ctrl-C", 0), ("Ctrl-C on the ground", 0), ("duration", 0), ("lost link", 4), ("receiver fails", 1),
     ("exception", "of the command")],
)  # fmt: skip
def test_a_watch_whose_estimator_is_behind_writes_nothing_once_it_is_left(monkeypatch, way, code):
    watched = Watch(monkeypatch, way)
    assert watched.run() == code
    assert watched.ended_at_view
    assert watched.session.pipeline.estimator.time > 3.5  # what waited was worked off
    assert 0 < watched.before == len(watched.link.sent)
    assert all(air for _, air in watched.link.sent)


@pytest.mark.parametrize("way", ["landed", "first Ctrl-C", "second Ctrl-C", "estimator fails", "link lost"])
def test_a_swarm_writes_in_the_air_only_and_begins_no_set_once_it_is_left(monkeypatch, capsys, way):
    links = {f"fake://{i}": Watched(speed=40.0) for i in range(2)}
    everyone, sessions = [], []
    sets = dict.fromkeys(links, 0)  # sets of writes that were begun

    def caught(interrupts):
        everyone.append(real(interrupts))
        return everyone[0]

    def make_session(link, **options):
        sessions.append(Session(link, **options))
        return sessions[-1]

    def make_flight(session, plan, **options):
        flight = Flight(session, plan, **options)
        session.link.follow(session, flight)
        return flight

    def leave(link, session):
        if way in ("first Ctrl-C", "second Ctrl-C") and not any(i.count for i in everyone[0].ones):
            everyone[0]()
            if way == "second Ctrl-C":
                everyone[0]()
        elif way == "estimator fails":
            session.pipeline.estimator.inner.fail_at = 0
        elif way == "link lost":
            link.lost_at = link.fm

    def writes(link):
        write = link.write_parameter

        def counted(name, value, timeout=1.0):
            if name == "ctrlLee.mass" and link.motors:  # no restore, which is on the ground
                sets[link.uri] += 1
                if sets[link.uri] == 2:
                    leave(link, next(s for s in sessions if s.link is link))
            return write(name, value, timeout)

        return counted

    real = swarm.SwarmInterrupts
    for i, link in enumerate(links.values()):
        link.uri, link.wanted, link.write_parameter = f"fake://{i}", (float(i), 0.0, 0.0), writes(link)
    monkeypatch.setattr(swarm, "SwarmInterrupts", caught)
    monkeypatch.setattr(runner, "open_link", links.__getitem__)
    monkeypatch.setattr(swarm, "compile_kernels", lambda vehicle: None)
    monkeypatch.setattr(swarm, "new_estimator", lambda vehicle, arguments, **_: fake.FakeEstimator())
    monkeypatch.setattr(runner, "Session", make_session)
    monkeypatch.setattr(swarm, "Flight", make_flight)
    code = main(["fly", "--uri", "fake://0", "--uri", "fake://1", "--duration", "6", "--push", "--no-live"])
    assert code == {"landed": 0, "first Ctrl-C": 130, "second Ctrl-C": 130, "estimator fails": 1, "link lost": 4}[way]
    for session in sessions:
        link, purposes = session.link, [p.purpose for p in session.history.pushes]
        assert [purpose != "restore" for purpose in purposes] == link.sent  # whether in the air
        assert sets[link.uri] == 2 or "Ctrl-C" in way  # which is for all, also for one that had less time
        assert (link.calls[-1], link.motors) == ("stop", False)
    if "Ctrl-C" in way:
        assert capsys.readouterr().out.count("motors cut" if "second" in way else "landed on request") == 2
    assert max(sets.values()) == 2 or way == "landed"
