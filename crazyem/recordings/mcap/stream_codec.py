"""Messages of fixed length with fields of eight bytes: arrays to protobuf bytes and back, column by column.

Two kinds of channels use them: log blocks of a flight (schemas.BlockCodec) and signals of an imported recording
(`StreamLayout`). Every protobuf decoder can read them; here they are a numpy record array with tags between the fields.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.mcap import schemas

MOST_SIGNALS = 60  # in one message; each has a bit in `marked`
MOST_FIELDS = 4096  # in one message; guards against damaged metadata


class FixedMessages:
    """Messages whose fields are all doubles or 64-bit integers and all present.

    Args:
        kinds: numpy type of each field, "<f8", "<i8" or "<u8"; fields are numbered from 1.
    """

    def __init__(self, kinds: Sequence[str]) -> None:
        tags = [schemas.tag(number) for number in range(1, len(kinds) + 1)]
        offsets = np.cumsum([len(tag) + 8 for tag in tags]) - 8
        self.size = int(offsets[-1]) + 8
        names = [str(i) for i in range(len(kinds))]
        self._dtype = np.dtype(
            {"names": names, "formats": list(kinds), "offsets": offsets.tolist(), "itemsize": self.size}
        )
        self._blank = np.frombuffer(b"".join(tag + bytes(8) for tag in tags), np.uint8)
        self._tags = np.delete(np.arange(self.size), offsets[:, None] + np.arange(8))

    def encode(self, columns: Sequence[NDArray[Any]]) -> NDArray[np.uint8]:
        """(n, size) bytes of n messages, from one (n,) array per field."""
        count = len(columns[0])
        rows = np.empty((count, self.size), np.uint8)
        rows[:] = self._blank
        fields = rows.view(self._dtype)[:, 0]
        for name, column in zip(self._dtype.names or (), columns, strict=True):
            fields[name] = column
        return rows

    def decode(self, data: NDArray[np.uint8], offsets: NDArray[np.int64]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """(n,) record array with fields "0", "1", ... of the messages at `offsets`, and (n,) True for sound messages.

        A whole message must follow every offset.
        """
        rows = np.empty((0, self.size), np.uint8)
        if offsets.size:
            rows = np.lib.stride_tricks.sliding_window_view(data, self.size)[offsets]
        sound = (rows[:, self._tags] == self._blank[self._tags]).all(axis=1)
        return rows.view(self._dtype)[:, 0], sound


@dataclass(frozen=True, slots=True)
class Column:
    """A signal in a stream, described as in `SignalArray`."""

    name: str
    index: int  # place among the signals of the recording
    components: tuple[str, ...]  # names of the components; in a file, names of the fields
    quantity: str = ""
    unit: str = ""
    frame: str = ""
    clock: str = ""
    source: tuple[str, ...] = ()

    @property
    def width(self) -> int:
        """Number of components."""
        return len(self.components)


@dataclass(frozen=True)
class StreamLayout:
    """The messages of one stream: time, host_time, marked, perhaps row, then the components of its signals."""

    identifier: str  # a protobuf name, unique in the file
    stream: str  # as in `SignalArray`
    signals: tuple[Column, ...]  # in processing order
    rows: bool = False  # messages contain their row in the arrays, because it differs from the processing order

    @property
    def schema_name(self) -> str:
        return f"crazyem.signals.{self.identifier}"

    @cached_property
    def messages(self) -> FixedMessages:
        fixed = ["<f8", "<f8", "<u8", *(["<i8"] if self.rows else [])]
        return FixedMessages(fixed + ["<f8"] * sum(s.width for s in self.signals))

    @property
    def first(self) -> int:
        """Number of the field of the first component, from 0."""
        return 4 if self.rows else 3

    def fields(self) -> list[tuple[str, str]]:
        """Name and protobuf type of each field."""
        fields = [("time", "double"), ("host_time", "double"), ("marked", "fixed64")]
        fields += [("row", "sfixed64")] if self.rows else []
        taken = {name for name, _ in fields}
        for signal in self.signals:
            for component in signal.components:
                name = unique_name(f"{signal.name}_{component}" if component else signal.name, taken)
                fields.append((name, "double"))
        return fields

    def schema_data(self) -> bytes:
        """Serialised FileDescriptorSet."""
        return schemas.dynamic_schema("crazyem.signals", self.identifier, self.fields())

    def metadata(self) -> dict[str, str]:
        """Metadata of the channel, sufficient to read its signals back."""
        names = iter([name for name, _ in self.fields()[self.first :]])
        signals = [replace(s, components=tuple(next(names) for _ in s.components)) for s in self.signals]
        text = json.dumps([asdict(s) for s in signals])
        return {"stream": self.stream, "rows": str(int(self.rows)), "signals": text}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> "StreamLayout":
        """Inverse of `metadata`, as far as reading needs. Raises ValueError or KeyError on anything else."""
        columns = msgspec.json.decode(metadata["signals"], type=tuple[Column, ...])
        if not columns or len(columns) > MOST_SIGNALS or sum(c.width for c in columns) > MOST_FIELDS:
            raise ValueError("not a stream of signals")
        return cls("", str(metadata["stream"]), columns, metadata["rows"] == "1")


def unique_name(text: str, taken: set[str]) -> str:
    """A protobuf identifier similar to `text` that differs from all in `taken`; it is added to `taken`."""
    name = re.sub(r"[^A-Za-z0-9_]+", "_", text).strip("_") or "x"
    name = f"x{name}" if name[0].isdigit() else name
    candidate, number = name, 1
    # JSON names of protobuf fields have no underscores and change capitals: names must differ without these too
    keys = {_key(t) for t in taken}
    while _key(candidate) in keys:
        number += 1
        candidate = f"{name}_n{number}"
    taken.add(candidate)
    return candidate


def _key(name: str) -> str:
    return name.replace("_", "").lower()
