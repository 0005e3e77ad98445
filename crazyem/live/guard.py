"""The guard between estimate and controller: it decides what may be written to a flying drone, with reasons."""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from crazyem.estimation.result import Estimate, ParameterEstimate, Step
from crazyem.estimation.verdict import NOT_CONVERGED
from crazyem.live.controllers import DRAG_NAMES, INERTIA_NAMES, Controller, writes_for

# After a change of mass the old value is known to be wrong. So the new value has to agree for this share of the
# agreement time only, and may follow the last write after this share of the interval.
STEP_SHARE = 0.4
WRITABLE_ESTIMATES = ("mass", *INERTIA_NAMES, "motor_time_constant", "mass_thrust", *DRAG_NAMES)
# Estimate -> prefix of the names of its limits.
LIMITS_OF = {"mass": "mass", "motor_time_constant": "lag", "mass_thrust": "mass_thrust"}
LIMITS_OF |= dict.fromkeys(INERTIA_NAMES, "inertia") | dict.fromkeys(DRAG_NAMES, "drag")
# A belief about INDI's loop gain counts as wrong if its distance from an acceptable estimate is more than this many of
# the largest allowed 95 % half widths. Then `STEP_SHARE` applies to the agreement time and the interval.
REFUTED = 3.0
LARGEST_STEP = 0.25  # largest relative step of mass that is added to the slew of one write
STEP_RECENT = 5.0  # s after a step during which it is added, unless the new mass is written earlier


@dataclass(frozen=True)
class Limits:
    """Conditions of the guard on an estimate before it is written to a controller.

    Attributes:
        parameters: those of `WRITABLE_ESTIMATES` that may be written.
        ..._bounds: allowed range as multiples of the vehicle's nominal value.
        ..._absolute: allowed range in SI units, for any vehicle file.
        ..._half_width: largest 95 % half width, relative to the value.
        ..._agreement: largest spread, (max - min) over value, within `agreement_time`.
        ..._deadband: relative changes smaller than this are not written.
        effectiveness_...: replace `slew`, `unjudged`, `inertia_bounds` and `inertia_deadband` for an incremental
            controller.
        drag_slew: largest change of drag over mass in one write, 1/s.
        agreement_time: s during which all estimates have to be acceptable and agree.
        slew: largest relative change in one write; the size of a mass step is added, up to `LARGEST_STEP`.
        unjudged: largest relative change from the belief that was last judged good.
        interval: s between writes.
    """

    parameters: tuple[str, ...] = WRITABLE_ESTIMATES
    mass_bounds: tuple[float, float] = (0.5, 2.0)
    inertia_bounds: tuple[float, float] = (0.33, 3.0)
    mass_absolute: tuple[float, float] = (0.010, 0.250)
    inertia_absolute: tuple[float, float] = (1e-6, 1e-3)
    mass_half_width: float = 0.03
    inertia_half_width: float = 0.10
    mass_agreement: float = 0.02
    inertia_agreement: float = 0.08
    agreement_time: float = 0.5
    slew: float = 0.15
    unjudged: float = 0.35
    interval: float = 0.5
    mass_deadband: float = 0.002
    inertia_deadband: float = 0.03
    lag_bounds: tuple[float, float] = (0.33, 3.0)
    lag_absolute: tuple[float, float] = (0.005, 0.2)
    lag_half_width: float = 0.20
    lag_agreement: float = 0.15
    lag_deadband: float = 0.10
    mass_thrust_bounds: tuple[float, float] = (0.5, 2.0)
    mass_thrust_absolute: tuple[float, float] = (1e4, 1e6)
    mass_thrust_half_width: float = 0.05
    mass_thrust_agreement: float = 0.02
    mass_thrust_deadband: float = 0.005
    drag_bounds: tuple[float, float] = (0.0, math.inf)
    drag_absolute: tuple[float, float] = (0.02, 1.5)
    drag_half_width: float = 0.30
    drag_agreement: float = 0.15
    drag_deadband: float = 0.10
    drag_slew: float = 0.25
    effectiveness_bounds: tuple[float, float] = (0.5, 2.0)
    effectiveness_slew: float = 0.50
    effectiveness_unjudged: float = 0.50
    effectiveness_deadband: float = 0.01

    def of(self, name: str, kind: str) -> Any:
        """A limit for an estimate: bounds, absolute, half_width, agreement or deadband."""
        return getattr(self, f"{LIMITS_OF[name]}_{kind}")

    def allowed(self, name: str, nominal: float) -> tuple[float, float]:
        """Allowed range [SI] of an estimate with the nominal value `nominal`: both kinds of bounds hold.

        Without a nominal value (a vehicle without lag, drag) only the absolute bounds hold.
        """
        least, most = self.of(name, "absolute")
        low, high = (b * nominal for b in self.of(name, "bounds")) if nominal > 0.0 else (least, most)
        return max(low, least), min(high, most)

    def for_incremental(self) -> "Limits":
        """The limits for a controller that uses control effectiveness."""
        return replace(self, inertia_bounds=self.effectiveness_bounds, inertia_deadband=self.effectiveness_deadband)


