"""`crazyem fly`: fly a drone, or the simulated firmware, and let it learn its own mass and inertia on the way."""

import argparse
import contextlib
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
from crazyem.commands.flights import DEFAULT_HEIGHT, duration_note, interrupts, trajectory_maker, write_rules
from crazyem.commands.view import Streams, SwarmInterrupts, Viewed, landing, live_view, wants_view
from crazyem.errors import CrazyemError, UsageError
from crazyem.links import open_link
from crazyem.live.controllers import controller_named
from crazyem.live.flight import Flight, FlightInterruptedError, FlightPlan, Interrupts, MotorsCutError
from crazyem.live.mcap_recorder import open_recorder
from crazyem.live.session import Session
from crazyem.live.simulator import Simulator
from crazyem.live.summary import check_writable
from crazyem.physics import folding


def run(arguments: argparse.Namespace) -> int:
    """The command; returns the exit code, raises CrazyemError for errors of the user's."""
    if arguments.uris or arguments.swarm:
        from crazyem.commands.swarm import fly as fly_many

        return fly_many(arguments)
    if (arguments.uri or "").startswith("mavlink:"):
        raise UsageError("a MAVLink drone is flown by its own ground station: use crazyem watch, with --push to write.")
    vehicle, left_out = folding.fold(folding.load(arguments.vehicle))
    controller = controller_named(arguments.controller)
    plan = FlightPlan(
        trajectory=trajectory_maker(arguments.trajectory, arguments.duration),
        controller=controller,
        height=DEFAULT_HEIGHT,
        push=not arguments.no_push,
        rules=write_rules(arguments),
    )
    if note := duration_note(arguments.trajectory, arguments.duration):
        say(note)
    plot = plot_path(arguments, arguments.record, arguments.json)
    for path in (arguments.json, arguments.record, plot):
        check_writable(path)
    new_estimator(vehicle, arguments)  # a wrong window is refused here
    view = wants_view(arguments)
    if arguments.uri and (arguments.scenario or arguments.speed is not None or arguments.seed is not None):
        raise UsageError("--scenario, --seed and --speed belong to the built-in simulator: leave out the URI.")
    with contextlib.ExitStack() as stack:
        simulator = None
        if not arguments.uri:
            simulator = Simulator(scenario=arguments.scenario, seed=arguments.seed or 0, speed=arguments.speed or 1.0)
            stack.callback(simulator.stop)
            simulator.launch()  # both may have to compile: side by side
        compile_kernels(vehicle)
        uri = arguments.uri
        if simulator is not None:
            uri = simulator.start()
            say(f"simulated firmware at {uri}")
        return _fly(arguments, plan=plan, vehicle=vehicle, left_out=left_out, uri=uri, plot=plot, view=view)


def _fly(
    arguments: argparse.Namespace,
    *,
    plan: FlightPlan,
    vehicle: Any,
    left_out: list[str],
    uri: str,
    plot: str | None,
    view: bool,
) -> int:
    error: BaseException | None = None
    with contextlib.ExitStack() as stack:
        # Outermost, so that even a Ctrl-C while connecting or closing ends in order.
        one = Interrupts()
        stack.enter_context(interrupts(SwarmInterrupts([one])))
        streams = stack.enter_context(Streams(arguments.foxglove))
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
            "rate": arguments.rate,
            "window": arguments.window,
            "every": arguments.every,
            "push": plan.push,
            "guard": plan.rules.mode if plan.push and plan.rules is not None else "no push",
            "seed": arguments.seed or 0 if not arguments.uri else None,
        }
        recorder = open_recorder(
            arguments.record, configuration=configuration, vehicle=vehicle, link=link, append=arguments.append
        )
        recorder = streams.with_stream(recorder)
        if recorder is not None:
            stack.callback(recorder.close)
        session = Session(
            link,
            vehicle=vehicle,
            estimator=new_estimator(vehicle, arguments),
            recorder=recorder,
            wrench=plan.controller.wrench,
            rate=arguments.rate,
            reconnect_within=arguments.reconnect,
        )
        stack.callback(session.close)
        session.history.notice(folding.notice(left_out))
        line = LiveLine(session)
        shown = [Viewed(session, line, name=vehicle.name, land=landing(one))]
        try:
            session.start()
            with live_view(view, lambda: shown) as line.quiet:
                Flight(session, plan, interrupts=one, progress=line).fly()
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
