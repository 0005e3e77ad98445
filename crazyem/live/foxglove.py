"""Streams a running session to Foxglove: topics and messages of a recording, over a WebSocket on this host.

The recorder's own code (`RecordingWriter`) makes the messages, so the layout of `crazyem layout` works for a flight and
for its recording. The server belongs to foxglove-sdk and has its own threads; a slow viewer loses messages.
"""

import contextlib
import functools
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any

from crazyem.errors import UsageError
from crazyem.extras import require
from crazyem.live.history import Recorder
from crazyem.recordings.mcap.writer import RecordingWriter

FOXGLOVE_PORT = 8765  # default port of viewers
FOXGLOVE_HOST = "127.0.0.1"  # this host only, because anybody who reaches the port sees the flight
FRAME_SCHEMA = "foxglove.FrameTransform"


def sdk() -> ModuleType:
    """The module foxglove. Raises MissingExtraError if it is not installed."""
    return require("foxglove", "--foxglove")


class FoxgloveServer:
    """A WebSocket server for viewers; a context manager.

    Args:
        port: 0 takes any free one.

    Raises: UsageError: foxglove-sdk is missing, or the port is not available.
    """

    def __init__(self, port: int = FOXGLOVE_PORT) -> None:
        module = sdk()
        self._context = module.Context()
        try:
            self._server: Any = module.start_server(
                name="crazyem", host=FOXGLOVE_HOST, port=port, context=self._context
            )
        except (OSError, RuntimeError, ValueError) as error:
            raise UsageError(f"the live stream cannot listen on {FOXGLOVE_HOST}:{port}: {error}.") from None
        self.port = int(self._server.port)

    def __enter__(self) -> "FoxgloveServer":
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(RuntimeError):
            self._server.stop()

    @property
    def url(self) -> str:
        """Address for viewers."""
        return f"ws://{FOXGLOVE_HOST}:{self.port}"

    def recorder(self, name: str = "") -> RecordingWriter:
        """The recorder through which a session streams; `name` comes before its topics, if not "" (/NAME/estimate)."""
        return RecordingWriter("", output=Topics(self._context, name))


class Topics:
    """An `Output` of a recording that sends all messages to the server's channels."""

    def __init__(self, context: Any, name: str) -> None:
        self._foxglove = sdk()
        self._context, self._name = context, name
        self._schemas: list[Any] = []
        self._channels: list[Any] = []
        self._frames: set[int] = set()

    def start(self, profile: str, library: str) -> None:
        """Does nothing."""

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Number of a schema."""
        self._schemas.append(self._foxglove.Schema(name=name, encoding=encoding, data=data))
        return len(self._schemas)

    def channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str] | None = None) -> int:
        """Number of a new topic."""
        kind = self._schemas[schema - 1]
        prefix = f"/{self._name}" if self._name and kind.name != FRAME_SCHEMA else ""  # frames: see `_renamed`
        self._channels.append(
            self._foxglove.Channel(
                f"{prefix}{topic}", schema=kind, message_encoding=encoding, context=self._context,
                metadata=dict(metadata or {}),
            )
        )  # fmt: skip
        if kind.name == FRAME_SCHEMA:
            self._frames.add(len(self._channels))
        return len(self._channels)

    def message(self, channel: int, log_time: int, data: bytes, *, sequence: int, publish_time: int) -> None:
        """One message, `log_time` in ns since the epoch."""
        if self._name and channel in self._frames:
            data = self._renamed(data)
        self._channels[channel - 1].log(data, log_time=log_time)

    def _renamed(self, data: bytes) -> bytes:
        """A transform with the name of this drone's frame."""
        from crazyem.recordings.mcap.schemas import message_class

        message = message_class(FRAME_SCHEMA).FromString(data)
        message.child_frame_id = self._name
        return bytes(message.SerializeToString())

    def metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Not for viewers."""

    def flush(self, *, sync: bool = False) -> None:
        """Does nothing: messages are sent at once."""

    def finish(self) -> None:
        """See `close`."""

    def close(self) -> None:
        """Close the topics."""
        for channel in self._channels:
            channel.close()


class Both:
    """Two recorders as one: a file and a stream. Every call goes to both.

    Path and failure are those of the file, "" without one. A failed stream does not affect the file.
    """

    def __init__(self, file: Recorder | None, stream: Recorder) -> None:
        self._file = file
        self._all: list[Recorder] = [r for r in (file, stream) if r is not None]
        self.path = file.path if file is not None else ""

    @property
    def failure(self) -> str:
        """Of the file."""
        return self._file.failure if self._file is not None else ""

    def frame(self, *arguments: Any) -> None:
        """See `FrameRecorder`, whose check needs this method by name."""
        self._each("frame", *arguments)

    def __getattr__(self, method: str) -> Callable[..., None]:
        return functools.partial(self._each, method)

    def _each(self, method: str, *arguments: Any) -> None:
        for recorder in self._all:
            getattr(recorder, method)(*arguments)
