"""What the commands of the simulator share: UDP sockets, a file for the truth, and an end by a signal."""

import contextlib
import signal
import socket
from pathlib import Path
from typing import Protocol, TextIO

from firmware_sim.errors import ServerError

_BUFFER = 1 << 20  # bytes, both ways: a client reads its whole table of contents in bursts


def udp_socket() -> socket.socket:
    """A non-blocking UDP socket with large buffers."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        sock.setsockopt(socket.SOL_SOCKET, option, _BUFFER)
    sock.setblocking(False)
    return sock


def bind(host: str, port: int) -> socket.socket:
    """A `udp_socket` that is bound; port 0 picks a free one. Raises ServerError in one sentence."""
    sock = udp_socket()
    try:
        sock.bind((host, port))
    except (OSError, OverflowError) as error:
        sock.close()
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ServerError(f"cannot listen on udp://{host}:{port}: {reason}") from None
    return sock


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
