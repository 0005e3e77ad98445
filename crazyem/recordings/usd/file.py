"""Logs of the Crazyflie's uSD card deck, versions 1 and 2: a table for each event, read to the last whole record."""

import math
from collections.abc import Iterator
from pathlib import Path

from crazyem.errors import FileFormatError
from crazyem.recordings import motor_meaning
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.recording import Recording
from crazyem.recordings.tables import signals_from_tables
from crazyem.recordings.usd import content
from crazyem.recordings.usd.format import plausible
from crazyem.recordings.usd.stretches import STRETCH_BYTES, Survey, stretches


def recognises(head: bytes) -> bool:
    """True if a file starting with these bytes is one: the files have no extension, only a magic byte and a header."""
    return plausible(head)


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a log: signals of stream "fixedFrequency" and of each other event, on the firmware's clock.

    Time is the stamp in seconds, as the file has it (`origin` is 0). Events without variables become `Event`s, whose
    time is on the firmware's clock too: the file has no other.

    Raises: FileFormatError if the header makes no sense or not a single whole record follows it.
    """
    return next(_recordings(path, options, seconds=math.inf, largest=math.inf))


def read_parts(path: Path, options: ReadOptions, seconds: float = 60.0) -> Iterator[Recording]:
    """Consecutive stretches of at least `seconds` of a log, in bounded memory; joined they are what `read` gives.

    The file is read twice: first for its checksum, how many records of which kind it has, and what motor.m1..4 is (of
    very many rows a share decides, evenly spread). All parts have all signals, some perhaps empty, and the metadata of
    the whole; what is said of the motors comes with the first part, what is said of the file's end with the last.

    Raises: as `read`, with the first part.
    """
    return _recordings(path, options, seconds=seconds, largest=STRETCH_BYTES)


def _recordings(path: Path, options: ReadOptions, *, seconds: float, largest: float) -> Iterator[Recording]:
    """A recording for each stretch of at least `seconds`, or of `largest` bytes of records."""
    survey = Survey(path)
    header = survey.header
    if not sum(survey.counts):
        raise FileFormatError(f"{path} has a header of {header.size} bytes and not a single whole record after it.")
    verdict = survey.integrity(last=0.0)[0]
    metadata = {"usd": content.metadata(header, survey.counts, verdict)}
    meaning = motor_meaning.decide(survey.tables(), given=options.motor, metadata=metadata)
    findings = meaning.findings
    for part in stretches(survey, seconds, largest):
        tables = [
            content.table(event, values, part.time[rows], part.first + rows)
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
            content.events(header, part.order, part.time),
        )
        findings = ()
