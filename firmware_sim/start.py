"""What the commands of the simulator share: a file for the truth, and an end by a signal."""

import contextlib
import signal
from pathlib import Path
from typing import Protocol, TextIO

from firmware_sim.errors import ServerError


class Stoppable(Protocol):
    """A loop that ends once `stopping` is set."""

    stopping: bool


def stop_on_signals(loop: Stoppable) -> None:
    """Let SIGINT and SIGTERM end the loop."""

    def stop(_signal: int, _frame: object) -> None:
        loop.stopping = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)


def open_truth(path: Path | None, stack: contextlib.ExitStack) -> TextIO | None:
    """The opened truth file, which `stack` closes; None without a path. Raises ServerError."""
    if path is None:
        return None
    try:
        return stack.enter_context(path.open("w", encoding="utf-8"))
    except OSError as error:
        raise ServerError(f"cannot write {path}: {error.strerror}") from None
