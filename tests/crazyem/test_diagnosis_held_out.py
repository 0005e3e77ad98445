"""Which flights are fitted and which confirm, by how they move; and that all that is told follows."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from hypothesis import given
from hypothesis import strategies as st

from crazyem.cli import main
from crazyem.diagnosis.flights import recording_nuisances
from crazyem.diagnosis.flights.flight import Flight, flight_of
from crazyem.recordings.mcap.signals import write_recording


@cache
def made() -> Flight:
    return flight_of(fly(seconds=8.0), DRONE)


@pytest.fixture
def flight() -> Flight:
    return made()


def moving(flight: Flight, speed: float, rate: float = 0.1) -> Flight:
    """The flight with velocities along a circle and rates of that rms [m/s, rad/s]."""
    y, angle = flight.y.copy(), np.linspace(0.0, 20.0, flight.time.size)
    y[:, 3:6] = np.column_stack([speed * np.cos(angle), speed * np.sin(angle), np.ones(angle.size)])
    y[:, 10:13] = rate * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    return replace(flight, y=y)


@pytest.mark.parametrize(
    ("fitted", "apart", "expected"),
    [
        ([(0.01, 0.1)], [(0.7, 0.3)], True),
        ([(0.01, 0.1)], [(0.01, 0.1)], False),  # both hover
        ([(0.01, 0.1)], [(0.01, 0.1), (0.7, 0.3)], True),  # one that moves is enough
        ([(0.01, 0.1), (0.7, 0.3)], [(1.0, 0.3)], False),  # one of those fitted moves
        ([(0.7, 0.3)], [(0.01, 0.1)], False),
        ([(0.01, 0.8)], [(0.7, 0.3)], False),  # shaken on the spot: its torques show enough
        ([(0.06, 0.1)], [(0.13, 0.8)], False),  # of a kind
        ([(0.01, 0.1)], [], False),
    ],
)
def test_those_that_only_hover_confirm(
    flight: Flight, fitted: list[tuple[float, float]], apart: list[tuple[float, float]], expected: bool
) -> None:
    assert (
        recording_nuisances.swapped([moving(flight, *f) for f in fitted], [moving(flight, *f) for f in apart])
        is expected
    )


def test_what_was_not_measured_decides_nothing(flight: Flight) -> None:
    hover, quick = moving(flight, 0.01), moving(flight, 1.0)
    for blind in (slice(3, 6), slice(10, 13)):
        y = hover.y.copy()
        y[:, blind] = np.nan
        assert not recording_nuisances.swapped([replace(hover, y=y)], [quick])
    y = hover.y.copy()
    y[::3, 3:6] = np.nan
    assert recording_nuisances.swapped([replace(hover, y=y)], [quick])  # gaps do not hide that it hovers


@given(st.lists(st.floats(0.001, 3.0), min_size=1, max_size=3), st.lists(st.floats(0.001, 3.0), min_size=1, max_size=3))
def test_never_both_ways(here: list[float], there: list[float]) -> None:
    one, other = [moving(made(), s) for s in here], [moving(made(), s) for s in there]
    assert not (recording_nuisances.swapped(one, other) and recording_nuisances.swapped(other, one))


@pytest.mark.slow
def test_all_that_is_told_follows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, seconds in (("hover", 8.0), ("quick", 12.0)):
        write_recording(fly(Hidden(drag=(0.02, 0.015, 0.01)), seconds=seconds), tmp_path / f"{name}.mcap")
    (tmp_path / "made.toml").write_text(DRONE.to_toml())
    monkeypatch.setattr(recording_nuisances, "swapped", lambda fitted, apart: len(apart) > 0)
    out = tmp_path / "d.json"
    hover, quick = (str(tmp_path / f"{n}.mcap") for n in ("hover", "quick"))
    words = ["diagnose", hover, "--held-out", quick, "--vehicle", str(tmp_path / "made.toml")]
    words += ["--candidates", "linear_drag", "--json", str(out)]
    starts = {}
    for more, fitted, apart in (([], quick, hover), (["--strict-held-out"], hover, quick)):
        assert main([*words, *more]) == 0
        shown = capsys.readouterr().out
        document = json.loads(out.read_text())
        assert document["swapped"] is (not more)
        assert (document["recordings"], document["held_out_recordings"]) == ([fitted], [apart])
        assert [o["recording"] for o in document["of_recordings"]] == [fitted, apart]
        assert ("only hovers" in shown) is (not more)
        assert any("only hovers" in n for n in document["notices"]) is (not more)
        assert not any(Path(hover).parent.as_posix() in n for n in document["notices"])
        starts[not more] = [document["fit"][part]["before"]["starts"] for part in ("train", "held_out")]
    assert starts[True] == starts[False][::-1]
