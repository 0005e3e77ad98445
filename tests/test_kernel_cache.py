"""One machine code: what a process compiled or loaded before has no say in the numbers, and the disk gives the same."""

import contextlib
import json
import os
import runpy
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]

# A library keeps a copy of `inner` that is large enough not to be inlined; reassociated sums are vectorised by context.
TOY = """
import sys
import numpy as np
from crazyem.compiled import compilations, kernel

@kernel
def inner(x, n):
    s = 0.0
    for i in range(n):
        s += np.sin(x[i]) * x[n - 1 - i]
        if s > 1e9:
            s -= np.cos(x[i])
    return s

@kernel
def outer(x):
    return inner(x, 3) + inner(x, x.size) + inner(x[2:], 2)

if __name__ == "__main__":
    for name in sys.argv[1:]:
        value = globals()[name](np.arange(5.0), *([5] if name == "inner" else []))
        print(name, float(value).hex())
    print("compiled", compilations())
"""


@pytest.fixture(scope="module")
def toy(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("toy") / "toy.py"
    path.write_text(TOY, encoding="utf-8")
    return path


def run(program: Path, *arguments: str, cache: Path) -> dict[str, str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run(
        [sys.executable, str(program), *arguments], env=environment, capture_output=True, text=True, check=True
    )
    return dict(line.split() for line in done.stdout.splitlines())


def test_no_function_can_be_taken_from_another_library(toy: Path) -> None:
    """Symbols that are weak in a library are taken from whichever library was loaded first."""
    outer = runpy.run_path(str(toy))["outer"]
    outer(np.arange(5.0))
    (compiled,) = outer.overloads.values()
    defined = [f for f in compiled.library._final_module.functions if not f.is_declaration]
    assert "linkonce_odr" not in {f.linkage.name for f in defined}
    assert "internal" in {f.linkage.name for f in defined}  # `inner`, or numba's own functions


def test_processes_that_compile_at_once_leave_a_whole_cache(toy: Path, tmp_path: Path) -> None:
    """What is compiled is counted, what is loaded is not; the numbers are the same alone, together, in either order.

    On a busy machine one process may end before the other begins, which then loads everything.
    """
    names = (("inner", "outer"), ("outer", "inner"))
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(lambda both: run(toy, *both, cache=tmp_path), names))
    later = run(toy, "outer", cache=tmp_path)
    assert max(int(one.pop("compiled")) for one in found) >= 1
    assert later.pop("compiled") == "0"
    assert found[0] == found[1] == {**found[0], **later}


FIRST = runpy.run_path(str(ROOT / "tests" / "compile_first.py"))


def test_what_is_compiled_first_is_asked_of_tests_that_exist() -> None:
    for name in (*FIRST["OF_THE_PAPER"], *FIRST["OF_EFFECTS"]):
        file, _, test = name.partition("::")
        assert f"def {test or 'test_'}" in (ROOT / "tests" / "crazyem" / f"test_{file}").read_text(encoding="utf-8")


BACKWARDS = """
import sys
from crazyem import compiled as kernels
import crazyem.commands.replay, crazyem.estimation.online, crazyem.estimation.steps
from crazyem.cli import main

for kernel in reversed(kernels._KERNELS):
    for signature, *_ in kernel._cache._cache_file._load_index():
        kernel.compile(signature)  # loads
main(["replay", *sys.argv[1:]])
"""


def replayed(out: Path, *program: str, cache: Path | None = None) -> dict[str, object]:
    """What a process that runs `program` says of the first 6 s of a shipped flight, by the kernels of this cache."""
    own = {} if cache is None else {"NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, *program, *FIRST["FLIGHT"], "--json", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **own}
    subprocess.run(command, env=environment, cwd=ROOT, check=True, capture_output=True)
    return json.loads(out.read_text(encoding="utf-8"))


def replayed_while_compiling(folder: Path) -> dict[str, object]:
    """By kernels that the process compiled itself, as after installation; `make compiled` keeps what its own said."""
    with contextlib.suppress(OSError, ValueError):
        kept = json.loads(FIRST["REPLAYED"].read_text(encoding="utf-8"))
        if kept.get("of") == FIRST["of_what"]():
            return kept["said"]
    return replayed(folder / "first.json", "-m", "crazyem", "replay", cache=folder / "cache")


@pytest.mark.slow
def test_what_was_compiled_just_now_replays_as_what_was_loaded_to_the_last_bit(tmp_path: Path) -> None:
    """An empty cache against a full one whose kernels are loaded in the opposite order."""
    first, later = replayed_while_compiling(tmp_path), replayed(tmp_path / "backwards.json", "-c", BACKWARDS)
    for key in ("estimates", "noise", "converged", "updates", "samples"):
        assert first[key] == later[key]
