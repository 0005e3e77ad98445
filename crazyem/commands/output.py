"""Output of the commands: text without control characters, JSON, progress on standard error, and live lines."""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from crazyem.atomic_file import write_file
from crazyem.errors import UsageError
from crazyem.extras import MissingExtraError, require
from crazyem.live.flight_result import FlightResult
from crazyem.live.history import History
from crazyem.live.summary import check_writable, live_line, write_json
from crazyem.monitoring.fault import Fault
from crazyem.recordings.finding import Finding, Grade
from crazyem.vehicle import Vehicle

# s until progress is first shown, and between progress lines outside a terminal
_FIRST_PROGRESS, _PROGRESS_PERIOD = 1.0, 5.0


def plain(text: str) -> str:
    """The text without control characters; names of files and signals may hold any."""
    return "".join(c if c.isprintable() or c in "\n\t" else "\N{REPLACEMENT CHARACTER}" for c in text)


def put(text: str) -> None:
    """Print a result to standard output."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    print(plain(text).encode(encoding, "replace").decode(encoding), flush=True)


def deliver(document: Mapping[str, Any], path: str | None, text: str) -> None:
    """Write a result as indented JSON to `path`, if given, and print its text unless `path` is "-" (standard output).

    Raises: UsageError if the file cannot be written.
    """
    whole = json.dumps(document, indent=1)
    if path == "-":
        put(whole)
        return
    if path:
        write_file(path, whole + "\n")
    put(text)


def complain(text: str) -> None:
    """Print an error that does not end the command to standard error."""
    sentence = plain(text).strip()
    print(f"crazyem: {sentence}{'' if sentence.endswith('.') else '.'}", file=sys.stderr, flush=True)


def remarks(findings: Iterable[Finding]) -> list[str]:
    """A line for each finding of a reader that is not harmless; `crazyem doctor` shows the rest."""
    return [f"  {f.grade}: {f.text}" for f in findings if f.grade is not Grade.HARMLESS]


@dataclass(frozen=True, slots=True)
class Result:
    """The result of a command for one file.

    Attributes:
        file: path as given or found.
        data: for JSON.
        text: for people.
        error: one sentence if it failed, else "".
        code: exit code of that error, else 0.
        detail: further data for the command itself (pickled between processes, so keep it small).
    """

    file: str
    data: Mapping[str, Any] = field(default_factory=dict)
    text: str = ""
    error: str = ""
    code: int = 0
    detail: Any = None

    def to_dict(self) -> dict[str, Any]:
        """The result for JSON."""
        failed = {"error": self.error, "exit_code": self.code} if self.error else {}
        return {"file": self.file, **self.data, **failed}


class Report:
    """Collects results: prints text at once, writes JSON at the end."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self.json: str | None = arguments.json
        self.results: list[Result] = []
        check_json(self.json)

    def add(self, result: Result) -> None:
        """Add the result of one more file."""
        self.results.append(result)
        if result.error:
            complain(result.error)
        else:
            self.say(result.text)

    def say(self, text: str) -> None:
        """Print text for people, unless standard output is for JSON."""
        if text and self.json != "-":
            put(text)

    def close(self, **more: Any) -> int:
        """Write the JSON of all files and `more`; returns the exit code of the first error, else 0."""
        if self.json:
            write_json({"files": [r.to_dict() for r in self.results], **more}, self.json)
        return next((r.code for r in self.results if r.code), 0)


def check_json(path: str | None) -> None:
    """Raise UsageError if the file of --json cannot be written, or exists and is no JSON file.

    Reason: `crazyem info --json a.csv b.csv` would replace the recording a.csv by the summary of b.csv.
    """
    check_writable(path)
    if path is None or path == "-":
        return
    target = Path(path)
    if target.is_file() and target.stat().st_size:
        with target.open("rb") as file:
            start = file.read(64).lstrip()
        if start[:1] not in (b"{", b"["):
            raise UsageError(f"{path} exists and is no JSON file; write --json=FILE, or --json after the recordings.")


class Progress:
    """Progress of a long command: one line that overwrites itself on a terminal, else a line every few seconds."""

    def __init__(self, what: str, total: int, unit: str = "files") -> None:
        self.what, self.total, self.done, self.unit = what, total, 0, unit
        self._terminal = sys.stderr is not None and sys.stderr.isatty()
        self._due = time.monotonic() + _FIRST_PROGRESS
        self._shown = False

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self.clear()

    def step(self) -> None:
        """Count one more finished item."""
        self.done += 1
        if self.total > 1:
            self.show(f"{self.what}: {self.done} of {self.total} {self.unit}")

    def show(self, text: str) -> None:
        """Print the text if enough time has passed since the last one."""
        now = time.monotonic()
        if now < self._due:
            return
        self._due = now + (0.2 if self._terminal else _PROGRESS_PERIOD)
        if self._terminal:
            print(f"\r{plain(text)[:78]:<78}", end="", file=sys.stderr, flush=True)
            self._shown = True
        else:
            print(plain(text), file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Remove the progress line from the terminal, to make room for other text."""
        if self._shown:
            print(f"\r{'':<78}\r", end="", file=sys.stderr, flush=True)
            self._shown = False


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
