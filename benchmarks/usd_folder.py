"""How fast is a folder of uSD card logs read, against a plain decoder, and what does a long log cost in memory?

    python benchmarks/usd_folder.py [--files 450] [--kilobytes 220] [--rounds 3] [--json FILE]

The files are made here: half of them runs of one event (100 Hz, 20 variables), half with a second event after every
other record, which is the worst case for a reader that takes runs. `crazyem` reads each to a whole `Recording` (signals
in SI, CRC, what motor.m1..4 is); the peer is the plain loop that lab scripts have: struct.unpack a record at a time
into lists, no units, no CRC. Both read the same files in one process; crazyem in two processes as well (started
before the clock is). Last, ten minutes at 1 kHz with 12 variables in a process of its own, with its peak memory
(Linux).
"""

import argparse
import json
import multiprocessing
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

FIXED = [
    *(f"motor.m{i}(I)" for i in (1, 2, 3, 4)),
    *(f"pwm.m{i}_pwm(I)" for i in (1, 2, 3, 4)),
    "pm.vbatMV(H)",
    *(f"stateEstimate.{name}(f)" for name in ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "roll", "yaw")),
]
OTHER = ["distance(f)", "anchor(B)"]
_TYPES = {"I": "<u4", "H": "<u2", "f": "<f4", "B": "u1"}


def _header(events: list[tuple[int, str, list[str]]]) -> bytes:
    out = b"\xbc" + struct.pack("<HH", 2, len(events))
    for identifier, name, variables in events:
        out += struct.pack("<H", identifier) + name.encode() + b"\0" + struct.pack("<H", len(variables))
        out += b"".join(v.encode() + b"\0" for v in variables)
    return out


def _layout(variables: list[str]) -> np.dtype[np.void]:
    fields = [("id", "<u2"), ("t", "<u8")] + [(str(i), _TYPES[v[-2]]) for i, v in enumerate(variables)]
    return np.dtype(fields)


def _records(variables: list[str], identifier: int, count: int, *, period: int, seed: int) -> np.ndarray:
    """(count,) records: a slow random walk in every variable, as good as a flight for a reader."""
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, _layout(variables))
    rows["id"], rows["t"] = identifier, 1_000_000 + period * np.arange(count)
    for i, variable in enumerate(variables):
        walk = np.cumsum(rng.normal(0, 0.01, count))
        rows[str(i)] = walk if variable[-2] == "f" else np.clip(200 + 20 * walk, 0, 255)
    return rows


