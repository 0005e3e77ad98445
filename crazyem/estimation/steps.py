"""Detection of mass steps in flight (a payload attached or released) by the innovations, and restart of the window.

A window of eight seconds needs eight seconds to forget a payload. A step of the mass by a share r is an acceleration of
-r g that the model does not predict, so the innovations of vertical velocity get a mean at once. A two-sided cumulative
sum (Page, 1954) detects this mean and its onset. Then the window restarts and grows again, and what was known of
inertia, lag and delay is its prior. If the mass turns out to be unchanged, the cause was a gust, and the whole window
is used again.

Innovations of a real flight are not white: the thrust law has errors, and the air moves. So the unit of the innovations
is the standard deviation of their means over a quarter of a second. In a flight with large slow errors, a step has to
be larger.

After a real step of mass, the controller changes the thrust gradually. Where the logged thrust jumps between two
commands by as much as the estimated mass, the log is wrong: its voltage or scale changed.
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

VERTICAL_VELOCITY = 5  # index of the innovation: velocity along world z
# standard deviations; drift of the cumulative sum, a smaller mean does not add up; a step of 3 % is 0.75 in hover
MEAN_TOLERANCE = 0.4
LARGEST_INCREMENT = 3.0  # standard deviations; limit of one innovation: a single outlier is no step
STEP_THRESHOLD = 14.0  # cumulative sum from which a step is detected; calm simulated flights without a step reach 9
# innovations in a mean; most means that are kept; fewest means that are needed
BATCH_INNOVATIONS, MOST_BATCHES, FEWEST_BATCHES = 25, 32, 8
LEAST_INNOVATION_SD = 1.3  # least standard deviation: innovations of an onboard estimate are never quite white
# s after take-off and after a step without detection: the filter has to settle first
CALM_SECONDS = 2.0
# s after the detection: earliest and latest time of the decision whether the mass changed
EARLIEST_DECISION, LATEST_DECISION = 0.4, 1.0
# least relative change of mass in a calm flight; multiplied by the flight's own innovation sd over the least one
LEAST_MASS_STEP = 0.018
# least change of mass in standard deviations of the new mass; multiplied likewise
STEP_CONFIDENCE_SD = 3.0
THRUST_JUMP = 0.15  # lasting change of log thrust between two commands; jumps of setpoints make 0.12 at most
# s before the onset of a step in which a jump of thrust is searched; as long as `CALM_SECONDS`
ONSET_SECONDS = 2.0
ADJACENT_SECONDS = 0.025  # s; longest time between two adjacent commands: what happens in a longer gap is unknown
LASTING_COMMANDS = 5  # commands before and after a jump, whose medians are compared, too
SHORTEST_WINDOW = 8  # samples


class CumulativeSum:
    """Two-sided cumulative sum (Page, 1954); `add` returns the onset once a sum is beyond the threshold."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Set both sums to zero."""
        self._sums = [0.0, 0.0]
        self._since = [math.nan, math.nan]

    def add(self, time: float, value: float) -> float | None:
        """Add one normalised innovation at `time` [s]; NaN is ignored."""
        if not math.isfinite(value):
            return None
        value = min(max(value, -LARGEST_INCREMENT), LARGEST_INCREMENT)
        for side, signed in enumerate((value, -value)):
            if self._sums[side] == 0.0:
                self._since[side] = time
            self._sums[side] = max(0.0, self._sums[side] + signed - MEAN_TOLERANCE)
            if self._sums[side] > STEP_THRESHOLD:
                return self._since[side]
        return None


class Wandering:
    """Spread of the means over batches of innovations, as the standard deviation of a single white innovation."""

    def __init__(self) -> None:
        self._sums: deque[float] = deque(maxlen=MOST_BATCHES)
        self._sum, self._count = 0.0, 0
        self.sd = LEAST_INNOVATION_SD

    @property
    def known(self) -> bool:
        """Whether there are enough batches."""
        return len(self._sums) >= FEWEST_BATCHES

    def add(self, value: float) -> None:
        """Add one normalised innovation."""
        self._sum += value
        self._count += 1
        if self._count == BATCH_INNOVATIONS:
            self._sums.append(abs(self._sum))
            self._sum, self._count = 0.0, 0
            # a median: a step within some of the batches does not raise it much
            self.sd = max(LEAST_INNOVATION_SD, 1.4826 * float(np.median(self._sums)) / math.sqrt(BATCH_INNOVATIONS))


