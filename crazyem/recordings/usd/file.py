"""Read logs of the uSD card deck (Crazyflie), versions 1 and 2: one table per event, up to the last whole record."""

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
    """True if these first bytes are those of such a log, which has no extension, only a magic byte and a header."""
    return plausible(head)


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
