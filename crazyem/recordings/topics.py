"""Signals from topics (named rows of numbers with times); shared by the readers of ULog, tlog and rosbag2."""

from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.finding import Finding, Grade, note
from crazyem.recordings.recording import SignalArray
from crazyem.signals.sample import SIGNALS

# Bounds on columns without a mapping: 16 bytes per sample, so some hundred megabytes at most.
MOST_RAW_SIGNALS = 4000
MOST_RAW_SAMPLES = 24_000_000
LONGEST_TEXT = 300  # characters of a metadata value that are kept


@dataclass(frozen=True, slots=True, eq=False)
class Topic:
    """Messages of one kind."""

    name: str  # becomes the `stream` of its signals; raw columns are called "<name>.<column>"
    columns: Mapping[str, NDArray[np.generic]]  # column -> (n,) numbers, in the type in which they were stored
    time: NDArray[np.float64]  # (n,) s, on the time axis of the recording
    order: NDArray[np.int64]  # (n,) position of each row among the rows of all topics; a number occurs once
    host_time: NDArray[np.float64] | None = None  # (n,) s since the epoch, None where unknown
    clock: str = ""  # as in `SignalArray`
    units: Mapping[str, str] = field(default_factory=dict)  # column -> unit, where known

    def source_of(self, column: str) -> str:
        """The name of a column in the file."""
        return f"{self.name}.{column}"

    def raw_name(self, column: str, *, ambiguous: bool) -> str:
        """The name of the signal of a column without a meaning; `ambiguous`: another topic has such a column, too."""
        return self.source_of(column)

    def unit_of(self, column: str) -> str:
        """The unit of a column, "" where unknown."""
        return self.units.get(column, "")


@dataclass(frozen=True, slots=True, eq=False)
class Mapped:
    """A signal of the vocabulary, made from columns of a topic."""

    quantity: str  # key of `SIGNALS`
    topic: Topic
    value: NDArray[np.float64]  # (n, c) SI
    columns: tuple[str, ...]  # names of the source columns
    # (n,) True where the reader set NaN because the file says that the value is invalid; None: nowhere
    marked: NDArray[np.bool_] | None = None
    frame: str = ""  # the frame, if known better than in `SIGNALS`
    origin: str = ""  # "" for a candidate for the signal itself, a name such as "mocap" for a further measurement


@dataclass(frozen=True, slots=True)
class Source:
    """Which columns of a topic give a signal of the vocabulary; a reader has a table of these, the best first."""

    quantity: str
    topic: str
    columns: tuple[str, ...]
    # function from c columns of (n,) to (n, c) SI
    convert: Callable[[Sequence[NDArray[np.generic]]], NDArray[np.float64]]
    # function that returns (n,) True in rows that the message declares invalid; they become missing
    invalid: Callable[[Topic], NDArray[np.bool_]] | None = None
    absent_is_nan: bool = False  # the format uses NaN for "no value"
    frame: str = ""  # frame, origin: as in `Mapped`
    origin: str = ""
    zero_is_absent: bool = False  # 0 in every row means that no sensor is connected; the columns then stay raw

    def of(self, topics: Sequence[Topic]) -> Iterator[Mapped]:
        """The signal, from each topic that has the name and the columns."""
        for topic in topics:
            if not self.fits(topic) or self.is_absent(topic):
                continue
            marked = np.zeros(topic.time.size, bool) if self.invalid is None else self.invalid(topic)
            if marked.all() and marked.size:
                continue  # no valid value; the columns stay raw
            value = self.convert([topic.columns[c] for c in self.columns])
            if marked.any():
                value = np.where(marked[:, None], np.nan, value)
            if self.absent_is_nan:
                marked = marked | ~np.isfinite(value).all(axis=1)
            yield Mapped(self.quantity, topic, value, self.columns, marked, self.frame, self.origin)

    def fits(self, topic: Topic) -> bool:
        """Whether the topic has the name and the columns of this source."""
        return topic.name == self.topic and set(self.columns) <= topic.columns.keys()

    def is_absent(self, topic: Topic) -> bool:
        """Whether zeros in all rows show that no sensor is connected."""
        return self.zero_is_absent and topic.time.size > 0 and not any(topic.columns[c].any() for c in self.columns)


