"""The live view in a terminal: a table of drones, and details of one; its own thread draws frozen snapshots.

Drawing never delays a flight: it takes no lock of the session, and only this thread waits for a slow terminal. Single
keys are read without blocking; the terminal is always restored.
"""

import atexit
import contextlib
import math
import os
import select
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from crazyem.live.views import NOT_PUSHED, ParameterView, SessionControls, Snapshot

try:
    import termios
except ImportError:  # not on Windows: the view works there, without keys
    termios = None  # type: ignore[assignment]


class Keys:
    """Single keys within a `with` block. Ctrl-C still raises its signal.

    The terminal is restored after the block, after an exception and at the end of the process.

    Args:
        fd: of the terminal; None: standard input.
    """

    def __init__(self, fd: int | None = None) -> None:
        self._given = fd
        self._fd = -1
        self._before: list[Any] | None = None
        self._open = False
        self._waiting = ""  # further keys of one read

    def __enter__(self) -> "Keys":
        self.begin()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    @property
    def reading(self) -> bool:
        """Whether keys can be read: False without a terminal, or once it is closed."""
        return self._open

    def begin(self) -> None:
        """Read single keys without echo from now on; does nothing without a terminal."""
        try:
            fd = sys.stdin.fileno() if self._given is None else self._given
            if termios is None or not os.isatty(fd):
                return
            before = termios.tcgetattr(fd)
            now = termios.tcgetattr(fd)
            now[3] &= ~(termios.ICANON | termios.ECHO)  # ISIG stays: Ctrl-C must always reach the flight
            now[6][termios.VMIN], now[6][termios.VTIME] = 1, 0
            self._fd, self._before = fd, before
            atexit.register(self.end)
            termios.tcsetattr(fd, termios.TCSADRAIN, now)
        except (OSError, ValueError, AttributeError):  # standard input may be closed, or not a file
            self.end()
            return
        self._open = True

    def end(self) -> None:
        """Restore the terminal; safe to call at any time and twice."""
        before, self._before, self._open = self._before, None, False
        if before is None:
            return
        atexit.unregister(self.end)
        with contextlib.suppress(Exception):  # a closed terminal needs nothing; termios.error is not an OSError
            termios.tcsetattr(self._fd, termios.TCSADRAIN, before)

    def read(self, timeout: float) -> str:
        """The next key, "" if none is pressed within `timeout` [s]. Arrow and function keys are ignored.

        Returns "" at once if `reading` is False.
        """
        if not self._open:
            return ""
        if self._waiting:
            key, self._waiting = self._waiting[0], self._waiting[1:]
            return key
        try:
            if not select.select([self._fd], [], [], max(timeout, 0.0))[0]:
                return ""
            data = os.read(self._fd, 64)
        except (OSError, ValueError):
            data = b""
        if not data:  # hung up
            self._open = False
            return ""
        text = data.decode(errors="replace")
        if text.startswith("\x1b"):
            return ""
        self._waiting = text[1:].partition("\x1b")[0]
        return text[0]


# s between pictures, and the same for many drones; number of drones that counts as many: each costs some ms
FRAME_PERIOD, FRAME_PERIOD_OF_MANY, MANY_DRONES = 0.25, 1.0, 8
BARS = "▁▂▃▄▅▆▇█"
HELP = "p push on/off   r revert   m mark   l land   q quit view   Ctrl-C land all, twice: cut"
CHOOSE = "↹ next drone   "
LOW_VOLTAGE = 3.3  # V, shown in red
HIGH_LOSS = 0.05  # share of lost packets, shown in red


def sparkline(values: Sequence[float], width: int = 24) -> str:
    """Newest `width` values as bars between their least and largest; a flat line if they hardly differ."""
    shown = [v for v in values if math.isfinite(v)][-width:]
    if not shown:
        return ""
    low, high = min(shown) / 2, max(shown) / 2  # halves, because the whole span may overflow
    if high - low <= 1e-3 * max(abs(low), abs(high)):
        return BARS[3] * len(shown)
    return "".join(BARS[min(int((v / 2 - low) / (high - low) * len(BARS)), len(BARS) - 1)] for v in shown)


