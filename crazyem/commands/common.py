"""What the commands share: results to files and terminal, and errors that wait until those are written."""

import argparse
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from crazyem.estimation.result import Estimate
from crazyem.links.base import LinkStatistics
from crazyem.live.history import History
from crazyem.live.pipeline import Pipeline
from crazyem.live.recorder import Recorder
from crazyem.live.summary import build_summary, live_line, text_summary, write_json
from crazyem.vehicle import Vehicle


def say(line: str) -> None:
    """Progress goes to standard error, so that `--json -` leaves standard output to the summary."""
    print(f"{line}\n", end="", file=sys.stderr, flush=True)  # in one piece, whoever else prints


class LiveLine:
    """Prints a line each second about a session, and remembers what it was told for the live view.

    Attributes:
        quiet: whether something else shows it now.
    """

    def __init__(self, session: Any, *, prefix: str = "", quiet: Callable[[], bool] = lambda: False) -> None:
        self.session = session
        self.prefix, self.quiet = prefix, quiet
        self.phase, self.seconds = "connected", 0.0
        self._steps_said = 0

    def __call__(self, phase: str, seconds: float) -> None:
        self.phase, self.seconds = phase, seconds
        history: History = self.session.history
        lost = self.session.link.statistics().lost
        history.losses.append((self.session.clock.newest, lost))
        if not self.quiet():
            say(self.prefix + live_line(phase, seconds, self.session.estimate, lost=lost, pushes=len(history.pushes)))
            self._steps_said = say_steps(history, self._steps_said, prefix=self.prefix)


def say_steps(history: History, told: int, *, prefix: str = "") -> int:
    """A line for each step of mass that was decided since `told` of them were; returns how many are told now."""
    for step in history.steps[told:]:
        if step.real is None:
            break
        told += 1
        if step.real:
            say(f"{prefix}{step}")
    return told


def plot_path(arguments: argparse.Namespace, *others: str | None) -> str | None:
    """--plot, or a PNG beside the recording or the summary; None where no file was asked for."""
    if arguments.plot:
        return str(arguments.plot)
    for other in others:
        if other and other != "-" and Path(other).name:
            name = Path(other).name
            for suffix in (".csv.gz", ".csv", ".mcap", ".json"):
                name = name.removesuffix(suffix)
            return str(Path(other).with_name(f"{name}.png"))
    return None


def report(
    arguments: argparse.Namespace,
    *,
    pipeline: Pipeline,
    vehicle: Vehicle,
    log: str | None,
    plot: str | None,
    title: str,
    received: int,
    lost: int,
    extra: Mapping[str, Any],
    notices: Iterable[str] = (),
) -> Estimate:
    """Final estimate, summary on the terminal, JSON and plot, where these are wanted.

    Raises:
        DataError: nothing was flown that could be estimated from.
    """
    from crazyem.live.plot import write_plot

    history = pipeline.history
    for sentence in notices:
        history.notice(sentence)
    estimate = pipeline.finish()
    summary = build_summary(
        log=log,
        vehicle=vehicle.name,
        estimate=estimate,
        history=history,
        update_seconds=pipeline.estimator.update_seconds,
        received=received,
        lost=lost,
        extra={**extra, "plot": plot},
    )
    text = text_summary(summary, estimate)
    if arguments.json == "-":
        say(text)
    else:
        print(text, flush=True)
    if arguments.json:
        write_json(summary, arguments.json)
    files = {"summary": arguments.json} if arguments.json not in (None, "-") else {}
    if plot is not None:
        write_plot(plot, history, vehicle, title=title)
        files = {"plot": plot, **files}
    if files:
        say("   ".join(f"{what}: {file}" for what, file in files.items()))
    return estimate


def close_recorder(recorder: Recorder, statistics: LinkStatistics, history: History) -> None:
    """Finish the recording, with the account of lost packets in it; say so if it is not whole."""
    counts = {n: getattr(statistics, n) for n in ("received", "lost", "late", "duplicates")}
    recorder.metadata("statistics", {k: str(v) for k, v in counts.items()})
    recorder.close()
    history.notice(recorder.failure)


def raise_after(error: BaseException | None) -> None:
    """Raise what ended a flight, once its results are on disk."""
    if error is not None:
        raise error


def new_estimator(
    vehicle: Vehicle, arguments: argparse.Namespace, *, onboard: bool = True, input_signal: str | None = None
) -> Any:
    """The estimator with the window of the command line; it begins its window anew when the mass steps.

    `onboard`: attitudes come from a filter on board, as those of every link do. `input_signal`: None takes what comes
    first.
    """
    from crazyem.estimation.online import ATTITUDE_PERIOD, OnlineEstimator
    from crazyem.estimation.steps import StepAwareEstimator

    period = ATTITUDE_PERIOD if onboard else 0.0
    return StepAwareEstimator(
        OnlineEstimator(
            vehicle, window=arguments.window, every=arguments.every, attitude_period=period, input_signal=input_signal
        )
    )


def compile_kernels(vehicle: Vehicle) -> None:
    """Compile before anything flies, and say so where it took its time."""
    from crazyem.live.warm_up import warm_up

    if seconds := warm_up(vehicle):
        say(f"compiled the estimator in {seconds:.0f} s (once per installation)")
