"""The command line: parses, calls one function per command, turns errors into one sentence and an exit code."""

import argparse
import importlib
import math
import re
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from crazyem.errors import CrazyemError, UsageError

LONGEST_WINDOW = 20_000  # samples; the buffers are made at once, and an update would take seconds long before


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one sentence, like every other error; the usage is behind --help."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see {self.prog} --help).")


def _integer(low: int, high: int) -> Callable[[str], int]:
    def integer(text: str) -> int:
        if not re.fullmatch(r"[+-]?\d{1,18}", text) or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number between {low} and {high}")
        return int(text)

    return integer


def _number(low: float, high: float, unit: str = "") -> Callable[[str], float]:
    def number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:  # catches NaN
            raise argparse.ArgumentTypeError(f"{text!r} is not a number between {low:g} and {high:g}{unit}")
        return value

    return number


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    top = _Parser(
        prog="crazyem", description="Online estimates of a Crazyflie's mass and inertia, pushed to its controller."
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def common(name: str, text: str, *, recorded: bool = False) -> argparse.ArgumentParser:
        # A replay without options repeats the flight with what the recording says it was flown with.
        vehicle, window, every = (None, None, None) if recorded else ("cf2", 800, 4)
        p = commands.add_parser(name, help=text, description=text)
        p.add_argument("--vehicle", default=vehicle, metavar="NAME|FILE", help="preset or vehicle file (default: cf2)")
        samples, step = _integer(20, LONGEST_WINDOW), _integer(1, LONGEST_WINDOW)
        p.add_argument("--window", type=samples, metavar="N", default=window, help="newest samples (default: 800)")
        p.add_argument("--every", type=step, metavar="N", default=every, help="samples per update (default: 4)")
        p.add_argument("--json", metavar="FILE", help="summary for programs; - for standard output")
        p.add_argument("--plot", metavar="FILE.png", help="summary plot (default: beside the recording or summary)")
        return p

    fly = common("fly", "fly a drone, or a simulated firmware, and push what is learnt")
    fly.add_argument("uri", nargs="?", metavar="URI", help="the drone; without it firmware_sim is started")
    fly.add_argument("--controller", choices=("lee", "lqg"), default="lee")
    fly.add_argument(
        "--trajectory", nargs="+", default=["hover"], metavar="NAME", help="hover, figure8, excite, or waypoints FILE"
    )
    seconds = _number(1, 3600, " seconds")
    fly.add_argument("--duration", type=seconds, default=20.0, metavar="S", help="of the trajectory (default: 20)")
    fly.add_argument("--no-push", action="store_true", help="estimate only, write no parameters")
    fly.add_argument("--record", metavar="FILE.mcap", help="record everything")
    fly.add_argument("--scenario", metavar="FILE", help="the simulator's truth (only the simulator reads it)")
    fly.add_argument("--seed", type=_integer(0, 2**31 - 1), help="of the simulator's noise (default: 0)")
    fly.add_argument(
        "--speed", type=_number(0.05, 100), metavar="X", help="of the simulator, times real time (default: 1)"
    )

    replay = common("replay", "run the estimator over a recording", recorded=True)
    replay.add_argument("file", metavar="FILE", help="our MCAP, or a CSV (plain or gzip) of a known layout")

    watch = common("watch", "estimate without commanding")
    watch.add_argument("uri", metavar="URI")
    watch.add_argument("--duration", type=_number(0.1, 1e6, " seconds"), metavar="S", help="s until it ends by itself")
    watch.add_argument("--record", metavar="FILE.mcap", help="record everything")
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    try:
        arguments = parser().parse_args(argv)
        # In `fly --trajectory hover URI` the option has swallowed the URI.
        if arguments.command == "fly" and arguments.uri is None and "://" in arguments.trajectory[-1]:
            arguments.uri = arguments.trajectory.pop()
        # Imported only now: `crazyem --help` should not wait for numba. The name is one of the parser's own.
        command = importlib.import_module(f"crazyem.commands.{arguments.command}")
        return int(command.run(arguments))
    except CrazyemError as error:
        sentence = str(error)
        print(f"crazyem: {sentence}{'' if sentence.endswith('.') else '.'}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("crazyem: interrupted.", file=sys.stderr)
        return 130
