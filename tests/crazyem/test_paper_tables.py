"""Tables of `crazyem paper`: statistics of hand-made records against plain arithmetic, and the text made of them."""

import itertools
import json
import math
import re
from pathlib import Path

import numpy as np
import paper_pages as docs
import pytest
from html_pages import Page
from hypothesis import given
from hypothesis import strategies as st
from made_paper import BOUND, TRUE, offline, online, results_of, table1, whole_run

from crazyem.errors import FileFormatError, UsageError
from crazyem.paper.experiments import short, window_ends
from crazyem.paper.pages import Grid, grids, index_html, tables_markdown
from crazyem.paper.published_values import FIGURES, PARAMETERS, PUBLISHED_RANGES, SENSORS, TABLE_I
from crazyem.paper.settings import Settings
from crazyem.paper.tables import cell, derive, expected_range, flights

REPOSITORY = Path(__file__).resolve().parents[2]


# what the paper prints ----------------------------------------------------------------------------------------


def test_figures_are_numbered_as_in_the_paper() -> None:
    """Spot checks against captions that were read in the paper."""
    by_number = {f.number: f for f in FIGURES}
    assert sorted(by_number) == [3, 4, 5, *range(8, 38)]
    said = {
        9: ("offline", "A", "mass"), 12: ("offline", "A", "Izz"), 14: ("offline", "B", "mass"),
        20: ("offline", "C", "Ixx"), 26: ("online", "A", "Iyy"), 29: ("online", "B", "mass"),
        37: ("online", "C", "Izz"),
    }  # fmt: skip
    for number, (experiment, sensor, parameter) in said.items():
        figure = by_number[number]
        assert (figure.experiment, figure.sensor, figure.parameter) == (experiment, sensor, parameter)
    assert [by_number[n].kind for n in (8, 13, 18, 23, 28, 33)] == ["path"] * 6


def test_ranges_are_those_of_the_papers_own_comparisons() -> None:
    """XII: online inertia ranges are "approximately 2.62 to 6 times" the offline ones, mass of A and C 2.1 to 2.2."""
    ratio = {
        (s, p): (PUBLISHED_RANGES["online", s][p][1] - PUBLISHED_RANGES["online", s][p][0])
        / (PUBLISHED_RANGES["offline", s][p][1] - PUBLISHED_RANGES["offline", s][p][0])
        for s in SENSORS
        for p in PARAMETERS
    }
    inertia = [v for (_, p), v in ratio.items() if p != "mass"]
    assert min(inertia) == pytest.approx(2.62, abs=0.01)
    assert max(inertia) == pytest.approx(6.02, abs=0.01)
    assert ratio["A", "mass"] == pytest.approx(2.2)
    assert ratio["C", "mass"] == pytest.approx(2.1, abs=0.02)
    assert TABLE_I["position"]["mean"] / 1.5e-2 == pytest.approx(1 - 0.333, abs=0.02)  # "33.3% smaller" than [16]


# cells --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "expected"), [(2, 2 / math.sqrt(math.pi)), (3, 3 / math.sqrt(math.pi)), (20, 3.735)])
def test_expected_range_of_normal_numbers(count: int, expected: float) -> None:
    """Closed forms for 2 and 3; the tabulated d2 for 20."""
    assert expected_range(count) == pytest.approx(expected, rel=2e-4)


