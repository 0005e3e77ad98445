"""The gate between estimate and controller: decides what may be written to a flying drone, and says why not."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from crazyem.estimation.result import Estimate
from crazyem.live.controllers import Controller, writes_for

INERTIA = ("Ixx", "Iyy", "Izz")


@dataclass(frozen=True)
class Limits:
    """What the guard asks of an estimate before it reaches a controller.

    Attributes:
        mass_bounds, inertia_bounds: allowed range as multiples of the vehicle's nominal value.
        mass_half_width, inertia_half_width: largest 95 % half width, relative to the value.
        mass_agreement, inertia_agreement: largest spread (max - min over value) within `agreement_time`.
        agreement_time: s over which estimates have to agree, all of them acceptable.
        slew: largest relative change in one write.
        interval: s between writes.
        mass_deadband, inertia_deadband: relative changes smaller than this are not worth a write.
    """

    mass_bounds: tuple[float, float] = (0.5, 2.0)
    inertia_bounds: tuple[float, float] = (0.33, 3.0)
    mass_half_width: float = 0.03
    inertia_half_width: float = 0.10
    mass_agreement: float = 0.02
    inertia_agreement: float = 0.08
    agreement_time: float = 0.5
    slew: float = 0.15
    interval: float = 0.5
    mass_deadband: float = 0.002
    inertia_deadband: float = 0.03

    def of(self, name: str, kind: str) -> float:
        """A scalar limit for a parameter."""
        return float(getattr(self, f"{'mass' if name == 'mass' else 'inertia'}_{kind}"))

    def bounds(self, name: str) -> tuple[float, float]:
        """Allowed multiples of nominal for a parameter."""
        return self.mass_bounds if name == "mass" else self.inertia_bounds


@dataclass(frozen=True)
class Decision:
    """What to write (name, value) in order, or nothing and why.

    Attributes:
        time: s on the drone's clock of the estimate it rests on.
        writes: firmware parameters and values, in the order to be written.
        reason: per estimated parameter, why it is not written; empty where it is.
    """

    time: float
    writes: tuple[tuple[str, float], ...] = ()
    reason: Mapping[str, str] | str = ""

    def __str__(self) -> str:
        if self.writes:
            return ", ".join(f"{n} = {v:.6g}" for n, v in self.writes)
        if isinstance(self.reason, str):
            return self.reason
        return "; ".join(f"{n}: {r}" for n, r in self.reason.items() if r)


class Guard:
    """Decides, estimate by estimate. No clock, no input or output: the same estimates give the same decisions.

    Args:
        controller: where the values go.
        nominal: mass [kg], Ixx, Iyy, Izz [kg m^2] of the vehicle file, the centre of the allowed range.
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
        self.stopped = ""
        self.beliefs = self._beliefs()
        self._history: deque[tuple[float, dict[str, float], dict[str, str]]] = deque()
        self._last_write = float("-inf")

    def _beliefs(self) -> dict[str, float]:
        parameters = ((self.controller.mass,) if self.controller.mass else ()) + self.controller.inertia
        names = (("mass",) if self.controller.mass else ()) + (INERTIA if self.controller.inertia else ())
        return {n: self.originals[p] for n, p in zip(names, parameters)}

    def stop(self, reason: str) -> None:
        """Never write again in this flight (a write was not confirmed: what the drone believes is not known)."""
        self.stopped = self.stopped or reason

    def consider(self, estimate: Estimate, time: float, *, airborne: bool, enabled: bool = True) -> Decision:
        """What to write after this estimate.

        Args:
            estimate: the newest.
            time: s on the drone's clock.
            airborne: False on the ground or in contact; history is forgotten then.
            enabled: False while the flight is not in a phase where writes are wanted; history is kept.
        """
        if self.stopped:
            return Decision(time, reason=self.stopped)
        if not airborne:
            self._history.clear()
            return Decision(time, reason="not airborne")
        self._remember(estimate, time)
        if not enabled:
            return Decision(time, reason="not in a phase of the flight where parameters are pushed")
        if time - self._last_write < self.limits.interval:
            return Decision(time, reason="too soon after the last write")

        reasons: dict[str, str] = {}
        changed: dict[str, float] = {}
        for name in self.beliefs:
            reasons[name] = self._objection(name, time)
            if not reasons[name]:
                changed[name] = self._slewed(name, estimate[name].value)
        if self.controller.attitude_gains and ("Ixx" in changed) != ("Iyy" in changed):
            # Roll and pitch gains share one scale; one axis alone would skew it.
            lone, other = ("Ixx", "Iyy") if "Ixx" in changed else ("Iyy", "Ixx")
            if reasons[other] != "unchanged":
                del changed[lone]
                reasons[lone] = f"waits for {other}"
        if not changed:
            return Decision(time, reason=reasons)
        writes = writes_for(self.controller, changed, beliefs=self.beliefs, originals=self.originals)
        self.beliefs.update(changed)
        self._last_write = time
        return Decision(time, writes=writes, reason=reasons)

    def _remember(self, estimate: Estimate, time: float) -> None:
        values = {n: estimate[n].value for n in self.beliefs}
        faults = {n: self._fault(estimate, n) for n in self.beliefs}
        self._history.append((time, values, faults))
        # One entry older than the span stays, so that the span is really covered.
        while len(self._history) > 2 and self._history[1][0] <= time - self.limits.agreement_time:
            self._history.popleft()

    def _fault(self, estimate: Estimate, name: str) -> str:
        p = estimate[name]
        low, high = p.ci95
        if not p.identifiable:
            return p.reason or "not identifiable"
        if not (low <= p.value <= high) or not p.value > 0:  # also catches NaN
            return "no valid value"
        lo, hi = (b * self.nominal[name] for b in self.limits.bounds(name))
        if not lo <= p.value <= hi:
            return f"{p.value:.4g} {p.unit} is outside [{lo:.4g}, {hi:.4g}]"
        half = max(high - p.value, p.value - low) / p.value
        if half > self.limits.of(name, "half_width"):
            return f"uncertain: +-{100 * half:.1f} %"
        return ""

    def _objection(self, name: str, time: float) -> str:
        newest = self._history[-1]
        if newest[2][name]:
            return newest[2][name]
        if time - self._history[0][0] < self.limits.agreement_time:
            return "too early to tell"
        if any(faults[name] for _, _, faults in self._history):
            return "only just acceptable"
        values = [v[name] for _, v, _ in self._history]
        if (max(values) - min(values)) / newest[1][name] > self.limits.of(name, "agreement"):
            return "estimates still move"
        change = abs(newest[1][name] / self.beliefs[name] - 1) if self.beliefs[name] > 0 else float("inf")
        if change < self.limits.of(name, "deadband"):
            return "unchanged"
        return ""

    def _slewed(self, name: str, value: float) -> float:
        now, slew = self.beliefs[name], self.limits.slew
        if not now > 0:
            return value  # the controller believed nonsense; the bounds around nominal still hold
        return min(max(value, now * (1 - slew)), now * (1 + slew))