# Signals that are 0 throughout without a connected sensor, with the reason as text.
_SENSORS = {"voltage": "no battery monitor is connected", "rotor_speed": "no sensor is connected, or no rotor turned"}


def unconnected(
    topics: Sequence[Topic], sources: Sequence[Source], measured: Mapping[str, object]
) -> tuple[dict[str, str], list[Finding]]:
    """Signals that no sensor measures although the file has a topic for them: signal -> why, and a finding for each.

    Args:
        topics, sources: of the reader.
        measured: the signals that the recording has, perhaps from other sources.
    """
    why: dict[str, str] = {}
    for source in sources:
        for topic in topics:
            if source.quantity not in measured and source.fits(topic) and source.is_absent(topic):
                text = f"{topic.name} reads 0 in all of its {topic.time.size} records: {_SENSORS[source.quantity]}"
                why.setdefault(source.quantity, text)
    found = [Finding("mapping", Grade.HARMLESS, f"{s} is not measured: {text}.", signal=s) for s, text in why.items()]
    return why, found


def named(pattern: str, parts: str) -> tuple[str, ...]:
    """Column names: the pattern with its star replaced by each of the parts."""
    return tuple(pattern.replace("*", part) for part in parts.split())


def floats(column: NDArray[np.generic]) -> NDArray[np.float64]:
    """(n,) as float64; NaN stays NaN, also signalling NaN of damaged files."""
    with np.errstate(invalid="ignore"):
        return np.asarray(column, np.float64)


def seconds(count: NDArray[np.generic], per_second: float = 1e6) -> NDArray[np.float64]:
    """(n,) s from whole microseconds (or another fraction of a second), each rounded to the nearest double."""
    return np.asarray(floats(count) / per_second, np.float64)


def ranks(times: Sequence[NDArray[np.generic]]) -> list[NDArray[np.int64]]:
    """Place of each row among the rows of all topics, sorted by time; equal times in the order of the topics."""
    sizes = [t.size for t in times]
    flat = np.concatenate(times) if times else np.empty(0)
    place = np.empty(flat.size, np.int64)
    place[np.argsort(flat, kind="stable")] = np.arange(flat.size)
    return np.split(place, np.cumsum(sizes)[:-1]) if times else []


