"""Steps of mass in flight, a payload attached or released: found by the innovations, and the window begins anew.

An estimator that averages over eight seconds needs eight to forget a payload. A step of mass by a share r is an
acceleration of -r g that the model does not predict, so innovations of vertical velocity go to one side at once. A
two-sided cumulative sum (Page, 1954) finds that and when it began; from there the window grows again. If the mass
turns out to be what it was, it was a gust, and the whole window is used as before.

Innovations of a real flight are not white: thrust laws err, air moves. So they are counted in standard deviations of
their own means over a quarter of a second, and a flight that wanders by itself has to step further to be believed.

A mass that steps is felt by the drone, and its controller answers in its own time. Where the logged thrust jumps
between two commands by as much as the mass seems to, it is the log that changed: its voltage or scale is wrong.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.estimation.in_step import PERIOD
from crazyem.estimation.online import ATTITUDE_PERIOD, OnlineEstimator
from crazyem.estimation.result import Estimate, Step
from crazyem.signals.sample import Sample
from crazyem.vehicle import Vehicle

VERTICAL_VELOCITY = 5  # of the innovations: velocity along world z
# standard deviations that the mean may be off without being summed up; a step of 3 % is 0.75 in hover
MEAN_TOLERANCE = 0.4
LARGEST_INCREMENT = 3.0  # standard deviations that one innovation may add: a single outlier is no step
STEP_THRESHOLD = 14.0  # sum that is a step; calm simulated flights without one reach 9
# innovations in a mean; means that are kept, and that must be known
BATCH_INNOVATIONS, MOST_BATCHES, FEWEST_BATCHES = 25, 32, 8
LEAST_INNOVATION_SD = 1.3  # least standard deviation of innovations: those of an onboard estimate are never quite white
# s in the air, and after a step, within which none is looked for: the filter has to know itself first
CALM_SECONDS = 2.0
# s after it was noticed when a step can be called one, and when it is one or is not
EARLIEST_DECISION, LATEST_DECISION = 0.4, 1.0
# relative change of mass that counts as one in a calm flight; more by the flight's own wandering
LEAST_MASS_STEP = 0.018
# standard deviations that it has to be, those of the new mass and of the flight's own wandering
STEP_CONFIDENCE_SD = 3.0
THRUST_JUMP = 0.15  # of the logarithm of thrust between two commands, lasting: setpoints that jump make 0.12 at most
# s before a step seems to have begun in which a jump is looked for: as long as none is looked for itself
ONSET_SECONDS = 2.0
ADJACENT_SECONDS = 0.025  # s between commands of which one follows the other; after a gap nobody knows what was in it
LASTING_COMMANDS = 5  # commands before and after a jump that are compared, too
SHORTEST_WINDOW = 8  # samples that a window has at least


class CumulativeSum:
    """Two-sided; `add` returns when the present excursion began once it is beyond the threshold."""

    def __init__(
        self, *, drift: float = MEAN_TOLERANCE, threshold: float = STEP_THRESHOLD, most: float = LARGEST_INCREMENT
    ) -> None:
        self.drift, self.threshold, self.most = drift, threshold, most
        self.reset()

    def reset(self) -> None:
        """Nothing seen."""
        self._sums = [0.0, 0.0]
        self._since = [math.nan, math.nan]

    def add(self, time: float, value: float) -> float | None:
        """One normalised innovation at `time` [s]; NaN is left out."""
        if not math.isfinite(value):
            return None
        value = min(max(value, -self.most), self.most)
        for side, signed in enumerate((value, -value)):
            if self._sums[side] == 0.0:
                self._since[side] = time
            self._sums[side] = max(0.0, self._sums[side] + signed - self.drift)
            if self._sums[side] > self.threshold:
                return self._since[side]
        return None


class Wandering:
    """How much means over a batch of innovations vary, as the standard deviation of a single white one."""

    def __init__(self) -> None:
        self._sums: deque[float] = deque(maxlen=MOST_BATCHES)
        self._sum, self._count = 0.0, 0
        self.sd = LEAST_INNOVATION_SD

    @property
    def known(self) -> bool:
        """Whether enough was seen."""
        return len(self._sums) >= FEWEST_BATCHES

    def add(self, value: float) -> None:
        """One normalised innovation."""
        self._sum += value
        self._count += 1
        if self._count == BATCH_INNOVATIONS:
            self._sums.append(abs(self._sum))
            self._sum, self._count = 0.0, 0
            # a median: a step that is in some of the batches does not hide itself
            self.sd = max(LEAST_INNOVATION_SD, 1.4826 * float(np.median(self._sums)) / math.sqrt(BATCH_INNOVATIONS))


def largest_jump(times: NDArray[np.float64], wrenches: NDArray[np.float64], *, since: float) -> float:
    """Largest lasting jump of the logarithm of thrust from one command to the next; 0 where there is none to be seen.

    Args:
        times: (n,) s. wrenches: (n, 4) thrust [N] and torque.
        since: s; earlier commands are only compared with.
    """
    thrust = np.log(np.maximum(wrenches[:, 0], 1e-6))
    best = 0.0
    for k in range(1, len(times)):
        if times[k] < since or times[k] - times[k - 1] > ADJACENT_SECONDS:
            continue
        step = float(thrust[k] - thrust[k - 1])
        lasting = float(
            np.median(thrust[k : k + LASTING_COMMANDS]) - np.median(thrust[max(k - LASTING_COMMANDS, 0) : k])
        )
        size = min(abs(step), abs(lasting)) if step * lasting > 0 else 0.0
        if size > abs(best):
            best = math.copysign(size, step)
    return best


class StepAwareEstimator:
    """An `OnlineEstimator` whose window begins anew when the mass steps. Same samples, same estimates, bit for bit.

    Needs a measured velocity: without one no step is found.

    Args:
        inner: the estimator; it is fed by this one only.

    Attributes:
        steps: what was found, oldest first.
    """

    def __init__(self, inner: OnlineEstimator) -> None:
        self.inner = inner
        self.window = inner.window
        self.steps: list[Step] = []
        self._sum = CumulativeSum()
        self._wandering = Wandering()
        self._seen = -math.inf
        self._mass: list[tuple[float, float]] = []  # time, mass of the newest estimates
        self._quiet_until = math.nan
        self._jump = 0.0  # of the logarithm of thrust at the onset of the newest step

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    @property
    def airborne(self) -> bool:
        """As the inner one."""
        return self.inner.airborne

    @property
    def update_seconds(self) -> Sequence[float]:
        """As the inner one."""
        return self.inner.update_seconds

    @property
    def every(self) -> int:
        """Samples between updates, as the inner one; may be set."""
        return self.inner.every

    @every.setter
    def every(self, samples: int) -> None:
        self.inner.every = samples

    def share_computer(self, refresh: int) -> None:
        """As `OnlineEstimator.share_computer`."""
        self.inner.share_computer(refresh)

    @property
    def adapting(self) -> bool:
        """Whether the window is shorter than usual because of a step."""
        return self.inner.window < self.window

    @property
    def deciding(self) -> bool:
        """Whether something was noticed of which it is not known yet whether it was a step."""
        return bool(self.steps) and self.steps[-1].real is None

    def finish(self) -> Estimate:
        """As the inner one; what was noticed last and could not be decided any more was no step."""
        if self.deciding:
            self._settle(self.steps[-1], self._mass[-1][1] if self._mass else math.nan, real=False)
        return self.inner.finish()

    def feed(self, sample: Sample) -> Estimate | None:
        """As the inner one."""
        estimate = self.inner.feed(sample)
        if estimate is None:
            return None
        if not self.airborne:
            self._sum.reset()
            self._quiet_until = math.nan
            return estimate
        if math.isnan(self._quiet_until):
            self._quiet_until = estimate.time + CALM_SECONDS
        if self.adapting:
            # Not since it began: if it was a gust, what it did until it was found must not be taken for mass.
            self.inner.window = min(self.window, max(self._rows_since(self.steps[-1].found), SHORTEST_WINDOW))
        if self.deciding:
            self._decide(self.steps[-1], estimate)
        began = self._look(estimate.time)
        if began is None:
            self._mass = [*self._mass[-24:], (estimate.time, estimate["mass"].value)]
        else:
            self._begin_anew(began, estimate)
        return estimate

    def _rows_since(self, time: float) -> int:
        tape = self.inner._tape
        return int((tape.time[: tape.size] > time).sum())

    def _look(self, now: float) -> float | None:
        """When a step began, if what was filtered since the last look shows one."""
        tape = self.inner._tape
        last = self.inner._fresh
        first = int(np.searchsorted(tape.time[:last], self._seen, side="right"))
        began = None
        for k in range(first, last):
            self._seen = float(tape.time[k])
            if tape.kind[k] or not tape.s[k, VERTICAL_VELOCITY] > 0.0:
                continue
            value = float(tape.e[k, VERTICAL_VELOCITY] / math.sqrt(tape.s[k, VERTICAL_VELOCITY]))
            if not math.isfinite(value):
                continue
            ready = self._wandering.known and now >= self._quiet_until and not self.deciding
            if began is None and ready:
                began = self._sum.add(self._seen, value / self._wandering.sd)
            self._wandering.add(value)
        return began

    def _begin_anew(self, began: float, estimate: Estimate) -> None:
        self._sum.reset()
        self._quiet_until = estimate.time + CALM_SECONDS
        # the newest values may have felt the step already
        before = next((m for t, m in reversed(self._mass) if t < began), estimate["mass"].value)
        self.steps.append(Step(began, estimate.time, before))
        self.inner.window = SHORTEST_WINDOW
        self._jump = largest_jump(
            *self.inner._inputs.between(began - ONSET_SECONDS - 0.2, estimate.time), since=began - ONSET_SECONDS
        )

    def _decide(self, step: Step, estimate: Estimate) -> None:
        since, mass = estimate.time - step.found, estimate["mass"]
        change = abs(mass.value / step.before - 1.0)
        enough = max(LEAST_MASS_STEP, STEP_CONFIDENCE_SD * mass.relative_sd) * self._wandering.sd / LEAST_INNOVATION_SD
        if (since >= EARLIEST_DECISION and change > enough and mass.identifiable) or since >= LATEST_DECISION:
            ratio = math.log(mass.value / step.before) if mass.value > 0 < step.before else 0.0
            jumped = change > enough and abs(self._jump) > THRUST_JUMP and self._jump / ratio > 0.5
            self._settle(step, mass.value, real=change > enough and not jumped, jumped=jumped)

    def _settle(self, step: Step, mass: float, *, real: bool, jumped: bool = False) -> None:
        self.steps[-1] = Step(step.time, step.found, step.before, mass, real, jumped)
        if not real:
            self.inner.window = self.window  # what is still on the tape is used again


def estimator_for(
    vehicle: Vehicle,
    *,
    window: int = 800,
    every: int = 4,
    onboard: bool = True,
    crazyflie: bool = True,
    input_signal: str | None = None,
) -> StepAwareEstimator:
    """The estimator of a flight or a replay; its window begins anew when the mass steps.

    Args:
        window, every: newest samples used; samples between updates.
        onboard: attitudes come from a filter on board, as those of every link do; crazyflie: from a Crazyflie's.
        input_signal: what thrust is computed from; None takes what comes first.

    Raises:
        UsageError: a window too short to estimate from.
    """
    return StepAwareEstimator(
        OnlineEstimator(
            vehicle,
            window=window,
            every=every,
            attitude_period=ATTITUDE_PERIOD if onboard else 0.0,
            prediction_period=PERIOD if onboard and crazyflie else 0.0,
            input_signal=input_signal,
        )
    )