def test_cell_of_known_errors() -> None:
    errors = [-0.02, 0.0, 0.05]
    records = [offline("B", "crazyem", k, e) for k, e in enumerate(errors)]
    records += [offline("B", "bound", k) for k in range(3)]
    found = cell(records, Settings(), "offline", "B", "Ixx")
    ours = found["crazyem"]
    assert found["table"] == "III"
    assert ours["n"] == 3
    assert ours["range"] == [pytest.approx(2.5e-4 * 0.98), pytest.approx(2.5e-4 * 1.05)]
    assert ours["bias"] == pytest.approx(0.01)
    assert ours["rms"] == pytest.approx(math.sqrt((0.02**2 + 0.05**2) / 3), rel=1e-5)
    assert ours["rms_over_bound"] == pytest.approx(ours["rms"] / BOUND[1], rel=1e-5)
    assert ours["bias_over_bound"] == pytest.approx(0.01 / BOUND[1], rel=1e-5)
    assert ours["width_ratio"] == pytest.approx(2.5e-4 * 0.07 / (2.755e-4 - 2.383e-4), rel=1e-5)
    assert ours["overlap"]
    assert ours["coverage"] == 1.0
    assert found["published"] is None
    assert found["bound"]["sd"] == BOUND[1]
    half = expected_range(3) / 2 * BOUND[1]
    assert found["bound"]["range"] == [pytest.approx(2.5e-4 * (1 - half)), pytest.approx(2.5e-4 * (1 + half))]


def test_sensor_c_shows_both_readings_of_the_missing_angles() -> None:
    records = [offline("C", "published", k, 0.07 + 0.001 * k) for k in range(3)]
    records += [offline("C", "bound", k) for k in range(3)]
    found = cell(records, Settings(), "offline", "C", "mass")
    assert found["published"]["bias"] == pytest.approx(0.071)
    assert found["dead_reckoned"]["bias"] == pytest.approx(0.0, abs=1e-9)
    text = tables_markdown(results_of(records))
    assert "angles dead-reckoned" in text


def test_online_cell_counts_every_window_and_leaves_crashes_out() -> None:
    records = [online("A", "published", 0, [0.01, -0.01, 0.0]), online("A", "published", 1, crashed=True)]
    found = cell(records, Settings(), "online", "A", "Izz")["published"]
    assert (found["n"], found["crashed"]) == (3, 1)


def test_curves_count_from_eight_seconds_on() -> None:
    """400 updates of 20 ms are 8 s: what the curve did before does not matter, the crashed flight neither."""
    record, crashed = online("B", "published", 0), online("B", "published", 1, crashed=True)
    record["theta"] = [[TRUE[0] * f] * 4 for f in [9.0] * 400 + [0.9] * 300 + [1.2] * 300]
    found = cell([record, crashed], Settings(), "online", "B", "mass")["published"]
    assert found["curve_range"] == [pytest.approx(0.9 * 0.18), pytest.approx(1.2 * 0.18)]
    assert found["curve_width_ratio"] == pytest.approx(0.3 * 0.18 / 0.0014, rel=1e-5)
    results = results_of([record, crashed, online("B", "published", 2, [0.01])])
    assert results["summary"]["widths_of_curves"]["largest"] >= found["curve_width_ratio"] * 0.99


def test_values_that_are_no_numbers_do_not_count() -> None:
    broken = offline("B", "published", 0)
    broken["final"] = [None] * 4
    records = [broken, offline("B", "published", 1, 0.01), offline("B", "bound", 0), offline("B", "bound", 1)]
    assert cell(records, Settings(), "offline", "B", "mass")["published"]["n"] == 1
    assert cell([broken, offline("B", "bound", 0)], Settings(), "offline", "B", "mass")["published"] is None


def test_efficient_errors_give_one_over_the_bound_and_full_summary() -> None:
    """Normal errors of one bound each and intervals of 2 standard deviations."""
    results = results_of(whole_run(60, updates=20))
    for c in results["cells"]:
        assert c["crazyem"]["rms_over_bound"] == pytest.approx(1.0, abs=0.35)
    assert len(results["cells"]) == 24
    for experiment in ("offline", "online"):
        for group in ("mass", "inertia"):
            entry = results["summary"][f"crazyem_{experiment}_{group}"]
            assert entry["rms_over_bound"] == pytest.approx(1.0, abs=0.15)
            assert entry["coverage"] == pytest.approx(0.954, abs=0.03)  # two standard deviations
    assert results["summary"]["cells"] == 24