@dataclass(frozen=True)
class Decision:
    """Ordered writes (name, value), or none and the reasons.

    Attributes:
        time: s on the drone's clock, of the estimate behind the decision.
        writes: firmware parameters and values, in the order to be written.
        reason: for each estimate, why it is not written; empty if it is. For a revert, the reason of the revert.
        kind: "push"; "revert" to the last good values in flight; "restore" after the flight. A stopped guard ends
            pushes only.
    """

    time: float
    writes: tuple[tuple[str, float], ...] = ()
    reason: Mapping[str, str] | str = ""
    kind: str = "push"

    def __str__(self) -> str:
        if self.writes:
            return ", ".join(f"{n} = {v:.6g}" for n, v in self.writes)
        return self.why

    @property
    def why(self) -> str:
        """The reasons in one line."""
        if isinstance(self.reason, str):
            return self.reason
        return "; ".join(f"{n}: {r}" for n, r in self.reason.items() if r)


class Guard:
    """Decides after each estimate. It uses no clock, input or output: the same estimates give the same decisions.

    Args:
        controller: that gets the values.
        nominal: mass [kg], Ixx, Iyy, Izz [kg m^2], ... of the vehicle file, the centre of the allowed range.
        originals: the controller's parameter values at connect.
        limits: see `Limits`.
    """

    def __init__(
        self,
        controller: Controller,
        *,
        nominal: Mapping[str, float],
        originals: Mapping[str, float],
        limits: Limits | None = None,
    ):
        self.controller = controller
        self.nominal = dict(nominal)
        self.originals = dict(originals)
        self.limits = limits or Limits()
        if controller.incremental:
            self.limits = self.limits.for_incremental()
        self.stopped = ""
        self.beliefs = {belief.name: belief.read(self.originals) for belief in controller.beliefs}
        self._history: deque[tuple[float, dict[str, float], dict[str, str]]] = deque()
        self._last_write = float("-inf")
        self._before: tuple[dict[str, float], float] | None = None
        self._step: Step | None = None
        self.capped = True  # whether `unjudged` limits changes; False if writes are not judged
        self._trusted = dict(self.beliefs)  # beliefs of the controller that were last judged good

    def withdraw(self) -> None:
        """The newest decision was not carried out: the controller keeps its old beliefs."""
        if self._before is not None:
            self.beliefs, self._last_write = dict(self._before[0]), self._before[1]
            self._before = None

    def trust(self) -> None:
        """The present beliefs of the controller were judged good."""
        self._trusted = dict(self.beliefs)

    def stop(self, reason: str) -> None:
        """Never write again in this flight, for example after an unconfirmed write, when the beliefs are unknown."""
        self.stopped = self.stopped or reason

    def on_mass_step(self, step: Step, time: float = math.nan) -> None:
        """A change of mass was detected, or its cause is now known; estimates from before are dropped.

        `time` [s] belongs to the interface of the pipeline; the guard needs only the times of the step.
        """
        if step.jumped:
            self.stop(f"{step}; nothing more is pushed.")
        self._step = step if step.real is not False else None
        if step.real is not True:
            self._history.clear()

    def consider(
        self, estimate: Estimate, time: float, *, airborne: bool, enabled: bool = True, objection: str = ""
    ) -> Decision:
        """The decision after an estimate.

        Args:
            time: s on the drone's clock.
            airborne: False on the ground or in contact; this clears the history.
            enabled: False in phases of the flight without writes; the history is kept.
            objection: why nothing may be written now (battery, supervisor); the history is kept.
        """
        if self.stopped:
            return Decision(time, reason=self.stopped)
        if not airborne:
            self._history.clear()
            return Decision(time, reason="not airborne")
        self._remember(estimate, time)
        if not enabled:
            return Decision(time, reason="not in a phase of the flight where parameters are pushed")
        if objection:
            return Decision(time, reason=objection)
        recent = self._recent_step(time)
        hurry = recent is not None or any(map(self._refuted, self.beliefs))
        if time - self._last_write < self.limits.interval * (STEP_SHARE if hurry else 1.0):
            return Decision(time, reason="too soon after the last write")

        reasons: dict[str, str] = {}
        changed: dict[str, float] = {}
        for name in self.beliefs:
            reasons[name] = self._objection(name, time)
            if self._step is not None and self._step.real is None:
                reasons[name] = "the mass may have changed just now"
            if name not in self.limits.parameters:
                reasons[name] = "not to be pushed by this policy"
            if not reasons[name]:
                value = self._slewed(name, self._found(estimate, name).value, recent)
                if self.beliefs[name] > 0 and abs(value / self.beliefs[name] - 1) < self.limits.of(name, "deadband"):
                    reasons[name] = "a change as large as this waits until the last one was judged"
                    continue
                low, high = self.limits.allowed(name, self.nominal.get(name, 0.0))
                if low <= value <= high:
                    changed[name] = value
                else:  # one write from the present belief still ends outside
                    reasons[name] = f"the controller believes {self.beliefs[name]:.4g}, too far outside to lead it back"
        changed = self._together(changed, reasons)
        if not changed:
            return Decision(time, reason=reasons)
        writes = writes_for(self.controller, changed, beliefs=self.beliefs, originals=self.originals)
        self._before = (dict(self.beliefs), self._last_write)
        self.beliefs.update(changed)
        self._last_write = time
        if "mass" in changed:
            self._step = None
        return Decision(time, writes=writes, reason=reasons)

    def _together(self, changed: Mapping[str, float], reasons: dict[str, str]) -> dict[str, float]:
        """The changes without those that wait for other estimates (`Controller.waits`); these get a reason."""
        for name, others in self.controller.waits.items():
            late = [o for o in others if o not in changed and reasons.get(o) != "unchanged"]
            if not self.controller.attitude_gains:  # the axes share no gain: none waits for one that is never written
                late = [o for o in late if o in self.limits.parameters]
            if name in changed and late:
                reasons[name] = f"waits for {late[0]}"
        return {name: value for name, value in changed.items() if not reasons[name]}

    def _remember(self, estimate: Estimate, time: float) -> None:
        values = {n: self._found(estimate, n).value for n in self.beliefs}
        faults = {n: self._fault(estimate, n) for n in self.beliefs}
        self._history.append((time, values, faults))
        # Keep one entry older than the span, so that the span is covered.
        while len(self._history) > 2 and self._history[1][0] <= time - self.limits.agreement_time:
            self._history.popleft()

    def _found(self, estimate: Estimate, name: str) -> ParameterEstimate:
        """An estimate from the flight, or a known value from the vehicle file once the mass is known well enough.

        A known mass shows that the thrust agrees with the vehicle file.
        """
        p = estimate.parameters.get(name)
        if p is not None:
            return p
        known = dict(self.controller.known).get(name)
        if known is None:
            return ParameterEstimate(math.nan, math.inf, (math.nan, math.nan), "", False, "not estimated")
        mass = estimate["mass"]
        seen = mass.identifiable or 1.96 * mass.relative_sd <= self.limits.mass_half_width
        return ParameterEstimate(known, 0.0, (known, known), "", seen, "" if seen else mass.reason)

    def _fault(self, estimate: Estimate, name: str) -> str:
        p = self._found(estimate, name)
        low, high = p.ci95
        if not p.identifiable:
            return p.reason or "not identifiable"
        if not (low <= p.value <= high) or not p.value > 0:  # also catches NaN
            return "no valid value"
        lo, hi = self.limits.allowed(name, self.nominal.get(name, 0.0))
        if not lo <= p.value <= hi:
            return f"{p.value:.4g} {p.unit} is outside [{lo:.4g}, {hi:.4g}]"
        half = max(high - p.value, p.value - low) / p.value
        if half > self.limits.of(name, "half_width"):
            return f"uncertain: +-{100 * half:.1f} %"
        return ""

    def _recent_step(self, time: float) -> Step | None:
        """The recent change of mass that is not written yet."""
        step = self._step
        return step if step is not None and step.real and time - step.found < STEP_RECENT else None

    def _objection(self, name: str, time: float) -> str:
        newest, needed = self._history[-1], self.limits.agreement_time
        if name == "mass" and self._recent_step(time) is not None:
            needed *= STEP_SHARE
        if self._refuted(name):
            needed *= STEP_SHARE
        if newest[2][name]:
            return newest[2][name]
        if time - self._history[0][0] < needed:
            return "too early to tell"
        # begin with one entry older than the span, so that the span is covered
        first = max((k for k, (t, _, _) in enumerate(self._history) if t <= time - needed), default=0)
        history = list(self._history)[first:]
        span = [entry for entry in history if entry[2][name] != NOT_CONVERGED]  # the others neither agree nor disagree
        if 2 * len(span) < len(history) or any(faults[name] for _, _, faults in span):
            return "only just acceptable"
        values = [v[name] for _, v, _ in span]
        if (max(values) - min(values)) / newest[1][name] > self.limits.of(name, "agreement"):
            return "estimates still move"
        change = abs(newest[1][name] / self.beliefs[name] - 1) if self.beliefs[name] > 0 else float("inf")
        if change < self.limits.of(name, "deadband"):
            return "unchanged"
        return ""

    def _refuted(self, name: str) -> bool:
        """Whether a belief about INDI's loop gain is so far from an acceptable estimate that it counts as wrong."""
        _, values, faults = self._history[-1]
        if not self.controller.incremental or name not in INERTIA_NAMES or faults[name] or not self.beliefs[name] > 0:
            return False
        return abs(values[name] / self.beliefs[name] - 1) > REFUTED * self.limits.inertia_half_width

    def _slewed(self, name: str, value: float, step: Step | None) -> float:
        now, slew, unjudged = self.beliefs[name], self.limits.slew, self.limits.unjudged
        if name in DRAG_NAMES:
            return min(max(value, now - self.limits.drag_slew), now + self.limits.drag_slew)
        if self.controller.incremental:
            slew, unjudged = self.limits.effectiveness_slew, self.limits.effectiveness_unjudged
        if name == "mass" and step is not None and step.after is not None:
            slew += min(abs(step.after / step.before - 1), LARGEST_STEP)
        if not now > 0:
            return value  # the belief is invalid; the bounds around the nominal value still hold
        low, high = now * (1 - slew), now * (1 + slew)
        trusted = self._trusted[name]
        if self.capped and trusted > 0:
            low, high = max(low, trusted * (1 - unjudged)), min(high, trusted * (1 + unjudged))
        return min(max(value, low), high)
