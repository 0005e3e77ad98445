"""Recordings of any kind, for round trips through files; and what must be the same after one."""

import math
from typing import Any

import numpy as np
from hypothesis import strategies as st

from crazyem.recordings import Event, Finding, Fix, Grade, Recording, SignalArray
from crazyem.signals.sample import SIGNALS

KNOWN = ["position", "position@mocap", "voltage", "attitude", "motor_command", "wrench_command"]
numbers = st.floats(width=64) | st.sampled_from([math.nan, -0.0, 5e-324, 0.1 + 0.2, 1e300, 123456789.123456789])


@st.composite
def recordings(draw: st.DrawFn, names: st.SearchStrategy[str], words: st.SearchStrategy[str]) -> Recording:
    """Streams of several rates whose rows interleave in any order, with NaN, marks and texts of all sorts.

    names: of signals outside the vocabulary. words: units, frames, sources and all other texts.
    """
    chosen = draw(st.lists(st.sampled_from(KNOWN) | names, unique=True, min_size=1, max_size=6))
    streams = draw(st.lists(st.integers(0, 2), min_size=len(chosen), max_size=len(chosen)))
    lengths = [draw(st.integers(0, 5)) for _ in range(3)]
    lengths[streams[0]] = max(1, lengths[streams[0]])
    turns = draw(st.permutations([s for s in range(3) for _ in range(lengths[s])]))
    rows = {s: np.array([i for i, turn in enumerate(turns) if turn == s], np.int64) for s in range(3)}
    if draw(st.booleans()):  # processed in another order than they stand in
        rows[0] = rows[0][draw(st.permutations(range(lengths[0])))]
    times = {s: array(draw, lengths[s], st.sampled_from([0.0, 0.01, 1.5, math.nan]) | numbers) for s in range(3)}
    hosts = {s: array(draw, lengths[s], st.sampled_from([math.nan, 1.7e9, 1.7e9 + 1e-6])) for s in range(3)}
    named, clocks = [draw(words) for _ in range(3)], [draw(st.sampled_from(["", "firmware", "host"])) for _ in range(3)]
    signals, place = {}, 0
    for name, stream in zip(chosen, streams, strict=True):
        quantity = name.split("@")[0] if name in KNOWN else ""
        count = SIGNALS[quantity][0] if quantity else draw(st.integers(1, 3))
        unit, frame = SIGNALS[quantity][1:] if quantity else (draw(words), draw(words))
        n = lengths[stream]
        value = array(draw, n * count, numbers).reshape(n, count)
        marked = np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n)), bool)
        place += draw(st.sampled_from([1, 1000]))  # at once with the signal before, or apart from it
        signals[name] = SignalArray(
            times[stream], value, rows[stream] * 10_000 + place, hosts[stream], marked, quantity, unit, frame,
            clocks[stream], f"{stream} {named[stream]}", tuple(draw(st.lists(words, max_size=2))),
        )  # fmt: skip
    metadata = draw(st.dictionaries(words, st.dictionaries(words, words, max_size=2), max_size=2))
    found = tuple(draw(st.lists(findings(words, chosen[0]), max_size=2, unique_by=lambda f: f.text)))
    happened = tuple(draw(st.lists(events(words), max_size=3)))
    return Recording("there", draw(words), signals, metadata, found, happened, draw(st.floats(-1e9, 1e9)))


def array(draw: st.DrawFn, n: int, elements: st.SearchStrategy[float]) -> np.ndarray:
    return np.array(draw(st.lists(elements, min_size=n, max_size=n)), float)


def events(words: st.SearchStrategy[str]) -> st.SearchStrategy[Event]:
    data = st.dictionaries(words.filter(bool), st.integers(-5, 5) | numbers | words | st.none(), max_size=3)
    return st.builds(Event, st.floats(0, 2e9), st.sampled_from(["log", "setpoint", "other", ""]), data)


@st.composite
def findings(draw: st.DrawFn, words: st.SearchStrategy[str], signal: str) -> Finding:
    fix = Fix("mark", (signal,), (draw(numbers), math.inf), np.array(draw(st.lists(st.integers(0, 99))), np.int64))
    grade, evidence = draw(st.sampled_from(Grade)), {"share": draw(numbers)}
    return Finding(
        "gaps", grade, draw(words), signal, ((0.5, math.inf),), evidence, "Do.", draw(st.none() | st.just(fix))
    )


def word(x: float) -> str:
    """A double to the last bit, the sign of zero included; every NaN alike."""
    return "nan" if math.isnan(x) else float(x).hex()


def sequence(recording: Recording) -> list[tuple[Any, ...]]:
    """Every sample in processing order, all of it: what must not change."""
    samples = []
    for place, (name, a) in enumerate(recording.signals.items()):
        for i in range(a.time.size):
            values = tuple(word(x) for x in a.value[i].tolist())
            one = (name, word(a.time[i]), values, word(a.host_time[i]), bool(a.marked[i]))
            samples.append(((int(a.order[i]), place), one))
    return [one for _, one in sorted(samples, key=lambda s: s[0])]


def about(recording: Recording) -> list[tuple[Any, ...]]:
    signals = recording.signals.items()
    return [(n, a.quantity, a.unit, a.frame, a.clock, a.stream, a.source, a.value.shape) for n, a in signals]


def finding_words(f: Finding) -> tuple[Any, ...]:
    fix = None if f.fix is None else (f.fix.kind, f.fix.signals, f.fix.factor, np.asarray(f.fix.rows).tolist())
    return (f.check, str(f.grade), f.text, f.signal, f.intervals, dict(f.evidence), f.advice, fix)


def same(a: Recording, b: Recording) -> None:
    """Equal in all but the path, and the numbers (not the sequence) in `order`."""
    assert about(a) == about(b)
    assert sequence(a) == sequence(b)
    assert (a.source, a.metadata, word(a.origin)) == (b.source, b.metadata, word(b.origin))
    assert repr([(e.time, e.kind, e.data) for e in a.events]) == repr([(e.time, e.kind, e.data) for e in b.events])
    assert repr([finding_words(f) for f in a.findings]) == repr([finding_words(f) for f in b.findings])
