"""Recordings on disk for tests, how tests of commands run one, and recordings in parts against the whole."""

import os
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_flight import made_flight

from crazyem.cli import main
from crazyem.errors import FileFormatError
from crazyem.recordings import Recording, SignalArray
from crazyem.recordings.export import export

ARRAYS = ("time", "value", "order", "host_time", "marked")


def save(recording: Recording, path: Path) -> Path:
    export(recording, path)
    return path


def flight_fixture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound recording of 8 s; never changed by a test."""
    return save(made_flight(seconds=8.0), tmp_path_factory.mktemp("flight") / "flight.csv")


def folder_fixture(tmp_path: Path, flight: Path) -> Path:
    """Two recordings, one folder deeper a third, one that is broken, and things that are no recordings."""
    top = tmp_path / "lab"
    (top / "day two").mkdir(parents=True)
    for name in ("b.csv", "a.csv", "day two/a.csv"):
        link_pair(flight, top / name)
    (top / "README.txt").write_text("Flights, all of them.\nSee above.\n")
    (top / "x.csv-metadata.json").write_text("{}")
    (top / ".hidden.csv").write_bytes(flight.read_bytes())
    (top / "broken.csv").write_text("time [s],host_time [s],voltage [V]\n0,,x\n")
    os.mkfifo(top / "pipe")
    (top / "day two" / "up").symlink_to(top)
    (top / "nowhere").symlink_to(top / "gone")
    return top


def link_pair(source: Path, target: Path) -> None:
    target.write_bytes(source.read_bytes())
    Path(f"{target}-metadata.json").write_bytes(Path(f"{source}-metadata.json").read_bytes())


def run(capsys: pytest.CaptureFixture[str], *argv: object) -> tuple[int, str, str]:
    """Exit code, standard output, standard error."""
    code = main([str(a) for a in argv])
    out, err = capsys.readouterr()
    assert "Traceback" not in err
    assert "\x1b" not in out + err
    return code, out, err


def fails(capsys: pytest.CaptureFixture[str], *argv: object, code: int) -> str:
    """Run, expect this exit code and one sentence; return it."""
    got, _, err = run(capsys, *argv)
    assert got == code, err
    lines = [line for line in err.splitlines() if line.startswith("crazyem: ")]
    assert len(lines) == 1, err
    assert lines[0].endswith(".")
    return lines[0]


def joined(parts: list[Recording]) -> dict[str, SignalArray]:
    """The signals of consecutive parts as those of one recording."""
    signals: dict[str, SignalArray] = {}
    for name in dict.fromkeys(name for part in parts for name in part.signals):
        pieces = [part.signals[name] for part in parts if name in part.signals]
        arrays: dict[str, Any] = {f: np.concatenate([getattr(p, f) for p in pieces]) for f in ARRAYS}
        signals[name] = replace(pieces[0], **arrays)
    return signals


def assert_same_signals(one: Mapping[str, SignalArray], other: Mapping[str, SignalArray]) -> None:
    """Equal in all, arrays to the last bit."""
    assert list(one) == list(other)
    for name, array in one.items():
        for field in fields(SignalArray):
            a, b = getattr(array, field.name), getattr(other[name], field.name)
            if field.name in ARRAYS:
                assert a.dtype == b.dtype
                a, b = a.tobytes(), b.tobytes()
            assert a == b, (name, field.name)


def assert_cut_anywhere(read: Callable[[bytes], Recording], content: bytes, edges: list[int], *, first: int) -> None:
    """Cut at any byte, a log has its whole records before the cut, from `first` on; and it says where the rest begins.

    edges: where its records begin and end.
    """
    whole = list(read(content).signals.values())
    near = {edge + d for edge in edges for d in (-1, 0, 1)} & set(range(len(content)))
    for size in sorted({*range(0, len(content), 5), *near}):
        try:
            part = read(content[:size])
        except FileFormatError:
            assert size < first
            continue
        for signal in part.signals.values():
            n, same = signal.time.size, next(s for s in whole if s.source == signal.source)
            if same.quantity == signal.quantity:
                np.testing.assert_array_equal(signal.value, same.value[:n])
            if signal.clock == "autopilot":
                np.testing.assert_array_equal(signal.time, same.time[:n])
        cut = [f.evidence["offset"] for f in part.findings if f.check == "integrity"]
        assert cut == ([] if size in edges else [max(edge for edge in edges if edge <= size)])
