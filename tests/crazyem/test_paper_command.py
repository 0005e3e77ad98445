"""`crazyem paper`: stored tasks, damaged ones among them, the same results however it is run."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_paper import offline

from crazyem.atomic_file import write_file
from crazyem.cli import main
from crazyem.errors import UsageError
from crazyem.paper import experiments, figures, runner
from crazyem.paper.experiments import Task
from crazyem.paper.settings import Settings

TINY = ("duration=1.5", "window=200")


def command(out: Path, *more: str) -> list[str]:
    return ["paper", "--out", str(out), "--seeds", "1", *(f"--set={s}" for s in TINY), *more]


def results(out: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((out / "results.json").read_text())
    return content


def comparable(out: Path) -> str:
    content = results(out)
    del content["timing"], content["figures"]
    return json.dumps(content)


@pytest.fixture
def few_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """One picture instead of 33, where they are not what is tested."""
    monkeypatch.setattr(figures, "FIGURES", figures.FIGURES[:1])


# stored tasks -------------------------------------------------------------------------------------------------
TASK = Task("offline", "A", "published", 0)


def put_record(folder: Path, content: bytes | None = None) -> Path:
    runner.prepare(folder)
    path = runner.task_file(folder, TASK)
    record = offline("A", "published", 0)
    path.write_bytes(json.dumps({"fingerprint": "f", "record": record}).encode() if content is None else content)
    return path


def test_a_stored_task_is_found(tmp_path: Path) -> None:
    put_record(tmp_path)
    record, why = runner.stored(tmp_path, TASK, "f")
    assert record == offline("A", "published", 0)
    assert why == ""
    assert runner.stored(tmp_path, TASK, "g") == (None, "other")
    assert runner.stored(tmp_path, replace(TASK, seed=1), "f") == (None, "missing")


@given(st.integers(0, 10_000), st.binary(max_size=8))
def test_damage_is_noticed(tmp_path_factory: pytest.TempPathFactory, at: int, change: bytes) -> None:
    """Whatever is cut or overwritten: the record is whole, or it is made again; never an exception."""
    folder = tmp_path_factory.mktemp("damage")
    path = put_record(folder)
    content = path.read_bytes()
    at %= len(content)
    path.write_bytes(content[:at] + change + (content[at + len(change) :] if change else b""))
    record, why = runner.stored(folder, TASK, "f")
    assert (record is None) == (why in ("damaged", "other"))


@pytest.mark.parametrize(
    "content",
    [b"", b"null", b"[" * 100_000, b'{"fingerprint": 3}',
     b'{"fingerprint": "f"}', b'{"fingerprint": "f", "record": []}',
     b'{"fingerprint": "f", "record": {"experiment": "offline"}}'],
)  # fmt: skip
def test_things_that_are_no_records(tmp_path: Path, content: bytes) -> None:
    path = put_record(tmp_path, content)
    assert runner.stored(tmp_path, TASK, "f") == (None, "damaged")
    put_record(tmp_path)
    os.truncate(path, runner.LARGEST_TASK_FILE + 1)  # too large to be read
    assert runner.stored(tmp_path, TASK, "f") == (None, "damaged")


def test_another_setting_is_another_fingerprint() -> None:
    usual = runner.fingerprint(Settings(), "crazyem")
    assert runner.fingerprint(Settings(), "crazyem") == usual
    for field in fields(Settings):
        if isinstance(getattr(Settings(), field.name), float):
            changed = replace(Settings(), **{field.name: 1.5 * getattr(Settings(), field.name)})
            assert runner.fingerprint(changed, "crazyem") != usual, field.name


def test_numbers_depend_on_code_and_not_on_its_texts(tmp_path: Path) -> None:
    documented = '"""A."""\n\n\ndef f():\n    """Of f."""\n    return 1  # one\n'
    texts = (documented, "def f():\n    return 1\n", "def f():\n    return 2\n")
    files = [tmp_path / f"{k}.py" for k in range(3)]
    for path, text in zip(files, texts, strict=True):
        path.write_text(text)
    one, same, other = (runner.code_of(path) for path in files)
    assert one == same
    assert other != same


@pytest.mark.slow
def test_only_our_own_numbers_depend_on_the_estimator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A change of the estimator must not call for the published method again, one of the plant for both."""
    shutil.copytree(runner._PACKAGE, tmp_path / "crazyem", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(runner, "_PACKAGE", tmp_path / "crazyem")
    methods = ("crazyem", "published", "bound", "filter")

    def hashes() -> dict[str, str]:
        runner.code_hash.cache_clear()
        runner.code_of.cache_clear()
        return {m: runner.code_hash(m) for m in methods}

    def changed(name: str, addition: bytes = b"\nCHANGED = 1\n") -> list[str]:
        before = hashes()
        path = tmp_path / "crazyem" / name
        path.write_bytes(path.read_bytes() + addition)
        after = hashes()
        return [m for m in methods if after[m] != before[m]]

    try:
        assert changed("estimation/em.py") == ["crazyem"]
        assert changed("paper/product.py") == ["crazyem"]
        assert changed("paper/plant.py") == list(methods)
        assert changed("paper/tables.py") == []
        assert changed("paper/plant.py", b"\n# a comment\n") == []
        assert changed("presets/zhao.toml") == list(methods)
    finally:
        monkeypatch.undo()
        runner.code_hash.cache_clear()


def test_results_are_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    target = tmp_path / "results.json"
    target.write_text("before")
    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(UsageError, match="No space left"):
        write_file(target, "after")
    assert target.read_text() == "before"
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]


# the command --------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def run_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole tiny run in this process, with one figure of 33 (test_paper_figures.py draws all)."""
    out = tmp_path_factory.mktemp("paper") / "one"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "FIGURES", figures.FIGURES[:1])
        assert main(command(out, "--jobs", "1")) == 0
    return out


