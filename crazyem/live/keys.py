"""Single keys from a terminal, read without blocking; the terminal is always restored."""

import atexit
import contextlib
import os
import select
import sys
from typing import Any

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
