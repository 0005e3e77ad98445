"""The command line: parses, calls one function per command, turns errors into one sentence and an exit code."""

import argparse
import importlib
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from crazyem.errors import CrazyemError, UsageError

_MODULES = {"import": "import_"}  # commands whose module has another name, because the command is a Python keyword
LONGEST_WINDOW = 20_000  # samples; buffers are allocated at the start, and updates take seconds even below


class _Parser(argparse.ArgumentParser):
    """Parser that reports an error in one sentence, like all other errors; --help shows the usage."""

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
        # A replay without options takes vehicle, window and update interval from the recording.
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
    fly.add_argument("--controller", choices=("lee", "mellinger", "indi", "lqg"), default="lee")
    _flying(fly)
    _pushing(fly, "write to a drone that is not simulated (default: dry run)")
    fly.add_argument("--record", metavar="FILE.mcap", help="record everything")
    fly.add_argument("--append", action="store_true", help="to an existing recording, as its next session")
    fly.add_argument("--scenario", metavar="FILE", help="the simulator's truth (only the simulator reads it)")
    fly.add_argument("--seed", type=_integer(0, 2**31 - 1), help="of the simulator's noise (default: 0)")
    text = "of the simulator, times real time (default: 1)"
    fly.add_argument("--speed", type=_number(0.05, 100), metavar="X", help=text)
    _monitor(fly, None)
    _logging(fly, reconnect=8.0)
    _many(fly)

    replay = common("replay", "run the estimator over a recording", recorded=True)
    replay.add_argument("file", metavar="FILE", help="a recording of any known format")
    _monitor(replay, False)
    _reading(replay)
    _cutting(replay)

    watch = common("watch", "estimate without commanding; of MAVLink drones, write hover thrust if asked")
    watch.add_argument("uri", nargs="?", metavar="URI")
    watch.add_argument("--duration", type=_number(0.1, 1e6, " seconds"), metavar="S", help="s until it ends by itself")
    _pushing(watch, "write hover thrust to a MAVLink drone (default: dry run)")
    watch.add_argument("--record", metavar="FILE.mcap", help="record everything")
    watch.add_argument("--append", action="store_true", help="to an existing recording, as its next session")
    _monitor(watch, None)
    _logging(watch, reconnect=30.0)
    _many(watch)
    _links(commands)
    _policy(commands)
    _on_recordings(commands)
    _paper(commands)
    return top


def _flying(p: argparse.ArgumentParser) -> None:
    """Options for the trajectory of a flight."""
    add = p.add_argument
    text = "hover, figure8, excite, informative, waypoints FILE, or plan FILE"
    add("--trajectory", nargs="+", default=["hover"], metavar="NAME", help=text)
    text = "of informative: ends when mass, Ixx, Iyy and Izz are known within this (95 %%; default: 5)"
    add("--goal", type=_number(0.1, 100, " percent"), default=5.0, metavar="PERCENT", help=text)
    seconds = _number(1, 3600, " seconds")
    add("--duration", type=seconds, default=20.0, metavar="S", help="of the trajectory (default: 20)")


def _pushing(p: argparse.ArgumentParser, push: str) -> None:
    """Options for the writes of the guard."""
    pushing = p.add_mutually_exclusive_group()
    pushing.add_argument("--push", action="store_true", help=push)
    pushing.add_argument("--confirm", action="store_true", help="write, but ask before the first time")
    pushing.add_argument("--dry-run", action="store_true", help="decide and tell what would be written, write nothing")
    pushing.add_argument("--no-push", action="store_true", help="estimate only, write no parameters")
    p.add_argument("--policy", metavar="FILE.toml", help="of the guard on writes (default: see crazyem policy)")


def _monitor(p: argparse.ArgumentParser, default: bool | None) -> None:
    """Options of the monitor for faults in flight."""
    text = f"look for faults in flight (default: {'off' if default is False else 'as the policy says'})"
    p.add_argument("--monitor", action=argparse.BooleanOptionalAction, default=default, help=text)
    p.add_argument("--false-alarms-per-hour", type=_number(1e-6, 1000), metavar="N", help="of the monitor")