def signals_of(
    topics: Sequence[Topic], mapped: Sequence[Mapped], *, bounded: bool = True
) -> tuple[dict[str, SignalArray], list[Finding]]:
    """Signals by name, and findings about columns that were left out.

    Args:
        topics: all of the recording.
        mapped: best first; the first of a quantity gets its name, the others are called "<quantity>@<topic>".
        bounded: leave out columns without a meaning beyond `MOST_RAW_SIGNALS` and `MOST_RAW_SAMPLES`.

    Returns: first the signals of the vocabulary, then every unused column by `Topic.raw_name`; and the findings.
    """
    mapped = [m for m in mapped if m.topic.time.size or not bounded]
    used = {(id(m.topic), column) for m in mapped for column in m.columns}
    raw = [(t, c) for t in topics for c in t.columns if (id(t), c) not in used]
    raw, left_out = _within_bounds(raw) if bounded else (raw, [])
    # places for all signals of a row, so that orders are unique; unbounded columns without a meaning share one place,
    # to save memory
    step = len(mapped) + (len(raw) if bounded else 1)
    hosts = {id(t): np.full(t.time.size, np.nan) if t.host_time is None else t.host_time for t in topics}
    unmarked = {id(t): np.zeros(t.time.size, bool) for t in topics}
    shared = {id(t): t.order * step + len(mapped) for t in topics if not bounded}
    found: dict[str, SignalArray] = {}
    for place, m in enumerate(mapped):
        topic, (_, unit, frame) = m.topic, SIGNALS[m.quantity]
        name = f"{m.quantity}@{m.origin}" if m.origin else m.quantity
        name = _unique(f"{m.quantity}@{topic.name}" if name in found else name, found)
        marked = unmarked[id(topic)] if m.marked is None else m.marked & ~np.isfinite(m.value).all(axis=1)
        order, source = topic.order * step + place, tuple(map(topic.source_of, m.columns))
        about = (m.quantity, unit, m.frame or frame, topic.clock, topic.name, source)
        found[name] = SignalArray(topic.time, m.value, order, hosts[id(topic)], marked, *about)
    signals = {name: found[name] for name in sorted(found, key=lambda name: list(SIGNALS).index(name.split("@")[0]))}
    times = Counter(column for _, column in raw)
    for place, (topic, column) in enumerate(raw, start=len(mapped)):
        # two topics of one name: in damaged files, or "a_1" beside the second "a"
        name = _unique(topic.raw_name(column, ambiguous=times[column] > 1), signals)
        value, key = floats(topic.columns[column])[:, None], id(topic)
        about = ("", topic.unit_of(column), "", topic.clock, topic.name, (topic.source_of(column),))
        order = topic.order * step + place if bounded else shared[key]
        signals[name] = SignalArray(topic.time, value, order, hosts[key], unmarked[key], *about)
    return signals, left_out


def _unique(name: str, taken: Container[str]) -> str:
    while name in taken:
        name += "'"
    return name


def _within_bounds(raw: list[tuple[Topic, str]]) -> tuple[list[tuple[Topic, str]], list[Finding]]:
    """The columns that fit the bounds, chosen from the shortest on, in their original order."""
    place = sorted(range(len(raw)), key=lambda i: raw[i][0].time.size)
    total = 0
    kept = set()
    for i in place[:MOST_RAW_SIGNALS]:
        total += raw[i][0].time.size
        if total > MOST_RAW_SAMPLES:
            break
        kept.add(i)
    if len(kept) == len(raw):
        return raw, []
    first = next(f"{t.name}.{c}" for i, (t, c) in enumerate(raw) if i not in kept)
    text = (
        f"{len(raw) - len(kept)} of {len(raw)} columns without a meaning here were left out to bound memory, "
        f"the first is {first}."
    )
    finding = note("mapping", text, left_out=float(len(raw) - len(kept)))
    return [pair for i, pair in enumerate(raw) if i in kept], [finding]


def damage(skipped: Sequence[tuple[int, int]], size: int, what: str) -> list[Finding]:
    """Findings about bytes that belong to no sound message.

    Args:
        skipped: (offset, count) of each run, in order.
        size: of the file, bytes.
        what: the word for a message.
    """
    found = []
    cut = [run for run in skipped if sum(run) == size]
    for offset, count in cut:
        text = f"The last {count} bytes, from byte {offset} on, are no whole {what}: the file is cut short or damaged."
        found.append(note("integrity", text, Grade.DEGRADES, offset=float(offset), bytes=float(count)))
    inside = [run for run in skipped if sum(run) != size]
    if inside:
        total = sum(count for _, count in inside)
        places = ", ".join(str(offset) for offset, _ in inside[:5]) + (", ..." if len(inside) > 5 else "")
        text = f"{total} bytes in {len(inside)} places (at byte {places}) are no sound {what} and were skipped."
        found.append(
            note("integrity", text, Grade.DEGRADES, offset=float(inside[0][0]), bytes=float(total), places=len(inside))
        )
    return found


def text_of(value: object) -> str:
    """A metadata value as printable text of limited length."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    text = "".join(c if c.isprintable() else " " for c in str(value)[: 4 * LONGEST_TEXT]).strip()
    return text if len(text) <= LONGEST_TEXT else text[: LONGEST_TEXT - 3] + "..."