@given(st.randoms(use_true_random=False), st.integers(1, 6))
def test_the_order_of_records_does_not_matter(shuffle, seeds) -> None:
    records = whole_run(seeds, updates=8)
    mixed = list(records)
    shuffle.shuffle(mixed)
    first, second = results_of(records), results_of(mixed)
    first.pop("timing"), second.pop("timing")
    assert json.dumps(first["tasks"]) == json.dumps(second["tasks"])
    for one, other in zip(first["cells"], second["cells"]):
        for method in ("published", "crazyem"):
            assert one[method]["range"] == other[method]["range"]
            assert one[method]["bias"] == pytest.approx(other[method]["bias"], rel=1e-4, abs=1e-9)


@given(st.lists(st.floats(-0.5, 0.5), min_size=1, max_size=30))
def test_statistics_agree_with_each_other(errors) -> None:
    """Intervals are of two bounds."""
    records = [offline("A", "crazyem", k, e) for k, e in enumerate(errors)]
    records += [offline("A", "bound", k) for k in range(len(errors))]
    for parameter, true, limit in zip(PARAMETERS, TRUE, BOUND):
        found = cell(records, Settings(), "offline", "A", parameter)["crazyem"]
        paper = PUBLISHED_RANGES["offline", "A"][parameter]
        assert found["overlap"] == (found["range"][0] <= paper[1] and found["range"][1] >= paper[0])
        held = [abs(e) <= 2 * limit * (1 + e) for e in errors]
        assert found["coverage"] == pytest.approx(np.mean(held), abs=1e-5)
        low, high = found["range"]
        assert low <= found["mean"] * (1 + 1e-5)
        assert high >= found["mean"] * (1 - 1e-5)
        assert found["rms"] >= abs(found["bias"]) * (1 - 1e-4) - 1e-9
        assert found["bias"] == pytest.approx(np.mean(errors), rel=1e-4, abs=1e-9)
        assert low == pytest.approx(true * (1 + min(errors)))


def test_times_and_crashes_over_flights() -> None:
    records = [online("B", "crazyem", k) for k in range(4)]
    records[3]["times"]["mass_1"]["stays"] = None
    (found,) = flights(records)
    assert found["mass_5_first"]["median_s"] == pytest.approx(0.115)
    assert found["mass_1_stays"] == {"median_s": pytest.approx(0.4), "worst_s": None, "never": 1}
    assert found["tracking_over_known"] == 1.2
    assert "1 never" in tables_markdown(results_of(records))


# windows ------------------------------------------------------------------------------------------------------


@given(st.integers(20, 1000), st.integers(1, 6000))
def test_windows_are_disjoint_and_inside(window, extra) -> None:
    s = Settings(window=window, duration=(window + extra) * 0.005)
    ends = window_ends(s)
    assert ends
    assert ends[-1] == s.steps + 1
    assert all(b - a == window for a, b in itertools.pairwise(ends))
    assert ends[0] - window >= 0
    assert len(ends) == 1 or (ends[0] - window) * s.dt >= 8.0
    assert window_ends(Settings()) == [2401, 3201, 4001]  # of the paper


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_short_numbers(value) -> None:
    found = short(value)
    if math.isfinite(value):
        assert found == pytest.approx(value, rel=1e-6)
    else:
        assert found is None
    json.dumps(found, allow_nan=False)


# text ---------------------------------------------------------------------------------------------------------


def test_page_is_complete_in_itself() -> None:
    results = results_of(whole_run(2, updates=8))
    figures = [{"number": 9, "file": "figure_09", "caption": "a < b & c", "note": ""}]
    page = Page(index_html(results, figures))
    assert {"figures/figure_09.svg", "figures/figure_09.png", "results.json", "tables.md"} == set(page.links)


