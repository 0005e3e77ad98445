"""The benchmarks of recordings still run, on tiny sizes; nothing here looks at a clock's verdict."""

import contextlib
import importlib
import io
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from crazyem.cli import main
from crazyem.recordings import ReadOptions, open_recording

FOLDER = Path(__file__).parents[2] / "benchmarks"
MODULES = ("recordings", "recordings_large", "child")


@pytest.fixture(scope="module")
def benches() -> Iterator[dict[str, ModuleType]]:
    """Modules of benchmarks/, imported the way they run: from their own folder."""
    sys.path.insert(0, str(FOLDER))
    yield {name: importlib.import_module(name) for name in MODULES}
    sys.path.remove(str(FOLDER))
    for name in MODULES:
        sys.modules.pop(name, None)


@pytest.fixture
def in_this_process(benches: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands of crazyem run here, which saves them the imports; what a process costs is measured further down."""
    child = benches["child"]

    def measured(command: list[str], **more: Any) -> Any:
        if command[: len(child.CRAZYEM)] != child.CRAZYEM:
            return child.measured(command, **more)
        with contextlib.redirect_stdout(io.StringIO()) as said:
            code = main(command[len(child.CRAZYEM) :])
        return child.Usage(1.0, 1.0, 100.0, said.getvalue(), code)

    for name in ("recordings", "recordings_large"):
        monkeypatch.setattr(benches[name], "measured", measured)


def test_the_flight_is_reproducible_and_agrees_with_itself(
    benches: dict[str, ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also across the blocks in which it is made."""
    bench = benches["recordings"]
    monkeypatch.setattr(bench, "BLOCK", 5000)
    paths = [tmp_path / "a", tmp_path / "b"]
    for path in paths:
        bench.write_usd(path, rows=12_000)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    signals = open_recording(paths[0], ReadOptions(motor="duty")).signals
    assert {a.value.shape[0] for a in signals.values()} == {12_000}
    assert sum(a.value.shape[1] for a in signals.values()) == 20
    time, position = signals["position"].time, signals["position"].value
    moved = np.cumsum(signals["velocity"].value[:-1] * np.diff(time)[:, None], axis=0)
    assert np.abs(position[1:] - position[0] - moved).max() < 0.02
    q, rate = signals["attitude"].value, signals["body_rate"].value
    turned = 2.0 * (q[:-1, 3:] * q[1:, :3] - q[1:, 3:] * q[:-1, :3] - np.cross(q[:-1, :3], q[1:, :3]))
    assert np.abs(np.cumsum(turned - rate[:-1] * np.diff(time)[:, None], axis=0)).max() < 0.02
    bench.write_csv(tmp_path / "c.csv", rows=12_000)
    (tmp_path / "map.toml").write_text(bench.MAPPING)
    plain = open_recording(tmp_path / "c.csv", ReadOptions(mapping=str(tmp_path / "map.toml"))).signals
    np.testing.assert_allclose(plain["motor_command"].value, signals["motor_command"].value, rtol=1e-14)


def test_a_command_is_measured(benches: dict[str, ModuleType], tmp_path: Path) -> None:
    bench = benches["recordings"]
    bench.write_usd(tmp_path / "log", rows=2000)
    used = bench.measured([*bench.CRAZYEM, "info", str(tmp_path / "log"), "--motor", "duty"])
    assert "12000 samples" in used.output
    row = bench.row("uSD card log", "info", [used, used], 1)
    assert row["wall_s"]["least"] == row["wall_s"]["median"] == row["wall_s"]["most"] > 0.0
    assert "OVER THE LIMIT" in bench.table([row], limits=(1e9, 0.0))
    assert "OVER THE LIMIT" not in bench.table([row], limits=(1e9, 1e9))


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_every_command_and_peer_runs(benches: dict[str, ModuleType], tmp_path: Path) -> None:
    bench = benches["recordings"]
    result = bench.measure(tmp_path, rows=4000, rounds=1, only={"commands", "peers"})
    assert len(result["commands"]) == 11
    assert len(result["peers"]) == 8
    rows = result["commands"] + result["peers"]
    assert all(0.0 < r["wall_s"]["least"] <= r["wall_s"]["most"] for r in rows)
    assert all(10.0 < r["memory_mb"]["median"] < 2000.0 for r in rows)
    assert bench.table(rows, limits=(0.0, 1e9)).count("OVER THE LIMIT") == 8
    json.dumps(result)


def test_memory_is_that_of_the_child(benches: dict[str, ModuleType]) -> None:
    child = benches["child"]
    small = child.measured(child.python("print('x')"))
    large = child.measured(child.python("a = bytearray(300_000_000)"))
    assert small.output == "x\n"
    assert 300.0 < large.memory_mb < 500.0
    assert small.memory_mb < 100.0
    failed = child.measured(child.python("a = bytearray(300_000_000)"), address_space=200_000_000, check=False)
    assert failed.code != 0
    assert "MemoryError" in failed.output
    with pytest.raises(RuntimeError, match="ended with 3"):
        child.measured(child.python("raise SystemExit(3)"))


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_files_larger_than_memory_run_small(benches: dict[str, ModuleType]) -> None:
    rows = benches["recordings_large"].measure("usd", megabytes=0.5, limit_mb=3000.0)
    assert [r["what"] for r in rows] == [
        *("info", "info --parts", "doctor", "doctor --parts", "export", "export --parts"),
    ]  # fmt: skip
    assert [r["code"] for r in rows] == [0] * 6


@pytest.mark.slow
def test_the_fuzzer_runs_or_says_what_is_missing(tmp_path: Path) -> None:
    script = str(FOLDER / "fuzz_readers.py")
    if importlib.util.find_spec("atheris") is None:
        done = subprocess.run([sys.executable, script, "usd2"], capture_output=True, text=True, check=False)
        assert done.returncode == 1
        assert done.stderr.startswith("atheris is not installed")
        return
    done = subprocess.run(
        [sys.executable, script, "usd2", "-runs=20"], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "Done 20 runs" in done.stderr
    assert list(tmp_path.iterdir()) == []
