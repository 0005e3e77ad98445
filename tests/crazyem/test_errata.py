"""The page of errata names a test for every entry, and every test of an erratum is named there."""

import ast
import re
from pathlib import Path

HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "docs" / "explanation" / "errata.md"


def _tests() -> set[str]:
    found = set()
    for path in HERE.glob("test_errata_*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found |= {n.name for n in tree.body if isinstance(n, ast.FunctionDef) and n.name.startswith("test_")}
    return found


def _rows() -> list[list[str]]:
    """Cells of every row of the page's tables, heads and rules left out."""
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    cells = [[c.strip() for c in re.split(r"(?<!\\)\|", row.strip("| "))] for row in rows]
    return [c for c in cells if c[0] != "where"]


def test_every_entry_names_a_test_that_exists():
    rows, tests = _rows(), _tests()
    assert len(rows) > 40
    for row in rows:
        named = set(re.findall(r"`(test_\w+)`", row[-1]))
        assert named, row
        assert named <= tests, row
        assert all(row), row  # no empty cell


def test_every_test_is_named_on_the_page():
    named = set(re.findall(r"`(test_\w+)`", PAGE.read_text(encoding="utf-8")))
    assert _tests() == named


def test_no_entry_is_listed_twice():
    named = [name for row in _rows() for name in re.findall(r"`(test_\w+)`", row[-1])]
    assert len(named) == len(set(named))
