"""Figures of `crazyem paper`: which are drawn from which records, that they are files of their kind, and small."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from made_paper import TRUE, offline, online, table1, whole_run
from matplotlib.figure import Figure

from crazyem.errors import UsageError
from crazyem.paper import figures
from crazyem.paper.figures import draw_all
from crazyem.paper.published_values import FIGURES, PUBLISHED_RANGES
from crazyem.paper.settings import Settings

SHORT = Settings(duration=1.0, window=100)


def draw(records: list, folder: Path, settings: Settings = SHORT) -> list[int]:
    return [f["number"] for f in draw_all(records, settings, folder)]


@pytest.mark.parametrize(
    ("records", "numbers"),
    [
        ([table1(0)], [3, 4, 5]),
        ([offline("A", "published", 0)], [8, 9, 10, 11, 12]),
        ([offline("B", "crazyem", 0), offline("B", "bound", 0)], [13, 14, 15, 16, 17]),
        ([offline("C", "bound", 0)], []),  # a bound alone is no figure
        ([online("C", "crazyem", 0)], [33, 34, 35, 36, 37]),
        ([], []),
    ],
)
def test_what_was_run_is_drawn(
    records: list, numbers: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Figure, "savefig", lambda self, file, **_: file.write(b"a picture"))  # others look at these
    assert draw(records, tmp_path) == numbers
    assert {p.name for p in tmp_path.iterdir()} == {f"figure_{n:02d}{s}" for n in numbers for s in (".png", ".svg")}


@pytest.mark.slow
def test_every_figure_of_the_paper_is_there_and_small(tmp_path: Path) -> None:
    """20 runs of 1000 updates would be 3 MB a picture if every point were written."""
    drawn = draw_all(whole_run(20), SHORT, tmp_path)
    assert [f["number"] for f in drawn] == [f.number for f in FIGURES]
    for figure in drawn:
        png, svg = (tmp_path / f"{figure['file']}{suffix}" for suffix in (".png", ".svg"))
        assert png.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
        assert svg.stat().st_size < 900_000
        root = ET.parse(svg).getroot()
        assert root.tag.endswith("svg")
        assert not [e for e in root.iter() if e.tag.endswith("script")]
        assert figure["caption"]
        assert figure["note"]


def test_pictures_are_the_same_each_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runs can be compared byte by byte."""
    monkeypatch.setattr(figures, "FIGURES", FIGURES[3:5])
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        draw([offline("A", "published", 0), offline("A", "crazyem", 0)], tmp_path / name)
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


def test_values_that_are_no_numbers_leave_gaps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A published flight that crashed has null in it."""
    wanted = [8, 9, 23, 24]  # offline and online
    monkeypatch.setattr(figures, "FIGURES", [f for f in FIGURES if f.number in wanted])
    record = online("A", "published", 0)
    record["theta"][10:] = [[None] * 4 for _ in record["theta"][10:]]
    broken = offline("A", "published", 0)
    broken["theta"][5:] = [[None] * 4 for _ in broken["theta"][5:]]
    silent = online("A", "crazyem", 0)
    silent["intervals"] = [None for _ in silent["intervals"]]
    assert draw([record, broken, silent, online("A", "published", 1, crashed=True)], tmp_path) == wanted


def test_enlargement_holds_truth_paper_and_runs() -> None:
    record = online("A", "crazyem", 0, [-0.2, 0.0, 0.3])
    figure = Figure()
    wanted = next(f for f in FIGURES if f.number == 25)
    figures._online(figure, wanted, SHORT, {"published": [], "crazyem": [record]})
    low, high = figure.axes[1].get_ylim()
    paper = [1e4 * v for v in PUBLISHED_RANGES["online", "A"]["Ixx"]]
    for value in (*paper, 2.5 * 0.8, 2.5 * 1.3, 2.5):
        assert low <= value <= high


def test_curves_are_the_records_values() -> None:
    """The dashed line of Fig. 9 is what the records say, run after run, with a gap between two."""
    records = [offline("A", "published", k, 0.01 * k) for k in range(3)]
    figure = Figure()
    figures._offline(figure, FIGURES[4], SHORT, {"published": records, "crazyem": []})
    (line,) = [one for one in figure.axes[0].lines if str(one.get_label()).startswith("published")]
    expected = np.concatenate([[*np.array(r["theta"])[:, 0], np.nan] for r in records])
    np.testing.assert_allclose(np.asarray(line.get_ydata(), float), expected)
    assert line.get_linestyle() == "--"
    red = [one for one in figure.axes[0].lines if one.get_color() == "r"]
    assert np.all(np.asarray(red[0].get_ydata()) == TRUE[0])


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot write"):
        draw([table1(0)], tmp_path / "missing")