def make(*, kilobytes: int, interleaved: bool, seed: int) -> bytes:
    """One log."""
    header = _header([(0xFFFF, "fixedFrequency", FIXED), (7, "estTDOA", OTHER)])
    size = _layout(FIXED).itemsize + (_layout(OTHER).itemsize / 2 if interleaved else 0)
    rows = _records(FIXED, 0xFFFF, int((1000 * kilobytes - len(header)) / size), period=9900, seed=seed)
    body = rows.tobytes()
    if interleaved:
        width = rows.dtype.itemsize
        events = _records(OTHER, 7, rows.size // 2, period=19_800, seed=seed + 1)
        pairs = [body[2 * i * width : 2 * (i + 1) * width] + events[i].tobytes() for i in range(events.size)]
        body = b"".join(pairs) + body[2 * events.size * width :]
    data = header + body
    return data + struct.pack("<I", zlib.crc32(data))


def plain(path: Path) -> int:
    """The peer: number of samples in its lists."""
    data = path.read_bytes()
    at = 5
    events: dict[int, tuple[str, int, list[list[float]]]] = {}
    for _ in range(struct.unpack_from("<H", data, 3)[0]):
        identifier = struct.unpack_from("<H", data, at)[0]
        at = data.index(b"\0", at + 2) + 1
        count = struct.unpack_from("<H", data, at)[0]
        at += 2
        form = "<Q"
        for _ in range(count):
            end = data.index(b"\0", at)
            form += chr(data[end - 2])
            at = end + 1
        events[identifier] = (form, struct.calcsize(form), [[] for _ in range(count + 1)])
    while at < len(data) - 4:
        form, size, columns = events[struct.unpack_from("<H", data, at)[0]]
        for column, value in zip(columns, struct.unpack_from(form, data, at + 2), strict=True):
            column.append(value)
        at += 2 + size
    return sum(len(columns[0]) * (len(columns) - 1) for _, _, columns in events.values())


def ours(path: Path) -> int:
    """crazyem: number of values in its signals."""
    from crazyem.recordings import open_recording

    return sum(array.value.size for array in open_recording(path).signals.values())


def timed(call: Callable[[], Any]) -> float:
    """Seconds of a call."""
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def measure_folder(*, files: int, kilobytes: int, rounds: int) -> dict[str, Any]:
    """Seconds for all files: medians over interleaved rounds, and the ranges."""
    with tempfile.TemporaryDirectory() as name:
        paths = []
        for i in range(files):
            paths.append(Path(name) / f"log{i:03d}")
            paths[-1].write_bytes(make(kilobytes=kilobytes, interleaved=bool(i % 2), seed=i))
        assert ours(paths[0]) == plain(paths[0])  # warm, and the same number of samples
        with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
            list(pool.map(ours, paths[:4]))  # imports of the workers
            contenders: dict[str, Callable[[], Any]] = {
                "crazyem, 2 processes": lambda: list(pool.map(ours, paths)),
                "crazyem, 1 process": lambda: [ours(path) for path in paths],
                "plain struct loop, 1 process": lambda: [plain(path) for path in paths],
            }
            seconds: dict[str, list[float]] = {contender: [] for contender in contenders}
            for _ in range(rounds):
                for contender, call in contenders.items():
                    seconds[contender].append(timed(call))
        size = sum(path.stat().st_size for path in paths)
    rows = {k: {"median_s": median(v), "least_s": min(v), "most_s": max(v)} for k, v in seconds.items()}
    return {"files": files, "bytes": size, "rounds": rounds, "rows": rows}


_ALONE = """
import resource, sys, time
from crazyem.recordings import open_recording
begin = time.perf_counter()
recording = open_recording(sys.argv[1])
print(time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, len(recording))
"""


def measure_long(*, rows: int) -> dict[str, float]:
    """A log of 12 float variables at 1 kHz, in a process of its own: seconds, peak memory of the process [MB]."""
    variables = [f"{group}.{axis}(f)" for group in ("gyro", "acc") for axis in "xyz"]
    variables += [f"stateEstimate.{name}(f)" for name in ("x", "y", "z", "vx", "vy", "vz")]
    body = _header([(0xFFFF, "fixedFrequency", variables)])
    body += _records(variables, 0xFFFF, rows, period=989, seed=0).tobytes()
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "log"
        path.write_bytes(body + struct.pack("<I", zlib.crc32(body)))
        done = subprocess.run([sys.executable, "-c", _ALONE, str(path)], capture_output=True, text=True, check=True)
    seconds, memory, samples = map(float, done.stdout.split())
    return {"seconds": seconds, "memory_mb": memory, "samples": samples, "bytes": len(body) + 4}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=450)
    parser.add_argument("--kilobytes", type=int, default=220)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--rows", type=int, default=600_000, help="of the long log")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    folder = measure_folder(files=arguments.files, kilobytes=arguments.kilobytes, rounds=arguments.rounds)
    long = measure_long(rows=arguments.rows)
    print(f"{folder['files']} files, {folder['bytes'] / 1e6:.0f} MB; median of {folder['rounds']} rounds (range)")
    base = folder["rows"]["plain struct loop, 1 process"]["median_s"]
    for name, row in folder["rows"].items():
        ratio = base / row["median_s"]
        print(f"{name:30s} {row['median_s']:7.2f} s ({row['least_s']:.2f}..{row['most_s']:.2f})  x {ratio:.1f}")
    print(
        f"one log of {arguments.rows} rows, {long['bytes'] / 1e6:.0f} MB: {long['seconds']:.2f} s, "
        f"{long['memory_mb']:.0f} MB at most (interpreter and imports included)"
    )
    if arguments.json:
        arguments.json.write_text(json.dumps({"folder": folder, "long": long}, indent=1) + "\n")


if __name__ == "__main__":
    main()
