"""Read recordings of crazyem (MCAP), whole or cut off: all complete chunks, in the order of writing."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from crazyem.errors import FileFormatError
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.mcap.content import Content, join
from crazyem.recordings.mcap.scan import MCAP_MAGIC, Loss, Part, Problem, from_summary, parts, profile_of
from crazyem.recordings.mcap.schemas import IMPORT_METADATA, PROFILE, findings_from_json
from crazyem.recordings.motor_meaning import decide
from crazyem.recordings.recording import Recording, SignalArray
from crazyem.recordings.tables import Table, signals_from_tables

_PART_BYTES = 256 * 1024 * 1024  # bytes; largest unpacked size of a part of `read_parts`, at any length in time


def recognises(head: bytes) -> bool:
    """True for MCAP of crazyem: profile "crazyem", or a damaged header that still contains the word."""
    profile = profile_of(head)
    return profile == PROFILE or (profile is None and head.startswith(MCAP_MAGIC) and b"crazyem" in head[:128])


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a recording of crazyem; of a cut-off or damaged file all that is readable, with findings about the rest.

    Raises: FileFormatError if the file has no log data of crazyem.
    """
    return next(read_parts(path, options, math.inf))


def read_parts(path: Path, options: ReadOptions, seconds: float = 60.0) -> Iterator[Recording]:
    """Read a recording of any size in parts, in bounded memory.

    The joined parts equal the result of `read`. Each part has the samples and events of at least `seconds` (by log
    time; chunks are not split), and the metadata and findings known at its end. All parts have the same origin of time.
    One exception: a signal whose rows are not in processing order comes in processing order.

    Raises: as `read`, with the first part.
    """
    in_parts = seconds < math.inf
    reading = _Reading(path, options, in_parts=in_parts)
    if in_parts and not reading.announced:
        # cut off, so without a summary: the channels are known only after a pass over the file
        for part in parts(path, []):
            reading.announced.extend(part.announced)
    reading.content.announce(reading.announced)
    begun: int | None = None
    size, first = 0, True
    for part in reading.parts():
        reading.take(part)
        if part.scan is None or not len(part.scan.messages):
            continue
        times = part.scan.messages[:, 3]
        begun = int(times[0]) if begun is None else begun
        size += part.scan.data.size
        if in_parts and (int(times[-1]) - begun >= seconds * 1e9 or size >= _PART_BYTES):
            yield reading.recording()
            begun, size, first = None, 0, False
    if first:
        reading.check()
    if first or begun is not None or reading.content.events:
        yield reading.recording()


