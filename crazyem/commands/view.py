"""Display of a running command: a live view in a terminal, plain lines elsewhere, and a stream for Foxglove."""

import argparse
import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from crazyem.commands.common import LiveLine, say
from crazyem.errors import UsageError
from crazyem.extras import installed, require
from crazyem.live.flight import Interrupts
from crazyem.live.recorder import Recorder

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
