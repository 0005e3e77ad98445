"""Functions shared by the commands: write results to files and terminal."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from crazyem.extras import MissingExtraError, require
from crazyem.live.flight_result import FlightResult, live_line, write_json
from crazyem.live.history import History
from crazyem.monitoring.fault import Fault
from crazyem.vehicle import Vehicle


def say(line: str) -> None:
    """Print progress to standard error, so that `--json -` leaves standard output to the summary."""
    print(f"{line}\n", end="", file=sys.stderr, flush=True)  # one write, so that lines of several threads do not mix


def names_in(text: str | None) -> tuple[str, ...]:
    """The names in a list with commas."""
    return tuple(name for part in (text or "").split(",") if (name := part.strip()))


class LiveLine:
    """Prints a line about a session each second, and keeps phase and seconds for the live view.

    Attributes:
        quiet: returns whether the live view shows the session now, so that no line is printed.
    """

    def __init__(self, session: Any, *, prefix: str = "") -> None:
        self.session, self.prefix = session, prefix
        self.quiet: Callable[[], bool] = lambda: False
        self.phase, self.seconds = "connected", 0.0
        self._news = News(prefix)

    def __call__(self, phase: str, seconds: float) -> None:
        self.phase, self.seconds = phase, seconds
        history: History = self.session.history
        lost = self.session.link.statistics().lost
        history.losses.append((self.session.clock.newest, lost))
        if not self.quiet():
            say(self.prefix + live_line(phase, seconds, self.session.estimate, lost=lost, pushes=len(history.pushes)))
            self._news.steps(history)
            self._news.faults(history)


class News:
    """Prints a line for each step of mass and each fault of a history that it has not printed yet."""

    def __init__(self, prefix: str = "") -> None:
        self.prefix = prefix
        self._steps = 0
        self._faults: tuple[Fault, ...] = ()

    def steps(self, history: History) -> None:
        """The steps of mass whose cause is known."""
        for step in history.steps[self._steps :]:
            if step.real is None:
                break
            self._steps += 1
            if step.real:
                say(f"{self.prefix}{step}")

    def faults(self, history: History) -> None:
        """The faults; a fault appears again once its estimated size has settled."""
        before, self._faults = self._faults, history.faults
        if self._faults is before:
            return
        for fault in self._faults:
            if fault not in before:
                say(f"{self.prefix}fault: {fault}")


def plot_path(arguments: argparse.Namespace, *others: str | None) -> str | None:
    """--plot, or a PNG beside the recording or the summary; None without such a file or without matplotlib.

    Raises: MissingExtraError: --plot without matplotlib.
    """
    if arguments.plot:
        require("matplotlib", "--plot")
        return str(arguments.plot)
    for other in others:
        if other and other != "-" and Path(other).name:
            try:
                require("matplotlib", "The summary plot")
            except MissingExtraError as error:
                say(str(error))
                return None
            name = Path(other).name
            for suffix in (".csv.gz", ".csv", ".mcap", ".json"):
                name = name.removesuffix(suffix)
            return str(Path(other).with_name(f"{name}.png"))
    return None


def report(arguments: argparse.Namespace, result: FlightResult, *, plot: str | None) -> None:
    """Print the summary; write JSON and plot if requested. Raises UsageError: a file cannot be written."""
    text = str(result)
    if arguments.json == "-":
        say(text)
    else:
        print(text, flush=True)
    if arguments.json:
        write_json({**result.summary, "plot": plot}, arguments.json)
    if plot is not None:
        result.plot(plot)
    files = {"plot": plot, "summary": arguments.json if arguments.json != "-" else None}
    if written := [f"{what}: {file}" for what, file in files.items() if file is not None]:
        say("   ".join(written))


def new_estimator(vehicle: Vehicle, arguments: argparse.Namespace, *, crazyflie: bool = True) -> Any:
    """The estimator with the window of the command line; `crazyflie`: attitudes come from the Crazyflie's filter."""
    from crazyem.estimation.steps import estimator_for

    return estimator_for(vehicle, window=arguments.window, every=arguments.every, crazyflie=crazyflie)


def compile_kernels(vehicle: Vehicle) -> None:
    """Compile the estimator before flight, and print a line if compiling was necessary."""
    from crazyem.live.runner import warm_up

    if seconds := warm_up(vehicle):
        say(f"compiled the estimator in {seconds:.0f} s (once per installation)")