def largest_jump(times: NDArray[np.float64], wrenches: NDArray[np.float64], *, since: float) -> float:
    """Largest lasting jump of log thrust from one command to the next; 0 if there is none.

    Args:
        times: (n,) s. wrenches: (n, 4) thrust [N] and torque.
        since: s; earlier commands serve for comparison only.
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
    """An `OnlineEstimator` whose window restarts when the mass steps; the same samples give exactly the same estimates.

    Without a measured velocity no step is detected.

    Args:
        inner: the estimator; only this object feeds it.

    Attributes:
        steps: detected steps, oldest first.
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
        self._jump = 0.0  # jump of log thrust at the onset of the newest step

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    @property
    def airborne(self) -> bool:
        """As `OnlineEstimator.airborne`."""
        return self.inner.airborne

    @property
    def update_seconds(self) -> Sequence[float]:
        """As `OnlineEstimator.update_seconds`."""
        return self.inner.update_seconds

    @property
    def every(self) -> int:
        """Samples between updates of the inner estimator; may be set."""
        return self.inner.every

    @every.setter
    def every(self, samples: int) -> None:
        self.inner.every = samples

    @property
    def adapting(self) -> bool:
        """Whether the window is shorter than usual because of a step."""
        return self.inner.window < self.window

    @property
    def deciding(self) -> bool:
        """Whether a step was detected and not yet decided on."""
        return bool(self.steps) and self.steps[-1].real is None

    def finish(self) -> Estimate:
        """As `OnlineEstimator.finish`; a last step that is not decided yet counts as none."""
        if self.deciding:
            self._settle(self.steps[-1], self._mass[-1][1] if self._mass else math.nan, real=False)
        return self.inner.finish()

    def feed(self, sample: Sample) -> Estimate | None:
        """As `OnlineEstimator.feed`."""
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
            # From the detection, not from the onset: the start of a gust must not count as a change of mass.
            self.inner.window = min(self.window, max(self._rows_since(self.steps[-1].found), SHORTEST_WINDOW))
            if not self.adapting:
                self._set_prior(None)
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
        """Onset [s] of a step, if the rows filtered since the last call show one."""
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
        # values after the onset may contain the step already
        before = next((m for t, m in reversed(self._mass) if t < began), estimate["mass"].value)
        self.steps.append(Step(began, estimate.time, before))
        self.inner.window = SHORTEST_WINDOW
        self._set_prior(estimate)
        self._jump = largest_jump(
            *self.inner._inputs.between(began - ONSET_SECONDS - 0.2, estimate.time), since=began - ONSET_SECONDS
        )

    def _set_prior(self, known: Estimate | None) -> None:
        """What is known of all but mass and torque offset becomes the prior; None: the first prior again."""
        em, setup = self.inner._em, self.inner._setup
        if em is None or setup is None:
            return
        if known is not None:
            value, sd = (np.array([getattr(p, name) for p in known.parameters.values()]) for name in ("value", "sd"))
            setup = setup.after_step(value, sd, em.parameters.noise)
        em.setup = setup

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
            self.inner.window = self.window  # older rows still on the tape are used again
            self._set_prior(None)


def estimator_for(
    vehicle: Vehicle,
    *,
    window: int = 800,
    every: int = 4,
    onboard: bool = True,
    crazyflie: bool = True,
    input_signal: str | None = None,
) -> StepAwareEstimator:
    """The estimator of a flight or a replay; its window restarts when the mass steps.

    Args:
        window, every: newest samples used; samples between updates.
        onboard: attitudes come from an onboard filter, as on every link; crazyflie: from a Crazyflie's filter.
        input_signal: signal for the thrust; None takes the first usable one.

    Raises:
        UsageError: the window is too short to estimate from.
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