def _logging(p: argparse.ArgumentParser, *, reconnect: float) -> None:
    """Options of a session's link."""
    hertz, seconds = _number(1, 1000, " Hz"), _number(0, 3600, " seconds")
    text = "of the log, to 1000 (default: every 11 ms, no multiple of the onboard estimate's 10)"
    p.add_argument("--rate", type=hertz, default=1000.0 / 11.0, metavar="HZ", help=text)
    text = f"how long a lost link is tried again; 0: never (default: {reconnect:g})"
    p.add_argument("--reconnect", type=seconds, default=reconnect, metavar="S", help=text)


def _many(p: argparse.ArgumentParser) -> None:
    """Options for several drones, and for their display."""
    add = p.add_argument
    add("--uri", action="append", default=[], dest="uris", metavar="URI", help="one more drone (repeatable)")
    add("--swarm", metavar="FILE.toml", help="drones with uri, vehicle, trajectory and offset each")
    shown = p.add_mutually_exclusive_group()
    shown.add_argument("--live", action="store_true", help="a live view, also where output goes to a file")
    shown.add_argument("--no-live", action="store_true", help="plain lines (default where there is no terminal)")
    text = "stream to Foxglove on this host while it runs (default port: 8765)"
    add("--foxglove", nargs="?", type=_integer(1, 65535), const=8765, metavar="PORT", help=text)


def _links(commands: Any) -> None:
    """The commands for links to drones."""
    text = "what a drone could be reached through here: radio, USB, UDP, serial; and what is missing"
    p = commands.add_parser("links", help=text, description=text)
    add = p.add_argument
    add("--host", default="127.0.0.1", metavar="HOST", help="asked for drones on UDP (default: this one)")
    add("--ports", nargs="+", type=_integer(1, 65535), metavar="PORT", help="of UDP (default: 19850 to 19859)")
    add("--no-air", action="store_true", help="do not search the air for drones, which takes some seconds")
    add("--json", nargs="?", const="-", metavar="FILE", help="for programs; without FILE on standard output")


def _policy(commands: Any) -> None:
    """The command for the rules of the guard."""
    text = "the rules of the guard on writes to a drone: the shipped ones, or a file's, checked"
    p = commands.add_parser("policy", help=text, description=text)
    p.add_argument("file", nargs="?", metavar="FILE.toml", help="a policy file (default: the shipped policy)")
    p.add_argument("--json", nargs="?", const="-", metavar="FILE", help="for programs; without FILE on standard output")


def _paper(commands: Any) -> None:
    """The command that reproduces Zhao's paper."""
    text = "the paper's simulations again: its method, ours and the information limit, as tables and figures"
    p = commands.add_parser("paper", help=text, description=text)
    add = p.add_argument
    add("--experiment", choices=("all", "table1", "offline", "online"), default="all")
    add("--sensor", choices=("A", "B", "C", "all"), default="all")
    add("--method", choices=("published", "crazyem", "both"), default="both")
    add("--seeds", type=_integer(1, 10_000), default=20, metavar="N", help="flights of each (default: 20)")
    add("--jobs", type=_integer(1, 1024), metavar="N", help="processes (default: one a core)")
    add("--cluster", metavar="ADDRESS", help="work on a Dask cluster: address of its scheduler")
    add("--out", default="paper", metavar="DIR", help="output, and where a stopped run goes on (default: paper)")
    add("--reading", choices=("p5", "literal"), default="p5", help="of what the paper leaves unsaid (default: p5)")
    add("--set", action="append", metavar="NAME=VALUE", help="change a setting of the simulation (repeatable)")
    add("--settings", action="store_true", help="list the settings with their reasons, and run nothing")


def _reading(p: argparse.ArgumentParser) -> None:
    """Options for the reader of a recording (`crazyem.recordings.contents`)."""
    add = p.add_argument
    add("--map", metavar="FILE.toml", help="which columns of a CSV are which signals: a file or a preset")
    text = "what motor.m1..4 of an old log is: the duty sent, or the thrust requested before compensation"
    add("--motor", choices=("duty", "request"), help=text)
    add("--as-published", action="store_true", help="believe a preset's publisher instead of correcting known mistakes")


def _cutting(p: argparse.ArgumentParser) -> None:
    """Options for the part of a recording to use (`crazyem.recordings.registry`)."""
    seconds = _number(-1e12, 1e12, " seconds")
    text = "only from this time on, in seconds as info and doctor show them"
    p.add_argument("--from", dest="start", type=seconds, metavar="S", help=text)
    p.add_argument("--to", dest="end", type=seconds, metavar="S", help="only up to this time")