class _Reading:
    """One pass over a file."""

    def __init__(self, path: Path, options: ReadOptions, *, in_parts: bool = False) -> None:
        self.path, self.options = path, options
        self.problems: list[Problem] = []
        self.announced, counts = from_summary(path)
        self.content = Content({} if in_parts else counts)
        self._lost: dict[int, int] = {}  # number of the problem -> messages
        self._sequence = 0
        self._samples = False
        self._motor: str | None = None
        self._told: list[Finding] = []
        self._decided: Mapping[str, Mapping[str, str]] = {}

    def parts(self) -> Iterator[Part]:
        # the summary repeats announcements that may be lost in a damaged chunk
        self.content.announce(self.announced)
        return parts(self.path, self.problems)

    def take(self, part: Part) -> None:
        self.content.take(part)
        if part.scan is None or not len(part.scan.messages):
            return
        numbers = part.scan.messages[:, 5]
        missing = int(numbers[0]) - self._sequence - 1
        damaged = [i for i, p in enumerate(self.problems) if p.loss is Loss.DAMAGED and i not in self._lost]
        if damaged:
            self._lost.update(dict.fromkeys(damaged, 0))
            self._lost[damaged[-1]] = max(missing, 0)
        self._sequence = int(numbers[-1])

    def check(self) -> None:
        """Raise FileFormatError if the file has no data for a recording."""
        if not self.content.empty or IMPORT_METADATA in self.content.metadata:
            return
        what = "it holds no log blocks"
        if self.problems:
            problem = self.problems[0]
            cut = problem.loss is not Loss.DAMAGED
            what = "it was cut off before its first log data" if cut else f"it is damaged at byte {problem.offset}"
        raise FileFormatError(f"{self.path} is an MCAP file, but not a usable recording: {what}.")

    def recording(self) -> Recording:
        """The recording of all parts taken since the last call."""
        own = self.content.metadata.get(IMPORT_METADATA)
        sessions = self.content.tables()
        signals = self._signals(sessions)
        signals.update(self.content.streams())
        self._samples = self._samples or any(array.time.size for array in signals.values())
        if not self._samples and own is None:
            raise FileFormatError(f"{self.path} is a recording without a single sample.")
        events, self.content.events = tuple(self.content.events), []
        metadata = {name: entries for name, entries in self.content.metadata.items() if name != IMPORT_METADATA}
        metadata.update({name: dict(entries) for name, entries in self._decided.items()})
        origin, source, imported = _imported(own)
        return Recording(str(self.path), source, signals, metadata, (*imported, *self._findings()), events, origin)

    def _signals(self, sessions: Mapping[int, list[Table]]) -> dict[str, SignalArray]:
        if not sessions:
            return {}
        motor = self._meaning([table for tables in sessions.values() for table in tables])
        found = []
        for tables in sessions.values():
            signals = signals_from_tables(tables, motor=motor)
            found.append({name: array for name, array in signals.items() if array.time.size})
        return join(found)

    def _meaning(self, tables: Sequence[Table]) -> str:
        """The meaning of motor.m1..4, decided once for a file; without evidence "duty", as in live flight."""
        if self._motor is None:
            decided = decide(tables, given=self.options.motor, metadata=self.content.metadata)
            if any("motor.m1" in table.columns for table in tables):
                self._told = [f for f in decided.findings if f.grade is not Grade.HARMLESS]
                self._decided = decided.metadata
            self._motor = decided.meaning or "duty"
        return self._motor

    def _findings(self) -> tuple[Finding, ...]:
        found = [finding_of(p, lost_messages=self._lost.get(i)) for i, p in enumerate(self.problems)]
        if self.content.unreadable:
            n = self.content.unreadable
            text = f"{n} messages could not be decoded and were dropped."
            found.append(note("integrity", text, Grade.DEGRADES, messages=float(n)))
        return (*self._told, *found)


def _imported(own: Mapping[str, str] | None) -> tuple[float, str, tuple[Finding, ...]]:
    """Origin, source and findings of an imported recording; defaults for a flight recorded by crazyem."""
    if own is None:
        return 0.0, "mcap", ()
    try:
        origin = float(own.get("origin", "0"))
        findings = findings_from_json(own.get("findings", "[]"))
    except (ValueError, RecursionError):
        text = "What the first reader of this recording noticed cannot be read any more."
        return 0.0, own.get("source", "mcap"), (note("integrity", text, Grade.DEGRADES),)
    return origin if math.isfinite(origin) else 0.0, own.get("source", "mcap"), findings


def finding_of(problem: Problem, *, lost_messages: int | None = None) -> Finding:
    """The finding about bytes that a reader could not use."""
    where = f"byte {problem.offset}"
    evidence = {"offset_byte": float(problem.offset), "lost_byte": float(problem.end - problem.offset)}
    lost = ""
    if lost_messages is not None:
        evidence["lost_messages"] = float(lost_messages)
        lost = f", {lost_messages} messages are lost"
    if problem.loss is Loss.OPEN:
        text = "The recording was not closed; every complete chunk was read, at most the last second is missing."
        return Finding("integrity", Grade.HARMLESS, text, evidence=evidence)
    if problem.loss is Loss.CUT:
        text = f"The file ends in the middle of a record ({where}); everything before it was read."
        return Finding("integrity", Grade.HARMLESS, text, evidence=evidence)
    text = f"The file is damaged at {where}: {problem.why}; {problem.end - problem.offset} bytes were left out{lost}."
    advice = "Look for another copy of the file; what is between the last sample before and the first after is gone."
    return Finding("integrity", Grade.DEGRADES, text, evidence=evidence, advice=advice)
