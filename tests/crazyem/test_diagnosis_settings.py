"""The table of settings: every number has a comment with its unit or meaning; few stand as constants elsewhere."""

import ast
import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import ablation
from crazyem.diagnosis import settings
from crazyem.errors import UsageError

SOURCE = Path(settings.__file__)
TABLES = [v for v in vars(settings).values() if dataclasses.is_dataclass(v) and not isinstance(v, type)]
MOST_ELSEWHERE = 40  # layouts of arrays, constants of the firmware, sizes of pictures


def test_every_number_says_what_it_is():
    fields = re.findall(r"^    (\w+): [^=#\n]+ = [^#\n]+?(  # .+)?$", SOURCE.read_text(), re.MULTILINE)
    assert len(fields) == sum(len(dataclasses.fields(t)) for t in TABLES)
    assert [name for name, comment in fields if not comment] == []


def test_a_table_is_frozen():
    for table in TABLES:
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(table, dataclasses.fields(table)[0].name, 0)


def test_few_numbers_stand_elsewhere():
    count = 0
    for path in SOURCE.parent.rglob("*.py"):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.Assign) and path != SOURCE:
                numbers = (n.value for n in ast.walk(node.value) if isinstance(n, ast.Constant))
                count += any(type(n) in (int, float) for n in numbers)
    assert count <= MOST_ELSEWHERE


def test_an_ablation_changes_one_number(monkeypatch):
    asked: list[list[str]] = []
    monkeypatch.setattr("crazyem.cli.main", lambda given: asked.append(given) or 0)
    before = settings.SELECTION.gain_share
    try:
        assert ablation.main(["selection.gain_share=0.3", "diagnose", "a.csv"]) == 0
        assert settings.SELECTION.gain_share == 0.3
    finally:
        object.__setattr__(settings.SELECTION, "gain_share", before)
    assert asked == [["diagnose", "a.csv"]]


def test_a_default_of_a_function_is_changed_too():
    """In a process of its own: modules of the diagnosis must not be imported before the change."""
    code = """
import inspect
from benchmarks import ablation
ablation.change("fitting.rounds=2")
from crazyem.diagnosis.fitting.fit import refine
print(inspect.signature(refine).parameters["rounds"].default)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=SOURCE.parents[2], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["2"]


@pytest.mark.parametrize("wrong", ["selection.nothing=1", "nowhere.gain_share=1", "selection.max_fitted=many"])
def test_an_ablation_of_something_else_is_refused(wrong, capsys):
    with pytest.raises(UsageError):
        ablation.change(wrong)
    assert ablation.main([wrong, "diagnose"]) == 2
    assert capsys.readouterr().err.startswith("error: ")
