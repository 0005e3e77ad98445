"""Read logs of the uSD card deck (Crazyflie), versions 1 and 2: one table per event, up to the last whole record."""

import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.recordings import motor_meaning
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.recording import Event, Recording
from crazyem.recordings.tables import signals_from_tables
from crazyem.recordings.usd.format import LONGEST_NAME, MOST_EVENTS, USD_MAGIC, Header, table
from crazyem.recordings.usd.stretches import STRETCH_BYTES, Survey, stretches


def recognises(head: bytes) -> bool:
    """True if these first bytes have the form of a log header with a named first event."""
    if len(head) < 8 or head[0] != USD_MAGIC:
        return False
    version, count = struct.unpack_from("<HH", head, 1)
    name = head[7 : 7 + LONGEST_NAME].split(b"\0", 1)[0]
    return 0 < version < 16 and 0 < count <= MOST_EVENTS and name.isascii() and name.decode("ascii").isprintable()


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a log: signals of stream "fixedFrequency" and of each other event, on the firmware's clock.

    Time is the stamp of the file in seconds (`origin` is 0). Events without variables become `Event`s, with times on
    the same firmware clock, the only clock of the file.

    Raises: FileFormatError if the header is invalid or no whole record follows it.
    """
    return next(_recordings(path, options, seconds=math.inf, largest=math.inf))


def read_parts(path: Path, options: ReadOptions, seconds: float = 60.0) -> Iterator[Recording]:
    """Consecutive parts of at least `seconds` of a log, in bounded memory; joined they equal the result of `read`.

    The file is read twice. The first pass gives the checksum, the number of records of each kind, and the meaning of
    motor.m1..4 (from evenly spread rows if there are many). All parts have all signals, some perhaps empty, and the
    metadata of the whole log. The first part has the findings about motors, the last those about the end of the file.

    Raises: as `read`, with the first part.
    """
    return _recordings(path, options, seconds=seconds, largest=STRETCH_BYTES)


def _recordings(path: Path, options: ReadOptions, *, seconds: float, largest: float) -> Iterator[Recording]:
    """A recording for each stretch of at least `seconds`, or of `largest` bytes of records if earlier."""
    survey = Survey(path)
    header = survey.header
    if not sum(survey.counts):
        raise FileFormatError(f"{path} has a header of {header.size} bytes and not a single whole record after it.")
    verdict = survey.integrity(last=0.0)[0]
    metadata = {"usd": _metadata(header, survey.counts, verdict)}
    meaning = motor_meaning.decide(survey.tables(), given=options.motor, metadata=metadata)
    findings = meaning.findings
    for part in stretches(survey, seconds, largest):
        tables = [
            table(event, values, part.time[rows], part.first + rows)
            for event, values, rows, count in zip(header.events, part.packed, part.order, survey.counts, strict=True)
            if count and event.variables
        ]
        if part.ends:
            findings = (*survey.integrity(last=float(part.time[-1]))[1], *findings)
        yield Recording(
            str(path),
            f"usd:{header.version}",
            signals_from_tables(tables, motor=meaning.meaning),
            metadata | meaning.metadata,
            findings,
            _events(header, part.order, part.time),
        )
        findings = ()


def _events(header: Header, order: Sequence[NDArray[np.intp]], time: NDArray[np.float64]) -> tuple[Event, ...]:
    """Events without variables."""
    bare = [(i, event.name) for i, event in enumerate(header.events) if not event.variables]
    rows = sorted((int(row), name) for i, name in bare for row in order[i])
    return tuple(Event(float(time[row]), "log", {"name": name, "clock": "firmware"}) for row, name in rows)


def _metadata(header: Header, counts: Sequence[int], verdict: str) -> dict[str, str]:
    """The section "usd": data of the header, number of records of each kind, result of the CRC check."""
    section = {"version": str(header.version), "crc": verdict, "events": " ".join(e.name for e in header.events)}
    for event, count in zip(header.events, counts, strict=True):
        names = " ".join(f"{v}({t})" for v, t in zip(event.variables, event.letters, strict=True))
        section[f"records.{event.name}"] = str(count)
        section[f"variables.{event.name}"] = names
    return section