def test_markdown_tables_are_rectangular_and_complete() -> None:
    text = tables_markdown(results_of(whole_run(3, updates=8)))
    for numeral in ("I", "II", "III", "IV", "V"):
        assert f"Table {numeral}: " in text
    blocks = [b for b in re.split(r"\n\n", text) if b.startswith("|")]
    assert len(blocks) >= 8
    for block in blocks:
        assert len({len(re.split(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1


@given(st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\n\r")), min_size=1, max_size=5))
def test_cells_of_any_text_stay_cells(texts) -> None:
    grid = Grid("t", tuple(texts), (tuple(texts),))
    assert all(len(re.split(r"(?<!\\)\|", line)) == len(texts) + 2 for line in grid.markdown(heading="").split("\n"))
    Page(grid.html())


@pytest.mark.parametrize("method", ["published", "crazyem"])
@pytest.mark.parametrize("experiment", ["offline", "online", "table1"])
def test_a_part_of_the_run_gives_its_part_of_the_tables(experiment: str, method: str) -> None:
    records = [
        r
        for r in whole_run(2, updates=8)
        if r["experiment"] == experiment and r["method"] in (method, "bound", "filter")
    ]
    results = results_of(records)
    assert tables_markdown(results)
    assert index_html(results, [])
    titles = " ".join(g.title for g in grids(results))
    assert ("Table I:" in titles) == (experiment == "table1")
    assert ("Table II:" in titles) == (experiment == "offline")
    assert ("Table V:" in titles) == (experiment == "online")


def test_nothing_at_all() -> None:
    assert derive([], Settings()) == {"table1": None, "cells": [], "flights": [], "summary": {}}


def test_table1_is_the_mean_over_flights() -> None:
    entry = derive([table1(0, 1.0), table1(1, 2.0)], Settings())["table1"]["position"]["mean"]
    assert entry == {"paper": 1.02e-2, "mean": 0.015, "low": 0.01, "high": 0.02}


# pages of docs/ -----------------------------------------------------------------------------------------------


def test_blocks_are_filled_and_stay_filled() -> None:
    results = docs.summarised(results_of(whole_run(2, updates=8)))
    text = (
        "before\n"
        + "".join(f"<!-- paper:{n} -->\nwhat was here\n<!-- /paper:{n} -->\n" for n in docs.BLOCKS)
        + "after\n"
    )
    once = docs.filled(text, results)
    assert "what was here" not in once
    assert once.startswith("before\n")
    assert once.endswith("after\n")
    assert docs.filled(once, results) == once


def test_unknown_block_is_an_error() -> None:
    with pytest.raises(UsageError, match="no block 'nonsense'"):
        docs.filled("<!-- paper:nonsense -->\n<!-- /paper:nonsense -->", {})


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b"\xff", b'{"schema": "other"}', b"[" * 100_000])
def test_results_that_are_none(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "results.json"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"results\.json"):
        docs.read_results(path)
    with pytest.raises(FileFormatError, match="cannot read"):
        docs.read_results(tmp_path / "missing.json")


def test_docs_are_written_from_a_run(tmp_path: Path) -> None:
    (tmp_path / "docs" / "explanation").mkdir(parents=True)
    (tmp_path / "docs" / "explanation" / "paper.md").write_text("<!-- paper:tables -->\n<!-- /paper:tables -->\n")
    (tmp_path / "README.md").write_text("<!-- paper:better -->\n<!-- /paper:better -->\n")
    run = tmp_path / "results.json"
    run.write_text(json.dumps(results_of(whole_run(2, updates=8))))
    assert docs.main([str(run), "--root", str(tmp_path)]) == 0
    stored = (tmp_path / "docs" / docs.STORED_RESULTS).read_text()
    assert "tasks" not in json.loads(stored)
    assert "Table III" in (tmp_path / "docs" / "explanation" / "paper.md").read_text()
    assert "range of mass, offline" in (tmp_path / "README.md").read_text()
    assert docs.main(["--root", str(tmp_path)]) == 0  # from what was kept


def test_pages_have_not_drifted_from_the_stored_run() -> None:
    """`make paper-docs` wrote them; whoever edits a number by hand, or a generator, has to run it again."""
    stored = REPOSITORY / "docs" / docs.STORED_RESULTS
    if not stored.is_file():
        pytest.skip("no run is stored yet")
    results = docs.read_results(stored)
    for name in docs.PAGES:
        text = (REPOSITORY / name).read_text(encoding="utf-8")
        assert docs.filled(text, results) == text, f"{name} has drifted: make paper-docs"
