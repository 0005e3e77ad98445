"""Functions shared by `fly`, `watch` and swarms: Ctrl-C, confirmation by the user before a write, and display.

The display is a live view in a terminal, plain lines elsewhere, and a stream for Foxglove.
"""

import argparse
import contextlib
import math
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from crazyem.api.flying import write_rules_for
from crazyem.commands.output import LiveLine, say
from crazyem.errors import UsageError
from crazyem.extras import installed, require
from crazyem.live.flight import Interrupts
from crazyem.live.history import Recorder
from crazyem.live.policy import WriteRules
from crazyem.live.session import Session


@contextlib.contextmanager
def interrupts(counter: Interrupts | None = None) -> Iterator[Interrupts]:
    """Count Ctrl-C instead of raising, so that no exception occurs between two commands to a flying drone."""
    counter = counter or Interrupts()
    if threading.current_thread() is not threading.main_thread():
        yield counter
        return
    before = {s: signal.signal(s, counter) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield counter
    finally:
        for s, handler in before.items():
            signal.signal(s, handler)


def write_rules(arguments: argparse.Namespace, uri: str | None = None, *, name: str = "this drone") -> WriteRules:
    """Policy and mode of the guard: it writes to simulators by default, to drones only with --push or --confirm.

    uri: of the drone; None takes the URI of the command line. name: of the drone, for sentences.

    Raises: UsageError, FileFormatError: the policy cannot be used.
    """
    rules = write_rules_for(
        arguments.uri or "" if uri is None else uri,
        push=arguments.push or arguments.confirm or None,
        dry_run=arguments.dry_run,
        policy=arguments.policy,
    )
    if rules.dry_run and not arguments.dry_run and not arguments.no_push:
        say(f"dry run: nothing is written to {name} until --push (or --confirm) is given")
    return replace(rules, confirm=confirmation_by(name) if arguments.confirm and not rules.dry_run else None)


_TERMINAL_LOCK = threading.Lock()  # one question at a time, from all threads


def confirmation_by(name: str) -> Callable[[str, threading.Event], bool]:
    """A function that asks on the terminal about the drone of this name."""

    def confirm(question: str, ended: threading.Event) -> bool:
        with _TERMINAL_LOCK:
            return confirm_in_terminal(question if name == "this drone" else f"{name}: {question}", ended)

    return confirm


def confirm_in_terminal(question: str, ended: threading.Event) -> bool:
    """Yes or no from standard input; no if there is no terminal input, or once `ended` is set."""
    say(f"{question}\n  push it, and what follows under the policy? [y/N]")
    while not ended.is_set():
        # poll instead of a blocking read: the flight may end before anyone answers
        if select.select([sys.stdin], [], [], 0.2)[0]:
            return sys.stdin.readline().strip().lower() in ("y", "yes")
    return False


def follow(session: Session, stop: Interrupts, duration: float | None, line: LiveLine) -> None:
    """Follow a session until Ctrl-C, or for `duration` [s] of the drone's clock; prints a line each second.

    Raises: CrazyemError: an error of the session.
    """
    begun, shown = math.nan, time.monotonic()
    while not stop.count:
        session.raise_if_failed()
        now = session.clock.newest
        begun = now if math.isnan(begun) else begun
        if duration is not None and now - begun >= duration:
            return
        if time.monotonic() - shown >= 1.0:
            shown = time.monotonic()
            line("flying" if session.pipeline.estimator.airborne else "on the ground", now - begun)
        time.sleep(0.01)


# A recorder and a stream of the same data as one; the text is the prefix of topics if there are several drones.
Stream = Callable[[Recorder | None, str], Recorder | None]


def wants_view(arguments: argparse.Namespace) -> bool:
    """Whether to draw a live view: with --live, or by default if the output is a terminal.

    The view goes to standard error, so that a summary may go to a file. --confirm needs plain lines for its question.

    Raises: UsageError: --live without a terminal, or with --confirm. MissingExtraError: --live without rich.
    """
    if arguments.no_live:
        return False
    drawable = _terminal(sys.stderr) and os.environ.get("TERM") != "dumb"  # a terminal that cannot move its cursor
    if arguments.live:
        require("rich", "--live")
        if not drawable:
            raise UsageError("--live needs a terminal: leave it out, and plain lines are printed.")
        if getattr(arguments, "confirm", False):
            raise UsageError("--confirm asks its question on plain lines: leave out --live.")
        return True
    return drawable and _terminal(sys.stdout) and not getattr(arguments, "confirm", False) and installed("rich")


def _terminal(stream: Any) -> bool:
    try:
        return bool(stream is not None and stream.isatty())
    except (OSError, ValueError):
        return False


class SwarmInterrupts(Interrupts):
    """Ctrl-C for all drones: the first lands them, the second cuts the motors. A landing drone does not land twice.

    Args:
        ones: the interrupts of each drone.
    """

    def __init__(self, ones: Sequence[Interrupts]) -> None:
        super().__init__()
        self.ones = list(ones)

    def __call__(self, *_: object) -> None:
        self.count += 1
        for one in self.ones:
            one.count = max(one.count, self.count)


class Viewed:
    """Observer and controls of a running drone for the view."""

    def __init__(self, session: Any, line: LiveLine, *, name: str, land: Callable[[], None] | None = None) -> None:
        from crazyem.live.views import Observer, SessionControls

        self.line = line
        self.ended = ""
        self.observer = Observer(session, name=name, phase=lambda: (line.phase, line.seconds), ended=lambda: self.ended)
        self.controls = SessionControls(session, name=name, land=land)


@contextlib.contextmanager
def live_view(wanted: bool, drones: Callable[[], Sequence[Viewed]]) -> Iterator[Callable[[], bool]]:
    """Show the dashboard during the block; yields a function: is it visible now? (q ends it, plain lines take over.)

    Args:
        drones: returns the running drones; called in the dashboard's thread.
    """
    if not wanted:
        yield lambda: False
        return
    from crazyem.live.dashboard import Dashboard, terminal_console

    dashboard = Dashboard(
        lambda: [d.observer.snapshot() for d in drones()],
        lambda: [d.controls for d in drones()],
        console=terminal_console(sys.stderr),
    )
    with dashboard:
        yield lambda: dashboard.showing
    if dashboard.failure:
        say(dashboard.failure)


@contextlib.contextmanager
def live_stream(port: int | None) -> Iterator[Stream]:
    """A server for Foxglove during the block, unless `port` is None; yields the function that adds the stream."""
    if port is None:
        yield lambda recorder, name: recorder
        return
    from crazyem.live.foxglove import Both, FoxgloveServer

    with FoxgloveServer(port) as server:
        say(f"live for Foxglove at {server.url} (layout: crazyem layout)")

        def with_stream(recorder: Recorder | None, name: str) -> Any:
            return Both(recorder, server.recorder(name))

        yield with_stream
