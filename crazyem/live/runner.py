"""Functions from a URI to the result of a session, common to `fly` and `watch`."""

import contextlib
from collections.abc import Callable, Mapping
from typing import Any

from crazyem.errors import CrazyemError
from crazyem.links import open_link
from crazyem.links.base import Link
from crazyem.live.flight_monitor import FlightMonitor
from crazyem.live.flight_result import FlightResult, result_of
from crazyem.live.pipeline import Estimator
from crazyem.live.recorder import Recorder, close_recorder, open_recorder
from crazyem.live.scheduler import Scheduler
from crazyem.live.session import Session
from crazyem.monitoring.fault import Fault
from crazyem.physics import folding
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
    statistics = session.link.statistics()
    if session.recorder is not None:
        close_recorder(session.recorder, statistics, session.history)
    try:
        result = result_of(
            session.pipeline, session.vehicle, title=title, log=log, received=statistics.received,
            lost=statistics.lost, extra={**extra, "late": statistics.late},
        )  # fmt: skip
    except CrazyemError as late:
        return None, error or late
    return result, error