def _diagnose(commands: Any) -> None:
    """The command `diagnose`."""
    text = "where a vehicle's model and its flights part, which physics was left out, and the model with it"
    p = commands.add_parser("diagnose", help=text, description=text)
    add = p.add_argument
    add("files", nargs="+", metavar="RECORDING", help="flights of one drone")
    add("--vehicle", metavar="NAME|FILE", help="the nominal model (default: the one that was flown)")
    add("--against", metavar="SIMULATED", help="a simulated recording of the same mission, to look at first")
    several: dict[str, Any] = {"nargs": "+", "action": "extend", "default": [], "metavar": "RECORDING"}
    add("--held-out", **several, help="flights only to judge by, unless only they move (--strict-held-out)")
    add("--baseline", **several, help="flights of the healthy drone: its own trim, and how its days differ")
    add("--strict-held-out", action="store_true", help="fit nothing to these even where the others only hover")
    add("--withhold", action="append", default=[], metavar="SIGNAL", help="a signal to leave unused, e.g. pm.vbat")
    add("--method", choices=("stages", "posterior"), help=argparse.SUPPRESS)
    add("--candidates", metavar="A,B,...", help="effects to look for (default: the whole catalogue)")
    add("--jobs", type=_integer(1, 64), metavar="N", help="threads (default: one a core)")
    add("--report", metavar="OUT.html", help="one self-contained page")
    add("--json", metavar="OUT.json", help="the diagnosis for programs; - for standard output")
    add("--write-vehicle", metavar="FITTED.toml", help="the vehicle with what was found")
    _reading(p)
    _cutting(p)


def _plan(commands: Any) -> None:
    """The command `plan` for experiments."""
    text = "the manoeuvre that most narrows intervals, or best tells two explanations apart; and what to expect of it"
    p = commands.add_parser("plan", help=text, description=text)
    add = p.add_argument
    goal = p.add_mutually_exclusive_group()
    goal.add_argument("--for", dest="parameters", metavar="A,...", help="to be narrowed (default: mass,Ixx,Iyy,Izz)")
    goal.add_argument("--split", metavar="EFFECT,EFFECT", help="effects to tell apart")
    goal.add_argument("--from", dest="diagnosis", metavar="DIAGNOSIS.json", help="tell its look-alikes apart")
    add("--vehicle", default="cf2", metavar="NAME|FILE", help="preset or vehicle file (default: cf2)")
    text = "full widths in m about the hover point (default: 1 1 0.6)"
    add("--box", type=_number(0.1, 20, " m"), nargs=3, default=(1.0, 1.0, 0.6), metavar=("X", "Y", "Z"), help=text)
    add("--tilt", type=_number(2, 45, " degrees"), default=20.0, metavar="DEG", help="at most (default: 20)")
    add("--time", type=_number(3, 300, " seconds"), default=10.0, metavar="S", help="(default: 10)")
    text = "of --for: volume of the joint interval, or sum of relative variances (default: D)"
    add("--criterion", choices=("D", "A"), default="D", help=text)
    add("--noise", metavar="FLIGHT.json", help="expect the noise of this flight or replay of the drone")
    add("--seed", type=_integer(0, 2**31 - 1), default=0, help="of the search (default: 0)")
    add("--json", nargs="?", const="-", metavar="FILE", help="for programs; without FILE on standard output")
    add("-o", "--output", required=True, metavar="PLAN.toml", help="for crazyem fly --trajectory plan")


def _predict(commands: Any) -> None:
    """The command `predict`: open-loop predictions for the user's own metric."""
    text = "where a vehicle goes by its model: open-loop predictions from every recorded state, by recorded inputs"
    p = commands.add_parser("predict", help=text, description=text)
    add = p.add_argument
    add("file", metavar="RECORDING", help="a recording of any known format")
    add("--vehicle", metavar="NAME|FILE", help="preset or vehicle file (default: the one that was flown)")
    add("--horizon", type=_integer(1, 1_000_000), required=True, metavar="N", help="steps from each start")
    step = _number(1e-4, 10, " seconds")
    add("--step", type=step, metavar="S", help="s between predicted states (default: the recorded samples)")
    add("--every", type=_integer(1, 1_000_000), default=1, metavar="K", help="samples from start to start (default: 1)")
    add("--plain", action="store_true", help="the model alone, however wrong its turning was before a start")
    add("--ensemble", type=_integer(2, 10_000), metavar="N", help="a band by N drones of the vehicle's [posterior]")
    add("--seed", type=_integer(0, 2**31 - 1), default=0, help="of --ensemble (default: 0)")
    add("--other-day", action="store_true", help="of --ensemble: thrust, trim and lag of another day")
    add("--calibrate", nargs="+", default=[], metavar="RECORDING", help="other flights, to learn disturbances from")
    add("-o", "--output", required=True, metavar="OUT.npz", help="array `prediction`, and which starts")
    add("--force", action="store_true", help="replace what is there (never a recording that is read)")
    _reading(p)
    _cutting(p)


