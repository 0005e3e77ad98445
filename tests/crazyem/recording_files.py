"""Recordings on disk for the tests of commands, and how these run a command."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from made_flight import made_flight

from crazyem.cli import main
from crazyem.recordings import Recording
from crazyem.recordings.export import export


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


def cut(array: Any, later: bool) -> Any:
    rows = (array.time >= 10.0) == later
    return replace(array, **{f: getattr(array, f)[rows] for f in ("time", "value", "order", "host_time", "marked")})
