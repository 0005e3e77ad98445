"""The one path of a sample: decode, estimate, gate, push. Flying, watching, replaying and attaching all run it.

Nothing here reads a clock or a random number, and nothing that is pushed comes back in, so the same packets in the
same order give the same estimates, live or replayed.
"""

import math
from collections.abc import Callable, Sequence
from typing import Protocol

from crazyem.estimation.result import Estimate
from crazyem.live.guard import Decision, Guard
from crazyem.live.history import History
from crazyem.signals.sample import Sample


class Estimator(Protocol):
    """What the pipeline needs of an estimator (crazyem.estimation.online.OnlineEstimator)."""

    @property
    def airborne(self) -> bool: ...
    @property
    def update_seconds(self) -> Sequence[float]: ...

    def feed(self, sample: Sample) -> Estimate | None: ...
    def finish(self) -> Estimate: ...


class Pipeline:
    """Feeds samples to the estimator, its estimates to the guard, and the guard's writes to whoever writes.

    Args:
        estimator: see `Estimator`.
        history: keeps track, estimates and pushes for the summary.
        guard: None where nothing is to be pushed.
        push: takes a decision with writes; must not block.
        on_estimate: called with every estimate (live line, recording).
    """

    def __init__(
        self,
        estimator: Estimator,
        *,
        history: History,
        guard: Guard | None = None,
        push: Callable[[Decision], None] | None = None,
        on_estimate: Callable[[Estimate], None] | None = None,
    ) -> None:
        self.estimator = estimator
        self.history = history
        self.guard = guard
        self.push = push
        self.on_estimate = on_estimate
        self.push_from = math.inf  # s on the drone's clock; estimates of this time and later may be pushed
        self.push_until = math.inf
        self.estimate_until = math.inf  # s; later samples (the landing) belong to the track, not to the estimate
        self.decision: Decision | None = None
        self.samples = 0

    def sample(self, sample: Sample) -> Estimate | None:
        """One sample further; the estimate if one is due."""
        self.samples += 1
        self.history.take(sample)
        estimate = self.estimator.feed(sample) if sample.time <= self.estimate_until else None
        if estimate is None:
            return None
        self.history.estimates.append(estimate)
        if self.guard is not None:
            self.decision = self.guard.consider(
                estimate,
                estimate.time,
                airborne=self.estimator.airborne,
                enabled=self.push_from <= estimate.time <= self.push_until,
            )
            if self.decision.writes and self.push is not None:
                self.push(self.decision)
        if self.on_estimate is not None:
            self.on_estimate(estimate)
        return estimate

    def finish(self) -> Estimate:
        """The final estimate of the newest window, converged."""
        estimate = self.estimator.finish()
        self.history.estimates.append(estimate)
        if self.on_estimate is not None:
            self.on_estimate(estimate)
        return estimate