def _vehicle(commands: Any) -> None:
    """The command `vehicle` for simulator files."""
    text = "vehicle files and those of simulators: converted, checked by flights, sampled"
    actions = commands.add_parser("vehicle", help=text, description=text).add_subparsers(
        dest="action", required=True, metavar="ACTION"
    )

    def action(name: str, text: str) -> argparse.ArgumentParser:
        p: argparse.ArgumentParser = actions.add_parser(name, help=text, description=text)
        p.add_argument("--name", metavar="DRONE", help="which drone of a file that has several")
        p.add_argument("--force", action="store_true", help="replace what is there")
        p.add_argument("--json", nargs="?", const="-", metavar="FILE", help="for programs; without FILE on stdout")
        return p

    convert = action("convert", "a vehicle file or preset into a simulator's file, or the other way")
    convert.add_argument("source", metavar="SOURCE", help="preset, vehicle file, or a file of a known simulator")
    convert.add_argument("-o", "--output", required=True, metavar="TARGET", help="the new file")
    convert.add_argument("--from", dest="form", metavar="FORMAT", help="of the source (default: told by its content)")
    convert.add_argument("--to", metavar="FORMAT", help="of the target (default: the template's, or by the suffix)")
    convert.add_argument("--template", metavar="FILE", help="a file of yours, of which all that is not ours stays")
    convert.add_argument("--vehicle", metavar="NAME|FILE", help="what a simulator's file does not say")
    convert.add_argument("--flight", metavar="RECORDING", help="tell costs by this flight (default: a made one)")

    check = action("check", "what is wrong in a simulator's file, by flights: in its own names and units")
    check.add_argument("file", metavar="FILE", help="of a known simulator")
    check.add_argument("files", nargs="+", metavar="RECORDING", help="flights of that drone")
    text = "flights only to judge by"
    check.add_argument("--held-out", nargs="+", action="extend", default=[], metavar="RECORDING", help=text)
    check.add_argument("--beside", nargs="+", default=[], metavar="FILE", help="files that should say the same")
    check.add_argument("--vehicle", metavar="NAME|FILE", help="what the file does not say (default: what was flown)")
    check.add_argument("--mass", type=_number(1e-3, 100, " kg"), metavar="KG", help="of the whole drone, weighed")
    check.add_argument("--candidates", metavar="A,B,...", help="effects to look for (default: the whole catalogue)")
    text = "relative, of a number that may stay (0.05)"
    check.add_argument("--tolerance", type=_number(0, 1), default=0.05, metavar="X", help=text)
    check.add_argument("--write", metavar="TARGET", help="the file, corrected")
    check.add_argument("--strict", action="store_true", help="exit code 5 if the file does not fit")
    check.add_argument("--jobs", type=_integer(1, 64), metavar="N", help="threads (default: one a core)")
    _reading(check)
    _cutting(check)

    sample = action("sample", "drones as a fitted vehicle may be, by its joint posterior: for domain randomisation")
    sample.add_argument("file", metavar="FITTED.toml", help="as diagnose --write-vehicle writes it")
    sample.add_argument("--count", type=_integer(1, 100_000), default=256, metavar="N", help="(default: 256)")
    sample.add_argument("--seed", type=_integer(0, 2**31 - 1), default=0, help="(default: 0)")
    sample.add_argument("-o", "--output", required=True, metavar="FILE.npz|DIR", help="arrays in SI, or a file a drone")
    sample.add_argument("--to", metavar="FORMAT", help="of the files in DIR (default: vehicle files)")
    sample.add_argument("--template", metavar="FILE", help="a file of yours, of which all that is not ours stays")
    sample.add_argument("--same-day", action="store_true", help="without the spread from one day to the next")
    text = "relative, of the mass, which no flight tells (default: 0.02)"
    sample.add_argument("--mass-sd", type=_number(0, 1), metavar="X", help=text)


