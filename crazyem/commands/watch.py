"""`crazyem watch URI`: estimates of a drone somebody else flies; commands nothing, writes no parameter."""

import argparse
import contextlib
import math
import time

from crazyem.commands.common import (
    LiveLine,
    close_recorder,
    compile_kernels,
    new_estimator,
    plot_path,
    raise_after,
    report,
    say,
)
from crazyem.commands.fly import interrupts
from crazyem.errors import CrazyemError
from crazyem.links import open_link
from crazyem.live.mcap_recorder import open_recorder
from crazyem.live.session import Session
from crazyem.live.summary import check_writable
from crazyem.vehicle import load_vehicle


def run(arguments: argparse.Namespace) -> int:
    """Until Ctrl-C, --duration, or the drone is gone; then the summary."""
    vehicle = load_vehicle(arguments.vehicle)
    plot = plot_path(arguments, arguments.record, arguments.json)
    for path in (arguments.json, arguments.record, plot):
        check_writable(path)
    new_estimator(vehicle, arguments)
    compile_kernels(vehicle)
    error: BaseException | None = None
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(interrupts())
        link = open_link(arguments.uri)
        stack.callback(link.close)
        link.connect()
        say(f"watching {arguments.uri} (Ctrl-C ends)")
        configuration = {
            "command": "watch", "uri": arguments.uri, "window": arguments.window, "every": arguments.every,
        }  # fmt: skip
        recorder = open_recorder(
            arguments.record, configuration=configuration, vehicle=vehicle, link=link, append=arguments.append
        )
        if recorder is not None:
            stack.callback(recorder.close)
        session = Session(link, vehicle=vehicle, estimator=new_estimator(vehicle, arguments), recorder=recorder)
        stack.callback(session.close)
        try:
            session.start()
            _watch(session, stop, arguments.duration)
        except CrazyemError as e:
            error = e
            session.history.notice(str(e))
        session.close()
        statistics = link.statistics()
        if recorder is not None:
            close_recorder(recorder, statistics, session.history)
        try:
            report(
                arguments,
                pipeline=session.pipeline,
                vehicle=vehicle,
                log=arguments.record,
                plot=plot,
                title=f"crazyem watch {arguments.uri}, vehicle {vehicle.name}",
                received=statistics.received,
                lost=statistics.lost,
                extra={"uri": arguments.uri, "late": statistics.late},
            )
        except CrazyemError as e:
            error = error or e
    raise_after(error)
    return 0


def _watch(session: Session, stop: object, duration: float | None) -> None:
    line = LiveLine(session)
    begun, shown = math.nan, time.monotonic()
    while not getattr(stop, "count", 0):
        session.raise_if_failed()
        now = session.clock.newest
        begun = now if math.isnan(begun) else begun
        if duration is not None and now - begun >= duration:
            return
        if time.monotonic() - shown >= 1.0:
            shown = time.monotonic()
            line("flying" if session.pipeline.estimator.airborne else "on the ground", now - begun)
        time.sleep(0.01)
