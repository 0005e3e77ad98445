"""`crazyem replay FILE`: run the estimator of the live loop on a recording."""

import argparse
import time

from crazyem.api.replaying import replay
from crazyem.commands.files import read_options
from crazyem.commands.output import News, plot_path, report, say
from crazyem.live.history import History
from crazyem.live.summary import check_writable, live_line


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    plot = plot_path(arguments, arguments.json, arguments.file)
    for path in (arguments.json, plot):
        check_writable(path)
    result = replay(
        arguments.file,
        arguments.vehicle,
        window=arguments.window,
        every=arguments.every,
        options=read_options(arguments),
        progress=_EverySecond(),
        monitor=arguments.monitor,
        false_alarms_per_hour=arguments.false_alarms_per_hour,
    )
    report(arguments, result, plot=plot)
    return 0


class _EverySecond:
    """Prints a line each second, and a line for each step of mass."""

    def __init__(self) -> None:
        self._shown, self._news = time.monotonic(), News()

    def __call__(self, seconds: float, history: History) -> None:
        if time.monotonic() - self._shown > 1.0:
            self._shown = time.monotonic()
            newest = history.estimates[-1] if history.estimates else None
            say(live_line("replay", seconds, newest, lost=0, pushes=0))
            self._news.steps(history)
        self._news.faults(history)
