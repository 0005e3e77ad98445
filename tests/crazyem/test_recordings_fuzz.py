"""Damaged files of every format: a recording or one clear error, in bounded time and memory, never a traceback.

Seeds and damages are those of reader_seeds.py; benchmarks/fuzz_readers.py runs the same under a coverage-guided fuzzer.
"""

import random
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from reader_seeds import damage, seeds

from crazyem.errors import CrazyemError
from crazyem.recordings import open_recording

FORMATS = (  # of reader_seeds.seeds
    *("usd1", "usd2", "ulog", "tlog", "cfclient", "nanobench", "nanobench.gz", "long"),
    *("mcap", "imported", "exported", "rosbag2"),
)
LONGEST = 10  # s of processor time for a file of a few kilobytes
MEMORY = 1 << 30  # bytes beyond what the libraries take


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    made = seeds(tmp_path_factory.mktemp("seeds"))
    assert sorted(made) == sorted(FORMATS)
    return made


def attempt(path: Path) -> str:
    """Open a file; the error's text, "" if it could be read. Anything but a CrazyemError goes through."""
    try:
        recording = open_recording(path)
    except CrazyemError as error:
        return str(error)
    assert len(recording) > 0 or recording.findings
    assert all(a.time.size == len(a.value) == a.order.size == a.marked.size for a in recording.signals.values())
    for finding in recording.findings:
        assert finding.text
    return ""


def too_long(_signal: int, _frame: object) -> None:
    raise TimeoutError(f"more than {LONGEST} s of processor time")


def campaign(data: bytes, folder: Path, *, seed: int, count: int) -> int:
    """Open `count` damaged copies under a limit of processor time; returns how many could still be read."""
    rng = random.Random(seed)
    path = folder / "damaged.bin"
    signal.signal(signal.SIGPROF, too_long)
    readable = 0
    for number in range(count):
        path.write_bytes(damage(data, rng))
        signal.setitimer(signal.ITIMER_PROF, LONGEST)
        try:
            message = attempt(path)
        except BaseException as error:
            raise AssertionError(f"damage number {number} of seed {seed}: {type(error).__name__}: {error}") from error
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        assert "\n" not in message
        assert "Traceback" not in message
        assert not message or str(path) in message
        readable += not message
    return readable


@pytest.mark.parametrize("name", FORMATS)
def test_the_seed_itself_is_read(files, name, tmp_path):
    path = tmp_path / "seed.bin"
    path.write_bytes(files[name])
    assert attempt(path) == ""


@pytest.mark.parametrize("name", ["mcap", "imported"])
@pytest.mark.parametrize("start", [1, 8, 20, 28, 36])
def test_a_summary_said_to_begin_in_the_footer(files, name, start, tmp_path):
    """Found by the fuzzer: the last bytes of an MCAP say where its summary begins, here at or behind themselves."""
    data = bytearray(files[name])
    footer = len(data) - 37  # opcode, length, summary start, summary offset start, checksum, magic
    data[footer + 9 : footer + 17] = (len(data) - start).to_bytes(8, "little")
    path = tmp_path / "footer.mcap"
    path.write_bytes(bytes(data))
    assert attempt(path) == ""


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files(files, name, tmp_path):
    campaign(files[name], tmp_path, seed=1, count=60)


@pytest.mark.slow
@pytest.mark.nightly
def test_many_damaged_files_in_little_memory(tmp_path):
    """In a process of their own, whose address space is capped once the libraries are loaded."""
    done = subprocess.run(
        [sys.executable, __file__, str(tmp_path)],
        capture_output=True, text=True, cwd=Path(__file__).parent, timeout=1200, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]


def main(folder: Path) -> None:
    made = seeds(folder)
    path = folder / "warm.bin"
    for data in made.values():
        path.write_bytes(data)
        attempt(path)  # loads what the reader needs, before the limit
    with open("/proc/self/statm") as statm:
        used = int(statm.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    for name, data in made.items():
        print(name, flush=True)
        campaign(data, folder, seed=2, count=500)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