def test_a_run_leaves_everything(run_once: Path) -> None:
    content = results(run_once)
    assert content["schema"] == runner.SCHEMA
    assert len(content["tasks"]) == 16
    assert len(content["cells"]) == 24
    assert all(c["published"] and c["crazyem"] and c["bound"] for c in content["cells"])
    assert len(content["figures"]) == 1
    assert len(list((run_once / "figures").iterdir())) == 2
    assert "Table V" in (run_once / "tables.md").read_text()
    page = (run_once / "index.html").read_text()
    assert all(f"figure_{f['number']:02d}.png" in page for f in content["figures"])
    assert {s["name"] for s in content["settings"]} == {f.name for f in fields(Settings)}
    assert [p.name for p in (run_once / "tasks").iterdir() if p.name.startswith(".")] == []


@pytest.mark.slow
@pytest.mark.usefixtures("few_figures")
def test_the_same_results_in_other_processes(tmp_path: Path) -> None:
    part = ("--experiment", "offline", "--sensor", "C")
    here, there = tmp_path / "here", tmp_path / "there"
    assert main(command(here, *part, "--jobs", "1")) == 0
    assert main(command(there, *part, "--jobs", "2")) == 0
    assert comparable(there) == comparable(here)
    assert results(there)["timing"]["jobs"] == 2


@pytest.mark.usefixtures("few_figures")
def test_finished_tasks_are_used_again(run_once: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of 16, one is missing, one damaged, one of another version: those three are made again, and it is said."""
    before = comparable(run_once)
    tasks = run_once / "tasks"
    (tasks / "offline-A-bound-0000.json").unlink()
    (tasks / "offline-B-bound-0000.json").write_bytes(b'{"finger')
    other = json.loads((tasks / "offline-C-bound-0000.json").read_text())
    (tasks / "offline-C-bound-0000.json").write_text(json.dumps({**other, "fingerprint": "0" * 32}))
    kept = {p: p.stat().st_mtime_ns for p in tasks.iterdir() if "bound" not in p.name}
    capsys.readouterr()
    assert main(command(run_once, "--jobs", "1")) == 0
    said = capsys.readouterr().err
    assert "13 of 16 simulations were finished before" in said
    assert "1 stored result is damaged and made again" in said
    assert "1 stored result is of other settings or another version and made again" in said
    assert {p: p.stat().st_mtime_ns for p in kept} == kept
    assert comparable(run_once) == before
    assert results(run_once)["timing"]["tasks_reused"] == 13


@pytest.mark.slow
@pytest.mark.usefixtures("few_figures")
def test_a_stopped_run_goes_on(tmp_path: Path) -> None:
    """Ctrl-C after the first simulation: code 130, one sentence, whole task files; the next run finishes the rest."""
    out = tmp_path / "stopped"
    arguments = command(
        out, "--jobs", "2", "--experiment", "offline", "--sensor", "A", "--method", "published", "--seeds", "20"
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "crazyem", *arguments], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    )
    deadline = time.monotonic() + 240
    while not list(out.glob("tasks/[!.]*.json")) and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    done = list(out.glob("tasks/[!.]*.json"))
    (out / "tasks" / ".crazyem-killed.json").write_text("{")  # as a process leaves behind that is killed as it writes
    assert done
    if process.returncode != 0:  # it may have been too fast to be stopped
        assert process.returncode == 130
        assert "Traceback" not in said
        assert said.strip().endswith("crazyem: interrupted.")
        assert not (out / "results.json").exists()
    for path in done:
        assert json.loads(path.read_text())["record"]
    assert main([*arguments, "--jobs", "1"]) == 0
    assert results(out)["timing"]["tasks_reused"] >= len(done)


def test_a_part_of_the_run(tmp_path: Path) -> None:
    out = tmp_path / "part"
    assert main(command(out, "--experiment", "offline", "--sensor", "C", "--method", "published", "--jobs", "1")) == 0
    content = results(out)
    assert {(t["experiment"], t["sensor"], t["method"]) for t in content["tasks"]} == {
        ("offline", "C", "published"),
        ("offline", "C", "bound"),
    }
    assert [f["number"] for f in content["figures"]] == [18, 19, 20, 21, 22]
    assert content["table1"] is None


def test_a_task_that_fails_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others are finished and kept; the exit code is not 0 and nothing is claimed."""

    def broken(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("of something")

    monkeypatch.setattr(experiments, "bound", broken)
    out = tmp_path / "broken"
    assert main(command(out, "--experiment", "offline", "--sensor", "A", "--method", "published", "--jobs", "1")) == 1
    said = capsys.readouterr().err
    assert "offline-A-bound-0000" in said
    assert "Traceback" not in said
    assert not (out / "results.json").exists()
    assert [p.name for p in (out / "tasks").iterdir()] == ["offline-A-published-0000.json"]


@pytest.mark.parametrize(
    "arguments",
    [
        ["--experiment", "both"], ["--sensor", "D"], ["--seeds", "0"], ["--seeds", "x"], ["--jobs", "0"],
        ["--set", "mass"],
    ],
)  # fmt: skip
def test_wrong_arguments(arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["paper", "--out", str(tmp_path / "out"), *arguments]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_an_output_that_is_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").write_text("mine")
    assert main(command(tmp_path / "out")) == 2
    assert "cannot make the folder" in capsys.readouterr().err
    assert (tmp_path / "out").read_text() == "mine"


def test_settings_need_no_compiler() -> None:
    """Listing settings and refusing arguments must not wait for numba."""
    code = "import sys; from crazyem.cli import main; main(['paper', '--settings']); assert 'numba' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL, timeout=60)
