"""The fault monitor of a session: it reads the innovations of the estimator, reports faults, and stops pushing.

It runs in the estimator's thread, like the pipeline. It reads no clock, so a replay finds the same faults.
"""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.estimation.em import WindowEM
from crazyem.estimation.model import Parameters
from crazyem.estimation.verdict import ROTATION_UNEXPLAINED, implausible_inertia
from crazyem.live.policy import FaultRules
from crazyem.monitoring.detector import Detector
from crazyem.monitoring.fault import Fault
from crazyem.monitoring.repetition import Pair, RunTest
from crazyem.monitoring.state_age import StateAges
from crazyem.notebook import finite
from crazyem.signals.sample import Sample
from crazyem.vehicle import Vehicle

# Signals that a stuck sensor would repeat, each with its derivative and the scale of a pair
REPEATING = {"position": ("velocity", 1.0), "attitude": ("body_rate", 0.5)}
MOST_FAULTS = 1000  # most faults that are kept
SHARE_OF_RUNS = 0.1  # share of the false alarms for the tests of repetition; the rest is for the detector


def event_lines(fault: Fault) -> tuple[str, str]:
    """Two events about a fault for the recording: a sentence, and the same as JSON."""
    return f"fault: {fault}", f"fault_data {json.dumps(finite(fault.to_json()))}"


def monitor_for(
    vehicle: Vehicle, rules: FaultRules, *, enabled: bool | None = None, false_alarms_per_hour: float | None = None
) -> "FlightMonitor | None":
    """The monitor by the policy, None if it is disabled; the arguments take precedence over the policy."""
    if not (rules.enabled if enabled is None else enabled):
        return None
    if false_alarms_per_hour is not None:
        rules = replace(rules, false_alarms_per_hour=false_alarms_per_hour)
    return FlightMonitor(vehicle, rules)


class FlightMonitor:
    """Watches one flight.

    Args:
        vehicle: nominal constants. rules: the action after a fault, and the rate of false alarms.
        on_fault: called with every report in the estimator's thread.

    Attributes:
        faults: reports, one for each fault: the settled report replaces the first one.
        suspended: why the detector does not test, "" if it does.
    """

    def __init__(self, vehicle: Vehicle, rules: FaultRules, *, on_fault: Callable[[Fault], None] | None = None) -> None:
        self.rules = rules
        self.on_fault = on_fault
        per_hour = rules.false_alarms_per_hour
        self._detector = Detector(vehicle, false_alarms_per_hour=(1.0 - SHARE_OF_RUNS) * per_hour)
        self._pairs = {name: Pair(scale) for name, (_, scale) in REPEATING.items()}
        self._pair_of = {rate: self._pairs[name] for name, (rate, _) in REPEATING.items()}
        names = (*self._pairs, *self._pair_of)
        self._runs = {name: RunTest(SHARE_OF_RUNS * per_hour / len(names)) for name in names}
        self._stuck: dict[str, bool] = dict.fromkeys(names, False)
        self._ages = StateAges()
        self._broken = -math.inf  # s, last time at which the model did not hold
        self.faults: tuple[Fault, ...] = ()
        self.suspended = ""

    def watch(self, estimator: Any) -> bool:
        """Observe an estimator, or the one inside it; False if it cannot be observed."""
        while hasattr(estimator, "inner"):
            estimator = estimator.inner
        if not hasattr(estimator, "on_filtered"):
            return False
        estimator.on_filtered = self._filtered
        return True

    def take(self, sample: Sample, *, airborne: bool) -> None:
        """One sample, before the estimator gets it."""
        self._ages.add(sample.signal, sample.time, sample.value)
        test, name = self._runs.get(sample.signal), sample.signal
        if test is None:
            return
        test.add(sample.time, sample.value)
        begun = test.since == sample.time
        moved = (
            self._pairs[name].add_value(sample.value, begun=begun)
            if name in self._pairs
            else self._pair_of[name].add_rate(sample.time, sample.value, begun=begun)
        )
        before, self._stuck[name] = self._stuck[name], test.alarmed and (moved or (self._stuck[name] and not begun))
        if self._stuck[name] and not before and airborne:
            self._report(
                Fault(
                    effect=f"stuck {name}", rotor=None, text=f"the {name.replace('_', ' ')} is stuck",
                    onset=test.since, detected=sample.time, sizes={}, probability=1.0, look_alikes={}, settled=True,
                )
            )  # fmt: skip

    def stops(self, time: float) -> str:
        """Why nothing may be pushed at `time` [s], "" if the model holds."""
        if self.rules.action == "report":
            return ""
        followed = bool(self.faults) and self.faults[-1].followed
        if any(self._stuck.values()) or not (self._detector.holds or followed):
            self._broken = time
        if time - self._broken <= self.rules.resume:
            return "the model of the flight does not hold: " + (self.faults[-1].name if self.faults else "a change")
        return ""

    def wants_landing(self, fault: Fault) -> bool:
        """Whether the drone must land because of this fault, by the policy."""
        return self.rules.action == "land" and not fault.followed

    @property
    def tested(self) -> float:
        """s of flight in which the detector has tested."""
        return self._detector.tested

    def _filtered(self, em: WindowEM, p: Parameters, first: int, last: int, sd: NDArray[np.float64] | None) -> None:
        # Innovations about a model that does not describe the rotation say nothing of faults. After a fault, estimates
        # are implausible because of this fault.
        unexplained = not self.faults and bool(implausible_inertia(p.theta, em.setup).any())
        self.suspended = ROTATION_UNEXPLAINED if unexplained else ""
        stuck = any(self._stuck.values())  # explains every deviation meanwhile
        if unexplained or stuck:
            self._detector.pause(float(em.tape.time[last - 1]), found=stuck)
            return
        known = np.where(em.setup.free, em.setup.prior.sd, 0.0) if sd is None else sd
        report = self._detector.take(em, p, first, last, known, self._ages.at(em.tape.time[first:last]))
        if report is not None:
            self._report(report)

    def _report(self, fault: Fault) -> None:
        again = bool(self.faults) and fault.detected == self.faults[-1].detected and not self.faults[-1].settled
        self.faults = (*(self.faults[:-1] if again else self.faults), fault)[-MOST_FAULTS:]
        if self.on_fault is not None:
            self.on_fault(fault)
