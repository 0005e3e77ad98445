"""Commands on many recordings at once: the terminal, interruption, processes, a cluster, errors."""

import gc
import gzip
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from recording_files import fails, flight_fixture, folder_fixture, link_pair, run

from crazyem.commands import batch, output
from crazyem.commands.merge import merge_findings
from crazyem.commands.output import Report, Result, plain
from crazyem.commands.workers import shared
from crazyem.errors import CrazyemError, LinkError, UsageError
from crazyem.recordings import Finding, Grade, open_recording

flight = pytest.fixture(scope="module")(flight_fixture)
folder = pytest.fixture(folder_fixture)


# --- the terminal -------------------------------------------------------------------------------------------------


def test_names_cannot_steer_the_terminal(capsys: pytest.CaptureFixture[str], flight: Path, tmp_path: Path) -> None:
    assert plain("a\x1b[31m\r\nb") == "a\ufffd[31m\ufffd\nb"
    link_pair(flight, tmp_path / "a\x1b[31m.csv")
    assert run(capsys, "info", tmp_path / "a\x1b[31m.csv")[0] == 0  # `run` looks for escapes


@pytest.mark.slow
def test_a_name_that_is_no_text(tmp_path: Path, flight: Path) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/fl\xffight.csv"))
    link_pair(flight, path)
    target = os.fsencode(tmp_path) + b"/\xfe.mcap"
    commands = "main(['info', a]) or main(['import', a, '-o', b]) or main(['info', a, '--json'])"
    program = f"import sys; from crazyem.cli import main; a, b = sys.argv[1:]; sys.exit({commands})"
    done = subprocess.run([sys.executable, "-c", program, path, target], capture_output=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    assert b"Traceback" not in done.stderr
    told = json.loads(done.stdout[done.stdout.index(b"\n{") :])
    assert os.fsencode(told["files"][0]["file"]) == os.fsencode(path)
    assert open_recording(os.fsdecode(target)).signals


def test_a_reader_that_has_seen_enough(flight: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "crazyem", "info", str(flight)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.close()
    said = process.stderr.read()
    process.stderr.close()
    assert process.wait(600) == 141
    assert said == b""


@pytest.mark.slow
def test_interrupted_among_many(tmp_path: Path, flight: Path) -> None:
    for i in range(200):
        link_pair(flight, tmp_path / f"{i:03}.csv")
    process = subprocess.Popen(
        [sys.executable, "-m", "crazyem", "info", str(tmp_path), "--jobs", "2"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    process.stdout.readline()  # it has begun
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to all of its processes
    _, err = process.communicate(timeout=600)
    assert process.returncode == 130
    assert [line for line in err.splitlines() if not line.startswith(b"info: ")] == [b"crazyem: interrupted."]


# --- many at once -------------------------------------------------------------------------------------------------


def square(x: int) -> Result:
    """A task for other processes."""
    if x == 3:
        raise UsageError("three is wrong.")
    if x == 4:
        raise RuntimeError("a bug\nin a reader")
    time.sleep(0.01 * (x % 3))
    return Result(str(x), {"square": x * x, "process": os.getpid()})


def test_errors_stay_with_their_file_and_results_in_order() -> None:
    results = list(batch.each(square, [(x,) for x in range(8)], names=[str(x) for x in range(8)], what="t", jobs=1))
    assert [r.file for r in results] == [str(x) for x in range(8)]
    assert [r.code for r in results] == [0, 0, 0, 2, 1, 0, 0, 0]
    assert results[3].error == "three is wrong."
    assert "please report it (RuntimeError: a bug in a reader)" in results[4].error
    assert results[5].data["square"] == 25


def test_a_worker_that_is_killed_is_one_sentence() -> None:
    assert list(shared(pow, [(2, n) for n in range(5)], 2)) == [1, 2, 4, 8, 16]
    with pytest.raises(CrazyemError, match="a worker process ended before its work was done"):
        list(shared(os._exit, [(1,), (1,)], 2))


def test_processes_are_no_more_than_files() -> None:
    assert batch.processes(8, 3) == 3
    assert batch.processes(2, 30) == 2
    assert batch.processes(None, 1000) >= 1
    assert batch.processes(None, 1) == 1


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nonsense://x", "tcp://127.0.0.1:1"])
def test_no_cluster_there_is_one_sentence(
    capsys: pytest.CaptureFixture[str], flight: Path, monkeypatch: pytest.MonkeyPatch, address: str
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(batch, "CONNECT_SECONDS", 0.5)
    gc.collect()  # a client that failed ends itself when it is collected: amid the start of another it waits for ever
    code = 2 if "nonsense" in address else LinkError.exit_code
    assert address in fails(capsys, "info", flight, "--cluster", address, code=code)


def test_without_dask_it_says_how_to_get_it(
    capsys: pytest.CaptureFixture[str], flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "pip install 'crazyem[cluster]'" in fails(capsys, "info", flight, "--cluster", "127.0.0.1:1", code=2)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_processes_and_a_cluster_give_what_one_process_gives(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    def told(*how: Any) -> Any:
        code, out, _ = run(capsys, "info", folder, *how, "--json")
        assert code == 3
        return json.loads(out)

    alone = told("--jobs", 1)
    assert told("--jobs", 2) == alone
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        assert told("--cluster", cluster.scheduler_address) == alone


def test_progress_is_a_line_now_and_then_where_there_is_no_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(output, "_FIRST_PROGRESS", 0.0)
    with output.Progress("info", 3) as progress:
        for _ in range(3):
            progress.step()
    assert capsys.readouterr().err == "info: 1 of 3 files\n"


def test_the_report_keeps_the_first_error(capsys: pytest.CaptureFixture[str]) -> None:
    import argparse

    report = Report(argparse.Namespace(json=None))
    report.add(Result("a", text="fine"))
    report.add(Result("b", error="bad", code=5))
    report.add(Result("c", error="worse.", code=3))
    assert report.close() == 5
    out, err = capsys.readouterr()
    assert out == "fine\n"
    assert err == "crazyem: bad.\ncrazyem: worse.\n"


def test_a_packed_recording_too(capsys: pytest.CaptureFixture[str], flight: Path, tmp_path: Path) -> None:
    path = tmp_path / "f.csv.gz"
    path.write_bytes(gzip.compress(flight.read_bytes()))
    (tmp_path / "f.csv-metadata.json").write_bytes(Path(f"{flight}-metadata.json").read_bytes())
    assert run(capsys, "import", path, "-o", tmp_path)[0] == 0
    assert (tmp_path / "f.mcap").exists()


def test_parts_on_the_ground_are_no_verdict_on_the_whole() -> None:
    grounded = Finding("flight", Grade.UNUSABLE, "The drone never flew: its rotors never carried it.")
    cut = Finding(
        "flight",
        Grade.HARMLESS,
        "The recording begins with rotors at work; 30.0 s in the air.",
        intervals=((60.0, 90.0),),
        evidence={"airborne_s": 30.0},
    )
    upset = Finding("flight", Grade.DEGRADES, "The drone is upside down.", intervals=((61.0, 62.0),))
    merged = merge_findings([(grounded,), (cut, upset), (replace(cut, intervals=((120.0, 150.0),)),)])
    assert [f.grade for f in merged] == [Grade.DEGRADES, Grade.HARMLESS]
    assert merged[0].intervals == ((61.0, 62.0),)
    only = merge_findings([(grounded,), (cut,), (replace(cut, intervals=((120.0, 150.0),)),)])
    assert [f.evidence["airborne_s"] for f in only] == [60.0]
    assert only[0].intervals == ((60.0, 90.0), (120.0, 150.0))
    never = merge_findings([(grounded,), (grounded,)])
    assert [f.grade for f in never] == [Grade.UNUSABLE]
