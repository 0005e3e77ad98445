"""A flight of `fake_drone` from connect to close, whatever ends it, and what was recorded of it."""

import json
import threading
import time

import fake_drone as fake

from crazyem.control.trajectories import hover
from crazyem.errors import CrazyemError
from crazyem.live.controllers import LEE
from crazyem.live.flight import Flight, FlightInterruptedError, FlightPlan, Interrupts, MotorsCutError
from crazyem.live.session import Session
from crazyem.live.summary import build_summary, text_summary
from crazyem.vehicle import load_vehicle


class Recorder:
    """Remembers each call as (name, arguments)."""

    def __init__(self, path="flight.mcap"):
        self.path, self.failure, self.calls = path, "", []

    def __getattr__(self, name):
        return lambda *arguments: self.calls.append((name, arguments))

    def all(self, name):
        """The first argument of each call of this name."""
        return [arguments[0] for called, arguments in self.calls if called == name]


class FakeFlight:
    """A flight of `duration` s; Ctrl-C comes at the ms `interrupt` of firmware time. `plan`: see `FlightPlan`."""

    def __init__(self, link, estimator=None, *, trajectory=hover, duration=10.0, controller=LEE, interrupt=(), **plan):
        self.link, self.recorder, self.error = link, Recorder(), None
        self.estimator = estimator or fake.FakeEstimator()
        self.session = Session(link, vehicle=load_vehicle("cf2"), estimator=self.estimator, recorder=self.recorder)
        self.history = self.session.history

        def path(position, yaw):
            return trajectory(position=position, yaw=yaw, duration=duration)

        self.interrupts, self._interrupt = Interrupts(), interrupt
        self.flight = Flight(self.session, FlightPlan(path, controller, **plan), interrupts=self.interrupts)
        link.follow(self.session, self.flight)

    def fly(self):
        """From connect to close; `error` is what ended it early."""
        self.session.start()
        for when in self._interrupt:
            threading.Thread(target=self._interrupt_at, args=(when,), daemon=True).start()
        try:
            self.flight.fly()
        except (CrazyemError, FlightInterruptedError, MotorsCutError) as error:
            self.error = error
        finally:
            self.estimator.released.set()
            self.session.close()
            self.link.close()
        return self

    def _interrupt_at(self, when):
        while self.link.fm < when:
            time.sleep(0.001)
        self.interrupts()

    def actions(self):
        return [d["action"] for d in self.history.guard["decisions"]]

    def text(self):
        """The summary for people."""
        summary = build_summary(log=None, vehicle="cf2", estimate=self.session.pipeline.finish(), history=self.history,
                                update_seconds=[1e-4], received=1, lost=0)  # fmt: skip
        json.dumps(summary, allow_nan=False)
        return text_summary(summary, self.session.estimate)