def number(value: float, digits: int = 2) -> str:
    """A number, or a dash if it is not finite."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def safe(text: str, style: str = "") -> Text:
    """Text without markup and without control characters."""
    return Text("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text), style=style)


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.0f} ms" if math.isfinite(seconds) else "-"


def _interval(p: ParameterView) -> str:
    if not (math.isfinite(p.low) and math.isfinite(p.high)):
        return "-"
    half = (p.high - p.low) / 2
    return f"± {half:.2f}" if half < 1e3 else "± >999"


def parameter_table(parameters: Sequence[ParameterView]) -> RenderableType:
    """Table of values with intervals and trend, and the reason if a value is not identifiable."""
    if not parameters:
        return Text("no estimate yet: the drone has not flown", style="dim")
    table = Table(box=None, pad_edge=False, expand=True)
    table.add_column("parameter", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("95 %", no_wrap=True)
    table.add_column("unit", style="dim", no_wrap=True)
    table.add_column("last minute", no_wrap=True)
    table.add_column("identifiable", ratio=1)
    for p in parameters:
        style = "" if p.identifiable else "yellow"
        verdict = Text("yes", style="green") if p.identifiable else safe(p.reason or "no", "yellow")
        table.add_row(
            Text(p.label, style=style), Text(number(p.value), style=style), _interval(p), p.unit,
            Text(sparkline(p.trend), style="cyan"), verdict,
        )  # fmt: skip
    return table


def link_text(s: Snapshot) -> Text:
    """One line about the link."""
    link = s.link
    if link.gone:
        return Text("link lost", style="bold red")
    loss = f"{100 * link.loss:.1f} %" if math.isfinite(link.loss) else "-"
    text = Text(f"{number(link.rate, 0)} packets/s, lost ")
    text.append(loss, style="red" if link.loss > HIGH_LOSS else "")
    text.append(f" ({link.lost} in all), late {link.late}, echo {_milliseconds(link.round_trip)}")
    text.append(f", delay {_milliseconds(link.delay)}")
    if link.outages:
        text.append(f", {link.outages} outages", style="yellow")
    return text


def guard_text(s: Snapshot) -> Text:
    """One line about the guard: its mode, and its last decision or why it writes nothing."""
    if not s.guard:
        return Text(NOT_PUSHED, style="dim")
    if s.stopped:
        return safe(f"stopped: {s.stopped}", "bold red")
    if s.paused:
        return Text(f"{s.guard}: switched off by you (p)", style="yellow")
    return safe(f"{s.guard}: {s.decision or 'waits for estimates'}")


def push_lines(s: Snapshot) -> list[Text]:
    """The last writes, newest first."""
    lines = []
    for at, name, value, verified, purpose in reversed(s.pushes):
        what = "" if purpose == "push" else f" ({purpose})"
        mark = Text("ok ", style="green") if verified else Text("?? ", style="bold red")
        lines.append(mark.append_text(safe(f"{at:8.1f} s  {name} = {value:.6g}{what}", "default")))
    return lines


def _battery(s: Snapshot) -> Text:
    return Text(f"{number(s.voltage)} V", style="red" if s.voltage < LOW_VOLTAGE else "")


def _status(s: Snapshot) -> Text:
    text = safe(f"{s.phase or '-'} {s.seconds:.0f} s   ", "bold")
    text.append("in the air" if s.airborne else "on the ground", style="default")
    text.append(f", height {number(s.height)} m, ", style="default")
    text.append_text(_battery(s))
    text.append(f"   {s.updates} updates" + (", converged" if s.converged else ""), style="default")
    if s.skipped:
        text.append(f", {s.skipped} left out", style="yellow")
    if s.behind > 0.5:
        text.append(f", {s.behind:.1f} s behind", style="red")
    if s.marks:
        text.append(f", {s.marks} marks", style="default")
    return text


def detail(s: Snapshot) -> Panel:
    """All details of one drone."""
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="dim", no_wrap=True)
    facts.add_column()
    facts.add_row("link", link_text(s))
    facts.add_row("guard", guard_text(s))
    for i, line in enumerate(push_lines(s)):
        facts.add_row(f"writes {s.writes}" if i == 0 else "", line)
    for i, alarm in enumerate(s.alarms[:4]):
        facts.add_row("alarms" if i == 0 else "", safe(alarm, "bold red" if i == 0 else "yellow"))
    if s.ended:
        facts.add_row("ended", safe(s.ended, "yellow"))
    parts = (_status(s), Text(), parameter_table(s.parameters), Text(), facts)
    return Panel(Group(*parts), title=safe(f"{s.name}  {s.uri}"), title_align="left", border_style="blue")


def overview(snapshots: Sequence[Snapshot], selected: int, rows: int) -> Table:
    """A row per drone, `rows` of them around the selected one."""
    table = Table(box=None, pad_edge=False, expand=True)
    columns = ("drone", "phase", "mass g", "Ixx", "Iyy", "Izz 10⁻⁶", "lost", "rate", "battery", "writes", "state")
    for name in columns:
        table.add_column(name, no_wrap=True, justify="left" if name in ("drone", "phase", "state") else "right")
    first = min(max(selected - rows // 2, 0), max(len(snapshots) - rows, 0))
    for i, s in enumerate(snapshots[first : first + rows], start=first):
        values = {p.label: Text(number(p.value), style="" if p.identifiable else "yellow") for p in s.parameters}
        table.add_row(
            safe(s.name), safe(f"{s.phase} {s.seconds:.0f} s"),
            *(values.get(n, Text("-")) for n in ("mass", "Ixx", "Iyy", "Izz")),
            Text(str(s.link.lost)), Text(number(s.link.rate, 0)), _battery(s), Text(str(s.writes)), _state(s),
            style="reverse" if i == selected else "",
        )  # fmt: skip
    return table


def _state(s: Snapshot) -> Text:
    if s.ended:
        return safe(s.ended, "yellow")
    if s.alarms:
        return safe(s.alarms[0], "bold red")
    if s.stopped or s.paused:
        return Text("pushing stopped" if s.stopped else "push off", style="yellow")
    return Text("ok", style="green")


def picture(
    snapshots: Sequence[Snapshot], *, selected: int = 0, message: str = "", keys: bool = True, height: int = 40
) -> RenderableType:
    """The whole view."""
    if not snapshots:
        return Text("no drone yet", style="dim")
    selected = min(max(selected, 0), len(snapshots) - 1)
    parts: list[RenderableType] = []
    if len(snapshots) > 1:
        parts.append(overview(snapshots, selected, max(height - 24, 3)))
    parts.append(detail(snapshots[selected]))
    if message:
        parts.append(safe(message, "bold"))
    if keys:
        parts.append(Text((CHOOSE if len(snapshots) > 1 else "") + HELP, style="dim"))
    return Group(*parts)


class Dashboard:
    """Draws until closed, or until the user presses q; a context manager.

    Args:
        snapshots: gives the present snapshots; called in the dashboard's thread. An exception in it ends the view, not
            the flight.
        controls: gives the controls of each drone, in the order of the snapshots; called when a key is pressed.
    """

    def __init__(
        self,
        snapshots: Callable[[], Sequence[Snapshot]],
        controls: Callable[[], Sequence[SessionControls]] = lambda: (),
        *,
        console: Console,
        keys: Keys | None = None,
    ) -> None:
        self._snapshots, self._controls = snapshots, controls
        self.console = console
        self.keys = keys or Keys()
        self.selected = 0
        self.message = ""
        self.failure = ""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="crazyem-dashboard", daemon=True)

    @property
    def showing(self) -> bool:
        """Whether the view is running; if not, plain lines are printed."""
        return self._thread.is_alive() and not self._stop.is_set()

    def __enter__(self) -> "Dashboard":
        self.keys.begin()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the view and restore the terminal; waits for the thread for at most 3 s."""
        self._stop.set()
        if self._thread.ident is not None and threading.current_thread() is not self._thread:
            self._thread.join(timeout=3.0)
        self.keys.end()

    def _run(self) -> None:
        try:
            with Live(
                console=self.console, screen=self.console.is_terminal, auto_refresh=False, redirect_stdout=False,
                redirect_stderr=False,
            ) as live:  # fmt: skip
                while not self._stop.is_set():
                    many = self._draw(live) >= MANY_DRONES
                    period = FRAME_PERIOD_OF_MANY if many else FRAME_PERIOD  # or until a key is pressed
                    if not self.keys.reading:
                        self._stop.wait(period)
                    elif key := self.keys.read(period):
                        self.press(key)
        except Exception as error:  # a failed view must not end a flight
            self.failure = f"the live view ended: {error!r}."
        finally:
            self._stop.set()
            self.keys.end()

    def _draw(self, live: Any) -> int:
        snapshots = self._snapshots()
        self.selected = min(self.selected, max(len(snapshots) - 1, 0))
        live.update(
            picture(
                snapshots, selected=self.selected, message=self.message, keys=self.keys.reading,
                height=self.console.height,
            ),
            refresh=True,
        )  # fmt: skip
        return len(snapshots)

    def press(self, key: str) -> None:
        """Carry out the action of a key."""
        if key in ("q", "Q"):
            self._stop.set()
            return
        controls = list(self._controls())
        if key == "\t" and controls:
            self.selected = (self.selected + 1) % len(controls)
            return
        action = {"p": "toggle_push", "r": "revert", "m": "mark", "l": "land"}.get(key.lower())
        if action is None or not self.selected < len(controls):
            return
        try:
            self.message = getattr(controls[self.selected], action)()
        except Exception as error:
            self.message = f"that failed: {error!r}"


def terminal_console(stream: Any) -> Console:
    """A console for a terminal's stream."""
    with contextlib.suppress(ValueError, OSError):
        return Console(file=stream, highlight=False)
    return Console(stderr=True, highlight=False)
