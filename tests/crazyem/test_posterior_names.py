"""The posterior's code knows no effect by name: what is peculiar to one stands with it."""

import ast
from pathlib import Path

import pytest

import crazyem.diagnosis.posterior as package
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.prior import Conditions

FILES = sorted(Path(package.__file__).parent.glob("*.py"))
LONGEST = 1620  # lines of the package


def texts(tree: ast.AST) -> list[str]:
    """All text constants but docstrings."""
    documented = (ast.Module, ast.FunctionDef, ast.ClassDef)
    starts = [n.body[0] for n in ast.walk(tree) if isinstance(n, documented)]
    docs = {id(first.value) for first in starts if isinstance(first, ast.Expr)}
    constants = [n for n in ast.walk(tree) if isinstance(n, ast.Constant) and id(n) not in docs]
    return [n.value for n in constants if isinstance(n.value, str)]


@pytest.mark.parametrize("file", FILES, ids=lambda p: p.stem)
def test_no_effect_is_named(file: Path) -> None:
    tree = ast.parse(file.read_text())
    words = {w for text in texts(tree) for w in text.replace(".", " ").split()}
    assert not words & set(CATALOGUE)


def test_the_package_is_small() -> None:
    assert sum(len(f.read_text().splitlines()) for f in FILES) <= LONGEST


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_effect_says_how_large_it_is(name: str) -> None:
    effect = CATALOGUE[name]
    known = {p.name: p for p in effect.parameters}
    everything = frozenset({"position", "velocity", "attitude", "body_rate", "motor_command"})
    usual = effect.prior.usual_in(Conditions(signals=everything, arm=(0.03, 0.03)))
    assert effect.prior.own or usual or effect.prior.usual_in(Conditions(file_effects=frozenset({"trim"})))
    for sizes in (effect.prior.own, usual):
        assert set(sizes) <= set(known)
        assert all(size > 0.0 for size in sizes.values())
    continuous = {p.name for p in effect.parameters if not p.chosen and p.neutral is not None}
    if effect.prior.own and effect.random is None:
        assert set(effect.prior.own) == continuous, "each number of a missing effect is of some size"
    for n, size in usual.items():
        assert effect.prior.own.get(n, size) >= size, "an effect is larger than what is usual"
