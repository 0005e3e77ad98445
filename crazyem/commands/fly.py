"""`crazyem fly`: fly a drone, or the simulated firmware, and estimate its mass and inertia in flight."""

import argparse
import contextlib
from collections.abc import Iterator

from crazyem.api.flying import FlightObserver, FlightSettings, Progress, observed_flight
from crazyem.commands.flights import (
    Stream,
    SwarmInterrupts,
    Viewed,
    interrupts,
    live_stream,
    live_view,
    wants_view,
    write_rules,
)
from crazyem.commands.output import LiveLine, plot_path, report, say
from crazyem.control.named_trajectories import duration_note, trajectory_maker
from crazyem.errors import CrazyemError
from crazyem.live.flight import FlightInterruptedError, Interrupts, MotorsCutError
from crazyem.live.history import Recorder
from crazyem.live.session import Session
from crazyem.live.summary import check_writable
from crazyem.physics import folding


def run(arguments: argparse.Namespace) -> int:
    """The command; returns the exit code, raises CrazyemError for errors that the user can cause."""
    if arguments.uris or arguments.swarm:
        from crazyem.commands.swarm import fly as fly_many

        return fly_many(arguments)
    same = ("uri", "controller", "duration", "record", "append", "scenario", "seed", "speed", "rate", "reconnect",
            "window", "every", "monitor", "false_alarms_per_hour")  # fmt: skip
    settings = FlightSettings(
        vehicle=folding.load(arguments.vehicle),
        trajectory=tuple(arguments.trajectory),
        goal=arguments.goal / 100,
        push=not arguments.no_push,
        rules=write_rules(arguments),
        **{name: getattr(arguments, name) for name in same},
    )
    if arguments.trajectory != ["informative"]:
        trajectory_maker(arguments.trajectory, arguments.duration)  # raises here if invalid
        if note := duration_note(arguments.trajectory, arguments.duration):
            say(note)
    plot = plot_path(arguments, arguments.record, arguments.json)
    for path in (arguments.json, arguments.record, plot):
        check_writable(path)
    view = wants_view(arguments)
    with contextlib.ExitStack() as stack:
        stream = stack.enter_context(live_stream(arguments.foxglove))
        result, error = observed_flight(settings, _OnTheTerminal(view, stream, stack))
        if result is not None:
            try:
                report(arguments, result, plot=plot)
            except CrazyemError as failed:
                error = error or failed
    if isinstance(error, FlightInterruptedError | MotorsCutError):
        say("crazyem: landed on request." if isinstance(error, FlightInterruptedError) else "crazyem: motors cut.")
        return 130
    if error is not None:
        raise error
    return 0


class _OnTheTerminal(FlightObserver):
    """Observer that shows lines or a live view, streams to Foxglove, and handles Ctrl-C."""

    def __init__(self, view: bool, stream: Stream, stack: contextlib.ExitStack) -> None:
        self._view, self._stream, self._stack = view, stream, stack

    def say(self, sentence: str) -> None:
        say(sentence)

    def recorder(self, recorder: Recorder | None) -> Recorder | None:
        return self._stream(recorder, "")

    def interrupts(self) -> Interrupts:
        one = Interrupts()
        self._stack.enter_context(interrupts(SwarmInterrupts([one])))  # until the results are on the disk
        return one

    @contextlib.contextmanager
    def progress(self, session: Session, interrupts: Interrupts) -> Iterator[Progress]:
        line = LiveLine(session)
        shown = [Viewed(session, line, name=session.vehicle.name, land=interrupts.land)]
        with live_view(self._view, lambda: shown) as line.quiet:
            yield line
