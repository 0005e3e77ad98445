"""Estimates for an existing cflib script, from its own open Crazyflie object, without owning the flight."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Protocol

from crazyem.errors import DataError
from crazyem.estimation.result import Estimate
from crazyem.live.flight_monitor import monitor_for
from crazyem.live.policy import Policy, WriteRules, load_policy
from crazyem.live.session import Session
from crazyem.monitoring.fault import Fault
from crazyem.physics import folding
from crazyem.vehicle import Vehicle


class OpenCrazyflie(Protocol):
    """cflib's `Crazyflie`, connected: `scf.cf` of a SyncCrazyflie."""

    link_uri: str

    def is_connected(self) -> bool:
        """Whether its link is open."""


class Attachment:
    """An estimation beside a flight of another script, until closed; a context manager.

    Attributes:
        session: holds history, pushes and clock.
    """

    def __init__(self, session: Session) -> None:
        self.session = session

    @property
    def estimate(self) -> Estimate | None:
        """The newest estimate, None before the first (the drone has to fly)."""
        self.session.raise_if_failed()
        return self.session.estimate

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Faults that the monitor has found in this flight."""
        return self.session.history.faults

    def wait(self, parameters: Sequence[str] = ("mass",), *, timeout: float = 30.0) -> Estimate:
        """Block until all of `parameters` are identifiable, and return the estimate.

        Raises:
            DataError: not within `timeout` seconds, with the reason.
        """
        until = time.monotonic() + timeout
        while time.monotonic() < until:
            estimate = self.estimate
            if estimate is not None and all(estimate[p].identifiable for p in parameters):
                return estimate
            time.sleep(0.02)
        why = "the drone has not flown"
        if (estimate := self.estimate) is not None:
            why = "; ".join(f"{p}: {estimate[p].reason}" for p in parameters if not estimate[p].identifiable)
        raise DataError(f"no identifiable {' and '.join(parameters)} within {timeout:g} s ({why}).")

    def close(self) -> None:
        """End the writes, then remove our log blocks; the Crazyflie object stays open and the flight goes on.

        The estimator finishes the received samples; this last estimate is not written to the drone.
        """
        try:
            self.session.close()
        finally:
            self.session.link.close()

    def __enter__(self) -> "Attachment":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def attach(
    cf: OpenCrazyflie,
    vehicle: str | Vehicle = "cf2",
    *,
    push: bool = False,
    policy: str | Policy | None = None,
    dry_run: bool = False,
    window: int = 800,
    every: int = 4,
    monitor: bool | None = None,
    false_alarms_per_hour: float | None = None,
    on_fault: Callable[[Fault], None] | None = None,
) -> Attachment:
    """Estimate mass and inertia of a drone that a script already talks to.

        with crazyem.attach(cf, vehicle="cf2") as drone:
            ...  # fly as before
            print(drone.estimate)

    Args:
        cf: an open, connected cflib Crazyflie (`scf.cf` of a SyncCrazyflie).
        vehicle: preset name, path of a vehicle file, or a Vehicle.
        push: let the guard write estimates to the active controller and the onboard filter.
        policy: of the guard: path of a file or a Policy; None: the shipped one. Pushed values stay in the drone when
            the attachment ends, because the script owns the flight.
        dry_run: with `push`, make decisions (`session.history.guard`), but write nothing.
        window: samples in the window of the estimator. every: samples per update.
        monitor: whether to monitor faults in flight; None: as the policy says.
        false_alarms_per_hour: of the monitor; None: as the policy says.
        on_fault: called with every report of the monitor in the estimator's thread; must return at once.

    Raises:
        UsageError: unknown vehicle, no such policy, not connected, or a log variable is missing. LinkError: no answer.
    """
    from crazyem.estimation.steps import estimator_for
    from crazyem.links.crazyflie import CrazyflieLink
    from crazyem.live.runner import warm_up

    rules = WriteRules(policy if isinstance(policy, Policy) else load_policy(policy), dry_run=dry_run)
    model, left_out = folding.fold(vehicle if isinstance(vehicle, Vehicle) else folding.load(vehicle))
    warm_up(model)
    link = CrazyflieLink.from_crazyflie(cf)
    estimator = estimator_for(model, window=window, every=every)
    watching = monitor_for(model, rules.policy.monitor, enabled=monitor, false_alarms_per_hour=false_alarms_per_hour)
    session = Session(link, vehicle=model, estimator=estimator, monitor=watching, on_fault=on_fault)
    session.history.notice(folding.notice(left_out))
    try:
        session.start()
        if push:
            session.push_to_controller(rules)
            session.pipeline.push_from = -math.inf
    except BaseException:
        Attachment(session).close()
        raise
    return Attachment(session)
