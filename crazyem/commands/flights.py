"""What `fly`, `watch` and swarms share: trajectories by their words, Ctrl-C, and who is asked before a write."""

import argparse
import contextlib
import math
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

from crazyem.commands.common import LiveLine, say
from crazyem.control.trajectories import Trajectory, Vector, excite, figure8, hover
from crazyem.control.waypoints import read_waypoints, waypoints
from crazyem.errors import UsageError
from crazyem.live.flight import Interrupts
from crazyem.live.policy import load_policy
from crazyem.live.session import Session
from crazyem.live.write_supervisor import WriteRules

DEFAULT_HEIGHT = 1.0  # m
SIMPLE_TRAJECTORIES = {"hover": hover, "figure8": figure8, "excite": excite}


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
    if name not in SIMPLE_TRAJECTORIES or rest:
        raise UsageError(f"unknown trajectory '{' '.join(words)}' (hover, figure8, excite, or waypoints FILE).")
    make: Any = SIMPLE_TRAJECTORIES[name]
    return lambda position, yaw: make(position=position, yaw=yaw, duration=duration)


def duration_note(words: list[str], duration: float) -> str:
    """One line where the trajectory of these words takes another time than asked for, "" where it does not."""
    make: Any = SIMPLE_TRAJECTORIES.get(words[0])
    made = duration if make is None else make(position=(0.0, 0.0, DEFAULT_HEIGHT), duration=duration).duration
    if math.isclose(made, duration):
        return ""
    return f"{words[0]} flies whole periods and ends where it began: {made:g} s instead of {duration:g} s"


@contextlib.contextmanager
def interrupts(counter: Interrupts | None = None) -> Iterator[Interrupts]:
    """Ctrl-C counts instead of raising, so that it can never hit between two commands to a flying drone."""
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


def simulated(uri: str) -> bool:
    """Whether a URI is a simulator's: UDP on this host, or none at all, which starts one. All else may be a drone."""
    if not uri:
        return True
    try:
        parts = urlsplit(uri)
        return parts.scheme == "udp" and parts.hostname == "127.0.0.1"
    except ValueError:
        return False


def write_rules(arguments: argparse.Namespace, uri: str | None = None, *, name: str = "this drone") -> WriteRules:
    """Policy and mode of the guard: simulators are written to, drones only after --push or --confirm.

    Args:
        uri: of the drone; None takes that of the command line.
        name: of the drone, for sentences.

    Raises:
        UsageError, FileFormatError: the policy cannot be used.
    """
    policy = load_policy(arguments.policy)
    meant = arguments.push or arguments.confirm or simulated(arguments.uri or "" if uri is None else uri)
    dry_run = arguments.dry_run or not meant
    if dry_run and not arguments.dry_run and not arguments.no_push:
        say(f"dry run: nothing is written to {name} until --push (or --confirm) is given")
    return WriteRules(
        policy, dry_run=dry_run, confirm=confirmation_by(name) if arguments.confirm and not dry_run else None
    )


_TERMINAL_LOCK = threading.Lock()  # one question at a time, whoever asks


def confirmation_by(name: str) -> Callable[[str, threading.Event], bool]:
    """Asks on the terminal about a drone of that name."""

    def confirm(question: str, ended: threading.Event) -> bool:
        with _TERMINAL_LOCK:
            return confirm_in_terminal(question if name == "this drone" else f"{name}: {question}", ended)

    return confirm


def confirm_in_terminal(question: str, ended: threading.Event) -> bool:
    """Yes or no from standard input; no where there is none, or once `ended` is set."""
    say(f"{question}\n  push it, and what follows under the policy? [y/N]")
    while not ended.is_set():
        # Never blocked in a read: the flight may end before anyone answers.
        if select.select([sys.stdin], [], [], 0.2)[0]:
            return sys.stdin.readline().strip().lower() in ("y", "yes")
    return False


def follow(session: Session, stop: object, duration: float | None, line: LiveLine) -> None:
    """Until Ctrl-C, or `duration` [s] of the drone's clock; a line a second.

    Raises:
        CrazyemError: what went wrong in the session.
    """
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
