"""A flight of `fake_drone` from connect to close, whatever ends it, and what was recorded of it."""

import json
import threading
import time

import fake_drone as fake

from crazyem.control.trajectories import hover
from crazyem.errors import CrazyemError
from crazyem.estimation.result import PARAMETER_UNITS, Estimate, ParameterEstimate
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


class Estimator(fake.FakeEstimator):
    """Says `values`, precisely; at sample `stall_at` in the air it hangs until `released`, at `fail_at` it fails."""

    def __init__(self, values=None, *, stall_at=None, fail_at=None):
        super().__init__()
        self.fail_at = fail_at
        self.values = {**fake.TRUTH, **(values or {})}
        self.stall_at, self.released, self.stalled = stall_at, threading.Event(), False

    def finish(self):
        base = super().finish()
        p = {}
        for name, value in self.values.items():
            sd = 0.3 / max(self.n, 1) * value
            p[name] = ParameterEstimate(value, sd, (value - 2 * sd, value + 2 * sd), PARAMETER_UNITS[name], self.n > 50)
        return Estimate(base.time, p, samples=self.n, updates=self.updates, converged=True)

    def feed(self, sample):
        if self.stall_at is not None and self.n >= self.stall_at:
            self.stalled = not self.released.is_set()  # the drone does not wait for it
            self.released.wait(600.0)
        if self.fail_at is not None and self.n >= self.fail_at:
            raise ValueError("boom")
        return super().feed(sample)


class FakeFlight:
    """A flight of `duration` s; Ctrl-C comes at the ms `interrupt` of firmware time. `plan`: see `FlightPlan`."""

    def __init__(self, link, estimator=None, *, trajectory=hover, duration=10.0, controller=LEE, interrupt=(), **plan):
        self.link, self.recorder, self.error = link, Recorder(), None
        self.estimator = estimator or Estimator()
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
