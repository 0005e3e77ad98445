"""`crazyem fly`: fly a drone, or the simulated firmware, and let it learn its own mass and inertia on the way."""

import argparse
import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

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
from crazyem.control.trajectories import Trajectory, Vector, excite, figure8, hover
from crazyem.control.waypoints import read_waypoints, waypoints
from crazyem.errors import CrazyemError, UsageError
from crazyem.links import open_link
from crazyem.live.controllers import controller_named
from crazyem.live.flight import Flight, FlightInterruptedError, FlightPlan, Interrupts, MotorsCutError
from crazyem.live.mcap_recorder import open_recorder
from crazyem.live.session import Session
from crazyem.live.simulator import Simulator
from crazyem.live.summary import check_writable
from crazyem.vehicle import load_vehicle

HEIGHT = 1.0  # m
SIMPLE = {"hover": hover, "figure8": figure8, "excite": excite}


def trajectory_maker(words: list[str], duration: float) -> Callable[[Vector, float], Trajectory]:
    """From the words after --trajectory to a maker of trajectories.

    Raises:
        UsageError: an unknown name or a missing file name. FileFormatError: waypoints that cannot be used.
    """
    name, *rest = words
    if name == "waypoints":
        if len(rest) != 1:
            raise UsageError("--trajectory waypoints needs one FILE.")
        read_waypoints(rest[0])  # complain before anything is started
        return lambda position, yaw: waypoints(path=rest[0], position=position, yaw=yaw)
    if name not in SIMPLE or rest:
        raise UsageError(f"unknown trajectory '{' '.join(words)}' (hover, figure8, excite, or waypoints FILE).")
    make: Any = SIMPLE[name]
    return lambda position, yaw: make(position=position, yaw=yaw, duration=duration)


@contextlib.contextmanager
def interrupts() -> Iterator[Interrupts]:
    """Ctrl-C counts instead of raising, so that it can never hit between two commands to a flying drone."""
    counter = Interrupts()
    if threading.current_thread() is not threading.main_thread():
        yield counter
        return
    before = {s: signal.signal(s, counter) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield counter
    finally:
        for s, handler in before.items():
            signal.signal(s, handler)


def run(arguments: argparse.Namespace) -> int:
    """The command; returns the exit code, raises CrazyemError for errors of the user's."""
    vehicle = load_vehicle(arguments.vehicle)
    controller = controller_named(arguments.controller)
    plan = FlightPlan(
        trajectory=trajectory_maker(arguments.trajectory, arguments.duration),
        controller=controller,
        height=HEIGHT,
        push=not arguments.no_push,
    )
    plot = plot_path(arguments, arguments.record, arguments.json)
    for path in (arguments.json, arguments.record, plot):
        check_writable(path)
    new_estimator(vehicle, arguments)  # a wrong window is refused here
    if arguments.uri and (arguments.scenario or arguments.speed is not None or arguments.seed is not None):
        raise UsageError("--scenario, --seed and --speed belong to the built-in simulator: leave out the URI.")
    compile_kernels(vehicle)
    with contextlib.ExitStack() as stack:
        uri = arguments.uri
        if not uri:
            simulator = Simulator(scenario=arguments.scenario, seed=arguments.seed or 0, speed=arguments.speed or 1.0)
            uri = stack.enter_context(simulator).uri
            say(f"simulated firmware at {uri}")
        return _fly(arguments, plan=plan, vehicle=vehicle, uri=uri, plot=plot)


def _fly(arguments: argparse.Namespace, *, plan: FlightPlan, vehicle: Any, uri: str, plot: str) -> int:
    error: BaseException | None = None
    with contextlib.ExitStack() as stack:
        # Outermost, so that even a Ctrl-C while connecting or closing ends in order.
        stop = stack.enter_context(interrupts())
        link = open_link(uri)
        stack.callback(link.close)
        link.connect()
        say(f"connected to {uri}: {len(link.log_variables)} log variables, {len(link.parameters)} parameters")
        configuration = {
            "command": "fly",
            "uri": uri,
            "controller": plan.controller.name,
            "trajectory": " ".join(arguments.trajectory),
            "duration": arguments.duration,
            "window": arguments.window,
            "every": arguments.every,
            "push": plan.push,
            "seed": arguments.seed or 0 if not arguments.uri else None,
        }
        recorder = open_recorder(
            arguments.record, configuration=configuration, vehicle=vehicle, link=link, append=arguments.append
        )
        if recorder is not None:
            stack.callback(recorder.close)
        session = Session(
            link,
            vehicle=vehicle,
            estimator=new_estimator(vehicle, arguments),
            recorder=recorder,
            wrench=plan.controller.wrench,
        )
        stack.callback(session.close)
        try:
            session.start()
            Flight(session, plan, interrupts=stop, progress=LiveLine(session)).fly()
        except (FlightInterruptedError, MotorsCutError) as e:
            error = e
            session.history.notice("the flight was ended by the user.")
        except CrazyemError as e:
            error = e
            session.history.notice(str(e))
        session.close()
        statistics = link.statistics()
        if recorder is not None:
            close_recorder(recorder, statistics, session.history)
        extra = {k: configuration[k] for k in ("uri", "controller", "trajectory", "seed")}
        try:
            report(
                arguments,
                pipeline=session.pipeline,
                vehicle=vehicle,
                log=arguments.record,
                plot=plot,
                title=f"crazyem fly: {' '.join(arguments.trajectory)}, {plan.controller.name}, vehicle {vehicle.name}",
                received=statistics.received,
                lost=statistics.lost,
                extra={**extra, "late": statistics.late},
            )
        except CrazyemError as e:
            error = error or e
    if isinstance(error, FlightInterruptedError | MotorsCutError):
        say("crazyem: landed on request." if isinstance(error, FlightInterruptedError) else "crazyem: motors cut.")
        return 130
    raise_after(error)
    return 0
