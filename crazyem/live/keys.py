"""Single keys from a terminal, read without blocking; the terminal is put back whatever happens."""

import atexit
import contextlib
import os
import select
import sys
from types import TracebackType
from typing import Any

try:
    import termios
except ImportError:  # not on Windows: the view works there, without keys
    termios = None  # type: ignore[assignment]


def is_terminal(fd: int) -> bool:
    """Whether a file descriptor is an open terminal."""
    try:
        return os.isatty(fd)
    except (OSError, ValueError):
        return False


class Keys:
    """Keys as they are pressed, within a `with` block. Ctrl-C stays what it is: a signal.

    Outside the block, after an exception and at the end of the process the terminal is as it was before.

    Args:
        fd: of the terminal; None takes standard input.
    """

    def __init__(self, fd: int | None = None) -> None:
        self._given = fd
        self._fd = -1
        self._before: list[Any] | None = None
        self._open = False
        self._waiting = ""  # pressed so fast that they came together

    def __enter__(self) -> "Keys":
        self.begin()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.end()

    @property
    def reading(self) -> bool:
        """Whether keys can come: false where there is no terminal, or it has gone away."""
        return self._open

    def begin(self) -> None:
        """Take keys one by one and do not echo them; does nothing where there is no terminal."""
        try:
            fd = sys.stdin.fileno() if self._given is None else self._given
            if termios is None or not is_terminal(fd):
                return
            before = termios.tcgetattr(fd)
            now = termios.tcgetattr(fd)
            now[3] &= ~(termios.ICANON | termios.ECHO)  # ISIG stays: Ctrl-C must always reach the flight
            now[6][termios.VMIN], now[6][termios.VTIME] = 1, 0
            self._fd, self._before = fd, before
            atexit.register(self.end)
            termios.tcsetattr(fd, termios.TCSADRAIN, now)
        except (OSError, ValueError, AttributeError):  # standard input may be closed, or no file at all
            self.end()
            return
        self._open = True

    def end(self) -> None:
        """Put the terminal back; safe to call at any time and twice."""
        before, self._before, self._open = self._before, None, False
        if before is None:
            return
        atexit.unregister(self.end)
        with contextlib.suppress(Exception):  # a terminal that was closed needs nothing; termios.error is no OSError
            termios.tcsetattr(self._fd, termios.TCSADRAIN, before)

    def read(self, timeout: float) -> str:
        """The next key, "" if none is pressed within `timeout` [s]. Arrow and function keys are swallowed whole.

        Where `reading` is false it returns "" at once.
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
