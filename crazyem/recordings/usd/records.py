"""Where the records of a uSD card log start, and all records of one kind as one structured array.

A record's length is known from its id only, so records must be walked from the first to the last. Logs are long runs of
one kind with few others between them, so a run is taken in one comparison; where kinds alternate, the walk is a plain
loop (0.3 us a record).
"""

from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.usd.format import EventType

BLANK_BYTES = (b"\xff", b"\x00")  # erased flash; clusters that were set aside and never written
_RUN_RECORDS = 16  # records of one kind in a row before a run is guessed
_WINDOW_RECORDS = 1 << 16  # records compared at once, at most: bounds the memory of a comparison
_GATHERED_BYTES = 1 << 22  # bytes copied at once where records of one kind do not lie side by side


@dataclass(frozen=True, slots=True, eq=False)
class Records:
    """Whole records in file order.

    Attributes:
        start: (n,) byte at which each starts.
        kind: (n,) index of its event type.
        stop: byte after the last whole record.
        unknown: the event id found at `stop`, None if the bytes simply run out there.
    """

    start: NDArray[np.int64]
    kind: NDArray[np.uint16]
    stop: int
    unknown: int | None


def locate(data: bytes, events: tuple[EventType, ...], begin: int, end: int) -> Records:
    """Every whole record of `data[begin:end]`, up to the first that is cut off or of an unknown kind."""
    sizes = {event.identifier.to_bytes(2, "little"): event.layout.itemsize for event in events}
    start = array("q")
    append = start.append
    at, previous, streak = begin, b"", 0
    while True:
        identifier = data[at : at + 2]
        size = sizes.get(identifier)
        if size is None or at + size > end:
            break
        if identifier != previous:
            previous, streak = identifier, 0
        streak += 1
        if streak < _RUN_RECORDS:
            append(at)
            at += size
            continue
        run = _run(data, at, end, size, int.from_bytes(identifier, "little"))
        start.frombytes(np.arange(at, at + run * size, size, dtype=np.int64).tobytes())
        at += run * size
        streak = _RUN_RECORDS - 1 if run == _WINDOW_RECORDS else 0  # a full window: the run may go on
    starts = np.frombuffer(start, np.int64)
    unknown = int.from_bytes(identifier, "little") if size is None and at + 2 <= end else None
    return Records(starts, _kinds(data, events, starts), at, unknown)


def blank_from(data: bytes) -> int:
    """Where a run of one and the same byte that nobody wrote (0xFF of erased flash, 0) begins that ends the data."""
    last = data[-1:]
    return len(data.rstrip(last)) if last in BLANK_BYTES else len(data)


def written(records: Records, blank: int) -> Records:
    """The records that begin before `blank`, a byte: in erased flash even the number of an event is 0xFFFF."""
    count = int(np.searchsorted(records.start, blank))
    if count == records.start.size:
        return records
    return Records(records.start[:count], records.kind[:count], int(records.start[count]), None)


def _kinds(data: bytes, events: tuple[EventType, ...], start: NDArray[np.int64]) -> NDArray[np.uint16]:
    """(n,) index of the event type of each record."""
    kinds = np.zeros(start.size, np.uint16)
    if len(events) > 1:
        source = np.frombuffer(data, np.uint8)
        identifiers = source[start] | source[start + 1].astype(np.uint16) << 8
        for i, event in enumerate(events):
            kinds[identifiers == event.identifier] = i
    return kinds


def _run(data: bytes, at: int, end: int, size: int, identifier: int) -> int:
    """Length of the run of whole records of one kind that starts at `at`, at most a window."""
    count = min((end - at) // size, _WINDOW_RECORDS)
    same = np.ndarray((count,), "<u2", data, at, (size,)) == identifier
    return count if same.all() else int(np.argmin(same))


def gather(data: bytes, event: EventType, start: NDArray[np.int64]) -> NDArray[np.void]:
    """(n,) records of one kind; a view of `data` where they lie side by side, else a copy."""
    size = event.layout.itemsize
    if start.size and int(start[-1]) - int(start[0]) == (start.size - 1) * size:
        return np.frombuffer(data, event.layout, start.size, int(start[0]))
    source = np.frombuffer(data, np.uint8)
    result = np.empty((start.size, size), np.uint8)
    step = max(1, _GATHERED_BYTES // (8 * size))
    for first in range(0, start.size, step):
        rows = start[first : first + step]
        result[first : first + step] = source[rows[:, None] + np.arange(size)]
    return result.reshape(-1).view(event.layout)
