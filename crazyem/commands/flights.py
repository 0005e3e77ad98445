"""Functions shared by `fly`, `watch` and swarms: Ctrl-C, and confirmation by the user before a write."""

import argparse
import contextlib
import math
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

from crazyem.api.flying import write_rules_for
from crazyem.commands.common import LiveLine, say
from crazyem.live.flight import Interrupts
from crazyem.live.session import Session
from crazyem.live.write_supervisor import WriteRules


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