def _on_recordings(commands: Any) -> None:
    """The commands on files that need neither drone nor estimator."""

    def command(name: str, text: str, *, many: bool = True) -> argparse.ArgumentParser:
        p: argparse.ArgumentParser = commands.add_parser(name, help=text, description=text)
        if many:
            p.add_argument("files", nargs="+", metavar="FILE", help="recordings, folders of them, or quoted patterns")
            _reading(p)
            text = "processes (default: one a core, one for one file)"
            p.add_argument("--jobs", type=_integer(1, 1024), metavar="N", help=text)
            p.add_argument("--cluster", metavar="ADDRESS", help="work on a Dask cluster: address of its scheduler")
        text = "results for programs; without FILE on standard output"
        p.add_argument("--json", nargs="?", const="-", metavar="FILE", help=text)
        return p

    def writes(p: argparse.ArgumentParser, metavar: str, text: str, *, required: bool = True) -> None:
        p.add_argument("-o", "--output", required=required, metavar=metavar, help=text)
        p.add_argument("--force", action="store_true", help="replace what is there (never a recording that is read)")

    in_parts = "read in stretches of a minute, whatever the size (else only what may not fit into memory)"
    info = command("info", "what is in recordings, how hard they flew, what could be identified from them")
    info.add_argument("--vehicle", metavar="NAME|FILE", help="judge by this vehicle (default: the one that was flown)")
    info.add_argument("--all", action="store_true", help="all signals, clocks and metadata as well")
    info.add_argument("--parts", action="store_true", help=in_parts)

    doctor = command("doctor", "what is wrong with recordings, where, how bad, and what to do about it")
    doctor.add_argument("--fix", action="store_true", help="write repairs that lose nothing into a new file")
    writes(doctor, "OUT.mcap", "of --fix: file, or folder (default: NAME.fixed.mcap beside it)", required=False)
    doctor.add_argument("--strict", action="store_true", help="exit code 5 if anything is unusable")
    doctor.add_argument("--parts", action="store_true", help=in_parts)

    import_ = command("import", "recordings of any format into ours")
    writes(import_, "OUT.mcap", "file; for several recordings a folder")
    _cutting(import_)

    export = command("export", "recordings as tables: CSV or Parquet, units beside the numbers")
    writes(export, "OUT.csv|OUT.parquet", "file; for several recordings a folder")
    export.add_argument("--format", choices=("csv", "parquet"), help="in a folder (default: csv)")
    export.add_argument("--parts", action="store_true", help=in_parts)
    _cutting(export)

    recover = command("recover", "a cut or damaged MCAP file into a valid one", many=False)
    recover.add_argument("file", metavar="BROKEN.mcap", help="of any program; it is only read")
    writes(recover, "OUT.mcap", "the new file")

    _diagnose(commands)
    _plan(commands)
    _predict(commands)
    _vehicle(commands)
    layout = command("layout", "a Foxglove and Lichtblick layout for recordings of ours", many=False)
    writes(layout, "FILE.json", "file (default: standard output)", required=False)
    layout.add_argument("--swarm", metavar="FILE.toml", help="for the drones of this file, as --foxglove streams them")
    layout.add_argument("--drones", nargs="+", metavar="NAME", help="the same for drones by name")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    # before numpy is imported: matrices are small here, and more threads of BLAS only take time from ours
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        arguments = parser().parse_args(argv)
        # In `fly --trajectory hover URI` the option has swallowed the URI.
        if arguments.command == "fly" and arguments.uri is None and "://" in arguments.trajectory[-1]:
            arguments.uri = arguments.trajectory.pop()
        # Imported late, so that `crazyem --help` need not wait for numba. The parser allows only known names.
        module = _MODULES.get(arguments.command, arguments.command)
        code = int(importlib.import_module(f"crazyem.commands.{module}").run(arguments))
        sys.stdout.flush()  # here, so that a closed pipe raises inside this try block
        return code
    except CrazyemError as error:
        sentence = str(error)
        print(f"crazyem: {sentence}{'' if sentence.endswith('.') else '.'}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("crazyem: interrupted.", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # the reader has closed the pipe (`| head`); avoid a second error when the interpreter flushes at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
