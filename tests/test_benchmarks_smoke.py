"""The benchmarks still run, on tiny sizes and without their peers; nothing here looks at a clock's verdict."""

import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def speed() -> Iterator[ModuleType]:
    """benchmarks/speed.py, imported the way it runs: from its own folder."""
    before = set(sys.modules)
    sys.path.insert(0, str(FOLDER))
    yield importlib.import_module("speed")
    sys.path.remove(str(FOLDER))
    for name in set(sys.modules) - before:
        if (getattr(sys.modules[name], "__file__", "") or "").startswith(str(FOLDER)):
            del sys.modules[name]


def test_the_flight_is_reproducible_and_flies(speed: ModuleType) -> None:
    first, again, other = (sys.modules["flight"].simulate(seed=s, seconds=3.0) for s in (3, 3, 4))
    np.testing.assert_array_equal(first.measured, again.measured)
    assert not np.array_equal(first.measured, other.measured)
    assert np.all((first.command > 0) & (first.command < 1))
    assert np.max(np.abs(first.measured[:, 2] - 1.0)) < 0.5


def test_contenders_run_on_the_same_window_and_agree_on_its_likelihood(speed: ModuleType) -> None:
    result = speed.measure_speed(seed=1, window=60, rounds=2, seconds=1.2, with_peers=False)
    assert {row["n"] for row in result["rows"]} == {2}
    assert len(result["rows"]) == 6
    em = speed.settled(seed=1, window=60, seconds=1.2)
    first, last = em.tape.size - 60, em.tape.size
    window = speed.window_of(em, first, last)
    likelihood = speed.e_step(em, first, last)
    assert speed.textbook(window) == pytest.approx(likelihood, abs=1e-3)
    assert importlib.import_module("peer_numpy").make(window)() == pytest.approx(likelihood, abs=0.1)


def test_online_costs_are_told_by_kind(speed: ModuleType) -> None:
    result = speed.running.measure_online(seed=1, window=60, seconds=2.0)
    total = result["all updates"]["n"]
    assert (200 - 60) // 4 - 1 <= total <= (200 - 60) // 4  # the newest sample may still wait for its inputs
    assert result["update with full passes"]["n"] <= total
    assert "load of one core" in speed.running.table({"online": result})


def test_incremental_is_compared_with_full_passes(speed: ModuleType) -> None:
    result = speed.running.measure_accuracy(seeds=[1], window=240, seconds=4.0, passes=30)
    assert result["n"] >= 1
    for name in ("one full pass", "converged"):
        assert all(len(values) == 4 and np.all(np.isfinite(values)) for values in result[name].values())
    assert "converged" in speed.running.table({"accuracy": result})


@pytest.mark.parametrize(("peer", "module"), [("dynamax", "peer_dynamax"), ("casadi", "mhe_casadi")])
def test_peers_when_installed(speed: ModuleType, peer: str, module: str) -> None:
    pytest.importorskip(peer, reason=f"{peer} is an optional peer (pip install -e '.[bench]')")
    em = speed.settled(seed=1, window=60, seconds=1.2)
    assert importlib.import_module(module).make(speed.window_of(em, em.tape.size - 60, em.tape.size))() is not None


def test_every_benchmark_that_pages_run_as_a_module_imports() -> None:
    root = FOLDER.parent
    pages = (*root.glob("docs/**/*.md"), *FOLDER.glob("*.py"), root / "Makefile")
    named = {n for page in pages for n in re.findall(r"python\S* -m (benchmarks\.\w+)", page.read_text("utf-8"))}
    assert "benchmarks.monitor" in named
    for name in sorted(named):
        importlib.import_module(name)
