"""Functions shared by the commands: write results to files and terminal, and raise errors after writing."""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from crazyem.extras import MissingExtraError, require
from crazyem.live.flight_result import FlightResult
from crazyem.live.history import History
from crazyem.live.summary import live_line, write_json
from crazyem.monitoring.fault import Fault
from crazyem.vehicle import Vehicle


def say(line: str) -> None:
    """Print progress to standard error, so that `--json -` leaves standard output to the summary."""
    print(f"{line}\n", end="", file=sys.stderr, flush=True)  # one write, so that lines of several threads do not mix


class LiveLine:
    """Prints a line about a session each second, and keeps phase and seconds for the live view.

    Attributes:
        quiet: returns whether the live view shows the session now, so that no line is printed.
    """

    def __init__(self, session: Any, *, prefix: str = "") -> None:
        self.session, self.prefix = session, prefix
        self.quiet: Callable[[], bool] = lambda: False
        self.phase, self.seconds = "connected", 0.0
        self._steps_said = 0
        self._faults_said: Sequence[Fault] = ()

    def __call__(self, phase: str, seconds: float) -> None:
        self.phase, self.seconds = phase, seconds
        history: History = self.session.history
        lost = self.session.link.statistics().lost
        history.losses.append((self.session.clock.newest, lost))
        if not self.quiet():
            say(self.prefix + live_line(phase, seconds, self.session.estimate, lost=lost, pushes=len(history.pushes)))
            self._steps_said = say_steps(history, self._steps_said, prefix=self.prefix)
            self._faults_said = say_faults(history, self._faults_said, prefix=self.prefix)


def say_steps(history: History, told: int, *, prefix: str = "") -> int:
    """Print a line for each decided step of mass after the first `told` steps; returns the new number of told steps."""
    for step in history.steps[told:]:
        if step.real is None:
            break
        told += 1
        if step.real:
            say(f"{prefix}{step}")
    return told


def say_faults(history: History, told: Sequence[Fault], *, prefix: str = "") -> Sequence[Fault]:
    """Print a line for each fault not in `told`; a fault appears again once its estimated size has settled."""
    faults = history.faults
    for fault in faults:
        if fault not in told:
            say(f"{prefix}fault: {fault}")
    return faults


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
    files = {"summary": arguments.json} if arguments.json not in (None, "-") else {}
    if plot is not None:
        result.plot(plot)
        files = {"plot": plot, **files}
    if files:
        say("   ".join(f"{what}: {file}" for what, file in files.items()))


def raise_after(error: BaseException | None) -> None:
    """Raise the error that ended a flight; called after its results are on disk."""
    if error is not None:
        raise error


def new_estimator(vehicle: Vehicle, arguments: argparse.Namespace, *, crazyflie: bool = True) -> Any:
    """The estimator with the window of the command line; `crazyflie`: attitudes come from the Crazyflie's filter."""
    from crazyem.estimation.steps import estimator_for

    return estimator_for(vehicle, window=arguments.window, every=arguments.every, crazyflie=crazyflie)


def compile_kernels(vehicle: Vehicle) -> None:
    """Compile the estimator before flight, and print a line if compiling was necessary."""
    from crazyem.live.warm_up import warm_up

    if seconds := warm_up(vehicle):
        say(f"compiled the estimator in {seconds:.0f} s (once per installation)")
