"""The path of a sample through estimator, fault monitor, guard and push, common to flights, watches and replays.

The code reads no clock and no random number, and pushes do not affect the estimator. So the same packets in the same
order give the same estimates and faults, live or in a replay.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from crazyem.estimation.result import Estimate, Step
from crazyem.live.flight_monitor import FlightMonitor
from crazyem.live.guard import Decision
from crazyem.live.history import History
from crazyem.signals.sample import Sample


class Estimator(Protocol):
    """Interface of an estimator: an OnlineEstimator, or one around it that detects steps of mass."""

    @property
    def airborne(self) -> bool: ...
    @property
    def update_seconds(self) -> Sequence[float]: ...

    def feed(self, sample: Sample) -> Estimate | None: ...
    def finish(self) -> Estimate: ...


class Gate(Protocol):
    """Interface of the object that decides about writes: a `Guard`, or a `WriteSupervisor` around it."""

    def consider(self, estimate: Estimate, time: float, *, airborne: bool, enabled: bool = True) -> Decision: ...
    def on_mass_step(self, step: Step, time: float) -> None: ...


def steps_of(estimator: Any) -> Sequence[Step]:
    """The steps of mass that an estimator, or the one inside it, has detected; empty if it detects none."""
    while hasattr(estimator, "inner") and not hasattr(estimator, "steps"):
        estimator = estimator.inner
    return tuple(getattr(estimator, "steps", ()))


class Pipeline:
    """Feeds samples to the estimator, its estimates to the guard, and the guard's decisions to `push`.

    Args:
        history: keeps track, estimates and pushes for the summary.
        guard: None: nothing is pushed.
        push: takes a decision with writes; must not block.
        on_estimate: called with every estimate (live line, recording).
        on_step: called with every step of mass when it is detected, and again when its cause is known.
    """

    def __init__(
        self,
        estimator: Estimator,
        *,
        history: History,
        guard: Gate | None = None,
        push: Callable[[Decision], None] | None = None,
        on_estimate: Callable[[Estimate], None] | None = None,
        on_step: Callable[[Step], None] | None = None,
        monitor: FlightMonitor | None = None,
    ) -> None:
        self.estimator = estimator
        self.history = history
        self.guard = guard
        self.push = push
        self.on_estimate = on_estimate
        self.on_step = on_step
        self.monitor = monitor if monitor is not None and monitor.watch(estimator) else None
        self.push_from = math.inf  # s on the drone's clock; estimates from this time on may be pushed
        self.push_until = math.inf
        self.paused = False  # by the user: nothing new is pushed
        self.estimate_until = math.inf  # s; later samples (the landing) do not go to the estimator
        self.decision: Decision | None = None
        self.samples = 0

    def sample(self, sample: Sample) -> Estimate | None:
        """Process one sample; returns an estimate if one is due."""
        self.samples += 1
        self.history.take(sample)
        if self.monitor is not None and sample.time <= self.estimate_until:
            self.monitor.take(sample, airborne=self.estimator.airborne)
        estimate = self.estimator.feed(sample) if sample.time <= self.estimate_until else None
        if estimate is None:
            return None
        self.history.keep(estimate)
        if self.monitor is not None:
            self.history.faults, self.history.monitored = self.monitor.faults, self.monitor.tested
            if self.monitor.suspended:
                self.history.notice(f"The monitor looks for no faults while {self.monitor.suspended}.")
        self._take_steps(estimate.time)
        if self.guard is not None:
            self.decision = self.guard.consider(
                estimate,
                estimate.time,
                airborne=self.estimator.airborne,
                enabled=not self.paused and self.push_from <= estimate.time <= self.push_until,
            )
            if self.decision.writes and self.push is not None:
                self.push(self.decision)
        if self.on_estimate is not None:
            self.on_estimate(estimate)
        return estimate

    def fault_objection(self, time: float) -> str:
        """Why the monitor forbids pushes at `time` [s]; "" if it allows them, or without a monitor."""
        return "" if self.monitor is None else self.monitor.stops(time)

    def _take_steps(self, time: float) -> None:
        """Report new or changed steps of mass; this comes before the decision about the estimate."""
        steps, known = steps_of(self.estimator), self.history.steps
        if not steps or (len(steps) == len(known) and steps[-1] is known[-1]):
            return
        self.history.steps = tuple(steps)
        for step in steps[max(len(known) - 1, 0) :]:
            if step in known:
                continue
            if self.guard is not None:
                self.guard.on_mass_step(step, time)
            if self.on_step is not None:
                self.on_step(step)

    def finish(self) -> Estimate:
        """The final, converged estimate of the newest window."""
        estimate = self.estimator.finish()
        self.history.keep(estimate)
        self._take_steps(estimate.time)
        if self.on_estimate is not None:
            self.on_estimate(estimate)
        return estimate
