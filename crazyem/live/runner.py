"""Functions from a URI to the result of a session, common to `fly` and `watch`, and the compilation before a flight.

A compilation in flight would stop all Python threads, also setpoints, for seconds.
"""

import contextlib
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

from crazyem.compiled import compilations
from crazyem.errors import CrazyemError
from crazyem.estimation.in_step import PERIOD
from crazyem.estimation.online import OnlineEstimator
from crazyem.links import open_link
from crazyem.links.base import Link
from crazyem.live.flight_monitor import FlightMonitor
from crazyem.live.flight_result import FlightResult, result_of
from crazyem.live.history import Recorder, open_recorder
from crazyem.live.pipeline import Estimator
from crazyem.live.policy import FaultRules
from crazyem.live.scheduler import Scheduler
from crazyem.live.session import Session
from crazyem.monitoring.fault import Fault
from crazyem.physics import folding
from crazyem.signals.sample import Sample
from crazyem.vehicle import Vehicle


def connect(stack: contextlib.ExitStack, uri: str) -> Link:
    """A connected link that `stack` closes. Raises UsageError, LinkError."""
    link = open_link(uri)
    stack.callback(link.close)
    link.connect()
    return link


def open_session(
    stack: contextlib.ExitStack,
    link: Link,
    *,
    vehicle: Vehicle,
    left_out: list[str],
    estimator: Estimator,
    configuration: Mapping[str, Any],
    record: str | None,
    append: bool,
    rate: float,
    reconnect: float,
    wrench: str = "ctrlLee",
    wrap: Callable[[Recorder | None], Recorder | None] = lambda recorder: recorder,
    scheduler: Scheduler | None = None,
    monitor: FlightMonitor | None = None,
    on_fault: Callable[[Fault], None] | None = None,
) -> Session:
    """A session with its recording, not yet started; `stack` closes both.

    Args:
        left_out: effects of the vehicle file that the estimator does not know.
        configuration, record, append: see `open_recorder`.
        rate, reconnect, wrench, scheduler, monitor, on_fault: see `Session`.
        wrap: adds other receivers of the recorder's messages, such as a live stream.
    """
    recorder = wrap(open_recorder(record, configuration=configuration, vehicle=vehicle, link=link, append=append))
    if recorder is not None:
        stack.callback(recorder.close)
    session = Session(
        link, vehicle=vehicle, estimator=estimator, recorder=recorder, wrench=wrench, rate=rate,
        reconnect_within=reconnect, scheduler=scheduler, monitor=monitor, on_fault=on_fault,
    )  # fmt: skip
    stack.callback(session.close)
    session.history.notice(folding.notice(left_out))
    return session


def finished(
    session: Session, *, title: str, log: str | None, extra: Mapping[str, Any], error: BaseException | None
) -> tuple[FlightResult | None, BaseException | None]:
    """Close the recording of a closed session; returns its result and the first error (`error`, or the result's)."""
    statistics, recorder = session.link.statistics(), session.recorder
    if recorder is not None:
        counts = ("received", "lost", "late", "duplicates")
        recorder.metadata("statistics", {n: str(getattr(statistics, n)) for n in counts})
        recorder.close()
        session.history.notice(recorder.failure)
    try:
        result = result_of(
            session.pipeline, session.vehicle, title=title, log=log, received=statistics.received,
            lost=statistics.lost, extra={**extra, "late": statistics.late},
        )  # fmt: skip
    except CrazyemError as late:
        return None, error or late
    return result, error


def warm_up(vehicle: Vehicle) -> float:
    """Run every kernel once; returns the seconds if any kernel was compiled, 0.0 if all came from the disk."""
    begun, before = time.monotonic(), compilations()
    estimator = OnlineEstimator(vehicle, window=100, every=4, prediction_period=PERIOD)
    monitor = FlightMonitor(vehicle, FaultRules())
    monitor.watch(estimator)
    hover = 0.5
    try:
        for i in range(160):
            t = PERIOD * i
            s = 0.01 * math.sin(7 * t)
            for name, value in (
                ("flying", (1.0,)),
                ("voltage", (3.9,)),
                ("motor_command", (hover + s, hover - s, hover + 2 * s, hover - 2 * s)),
                ("position", (s, -s, 1.0 + s)),
                ("velocity", (7 * s, 7 * s, s)),
                ("attitude", (s, s, s, math.sqrt(1 - 3 * s * s))),
                ("body_rate", (s, s, s)),
                ("specific_force", (s, s, 9.81)),
            ):
                sample = Sample(name, t, value)
                monitor.take(sample, airborne=False)
                estimator.feed(sample)
        estimator.finish()
    except CrazyemError:
        pass  # these artificial data may be refused; only the compilation matters
    return time.monotonic() - begun if compilations() > before else 0.0
