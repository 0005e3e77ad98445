"""The code still gives the numbers of the documented run: its first seeds again, held against what was stored."""

import json
from pathlib import Path
from typing import Any

import pytest
from paper_pages import SMALL_SEEDS, STORED_FIELDS, STORED_RESULTS

from crazyem.paper.experiments import Task, plan, run_task
from crazyem.paper.settings import Settings

HERE = Path(__file__).resolve().parent
STORED_SMALL = HERE / "expectations" / "paper_small.json"
TOLERANCE = 1e-5  # relative; records hold seven digits, and another processor rounds otherwise

ALL = plan(("table1", "offline", "online"), "ABC", ("published", "crazyem"), SMALL_SEEDS)
QUICK = [t for t in ALL if t.seed == 0 and t.experiment != "online" and (t.method != "crazyem" or t.sensor == "C")]


def stored() -> dict[str, Any]:
    if not STORED_SMALL.is_file():
        pytest.skip("no run is stored yet: make paper-docs")
    content: dict[str, Any] = json.loads(STORED_SMALL.read_text(encoding="utf-8"))
    return content


def check(tasks: list[Task]) -> None:
    expected = stored()["tasks"]
    for task in tasks:
        record = run_task(task, Settings())
        found = {k: record[k] for k in STORED_FIELDS if k in record}
        assert found.keys() == expected[task.name].keys()
        for key, value in found.items():
            assert _numbers(value) == pytest.approx(_numbers(expected[task.name][key]), rel=TOLERANCE), (task.name, key)


def _numbers(value: Any) -> list[float]:
    """All numbers in a record, in order."""
    if isinstance(value, dict):
        return [n for key in sorted(value) for n in _numbers(value[key])]
    if isinstance(value, list):
        return [n for v in value for n in _numbers(v)]
    return [-1.0 if value is None else float(value)]


def test_the_stored_seeds_are_those_of_the_documented_run() -> None:
    kept = json.loads((HERE.parents[1] / "docs" / STORED_RESULTS).read_text()) if stored() else {}
    assert stored()["environment"] == kept["environment"]
    assert set(stored()["tasks"]) == {t.name for t in ALL}


def test_offline_numbers_have_not_drifted() -> None:
    check(QUICK)


@pytest.mark.slow
@pytest.mark.nightly
def test_no_number_of_the_first_seed_has_drifted() -> None:
    """The estimator in the loop decides from update to update: its numbers are those of one numba and processor."""
    check([t for t in ALL if t.seed == 0 and t not in QUICK])
