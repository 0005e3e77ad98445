"""How long does a ten-minute flight at 1 kHz take to read and check, and how much memory, in every format of ours?

    python benchmarks/recordings.py [--minutes 10] [--rounds 3] [--only commands,peers,folder] [--json FILE]

The flight is made here: 20 variables (position, velocity, quaternion, gyro, accelerometer, four motors), seeded,
with take-off and landing. It is written as a uSD card log; from that `crazyem import` makes an MCAP file and `crazyem
export` a CSV; the same numbers go into a plain CSV that is read through a mapping.

`commands`: `crazyem info` and `crazyem doctor` on each, as processes of their own: wall time, processor time and peak
memory of the whole process, against the limits of 10 s and 500 MB. `peers`: reading alone, against what one would take
otherwise. `folder`: benchmarks/usd_folder.py. Files larger than memory: recordings_large.py. Linux.
"""

import argparse
import json
import struct
import sys
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

from child import CRAZYEM, Usage, measured, python

LIMITS = 10.0, 500.0  # s and MB for reading and checking
SLICE = 20  # MCAP's own reader gets a twentieth of the flight, and its time is scaled
STATE = [f"stateEstimate.{name}" for name in ("x", "y", "z", "vx", "vy", "vz", "qx", "qy", "qz", "qw")]
SENSORS = [*(f"gyro.{axis}" for axis in "xyz"), *(f"acc.{axis}" for axis in "xyz")]
MOTORS = [f"motor.m{i}" for i in (1, 2, 3, 4)]
BLOCK = 200_000  # rows made at a time
MAPPING = """
name = "benchmark"
title = "Benchmark"
layout = "wide"
[time]
column = "time"
unit = "s"
clock = "host"
[signals.position]
columns = ["stateEstimate.x", "stateEstimate.y", "stateEstimate.z"]
unit = "m"
[signals.velocity]
columns = ["stateEstimate.vx", "stateEstimate.vy", "stateEstimate.vz"]
unit = "m/s"
[signals.attitude]
columns = ["stateEstimate.qx", "stateEstimate.qy", "stateEstimate.qz", "stateEstimate.qw"]
order = "xyzw"
direction = "body to world"
[signals.body_rate]
columns = ["gyro.x", "gyro.y", "gyro.z"]
unit = "deg/s"
[signals.specific_force]
columns = ["acc.x", "acc.y", "acc.z"]
unit = "g"
[signals.motor_command]
columns = ["motor.m1", "motor.m2", "motor.m3", "motor.m4"]
unit = "pwm"
"""


def blocks(*, rows: int, seed: int = 0) -> Iterator[tuple[Any, dict[str, Any]]]:
    """(stamps (n,) in us, columns by name) of the flight, a block of rows at a time; the whole is `rows` ms long."""
    import numpy as np

    rng = np.random.default_rng(seed)
    phases = rng.uniform(0.0, 2.0 * np.pi, (3, 4))
    for first in range(0, rows, BLOCK):
        t = 1e-3 * np.arange(first, min(first + BLOCK, rows))
        position, velocity, force = _path(t, 1e-3 * rows, phases)
        z = force / np.linalg.norm(force, axis=1, keepdims=True)
        attitude = _upright(z)
        ahead = _upright(_direction(t + 1e-3, 1e-3 * rows, phases))
        rate = 2e3 * _relative(attitude, ahead)  # of a rotation by a small angle
        noise = rng.normal(size=(t.size, 16))
        thrust = np.linalg.norm(force, axis=1) / 9.81
        values = np.column_stack(
            [
                position + 5e-4 * noise[:, 0:3],
                velocity + 5e-3 * noise[:, 3:6],
                attitude,
                np.degrees(rate + 0.02 * noise[:, 6:9]),
                np.column_stack([0 * thrust, 0 * thrust, thrust]) + 0.02 * noise[:, 9:12],
            ]
        )
        duty = 65535.0 * np.clip(0.55 * np.sqrt(thrust)[:, None] + 0.01 * noise[:, 12:16], 0.0, 1.0)
        resting = position[:, 2] < 0.02
        duty[resting] = 0.0
        columns = dict(zip(STATE + SENSORS, values.T.astype("<f4"), strict=True))
        columns |= dict(zip(MOTORS, duty.T.astype("<u2"), strict=True))
        yield 1_000_000 + 1000 * np.arange(first, first + t.size), columns


def _path(t: Any, seconds: float, phases: Any) -> tuple[Any, Any, Any]:
    """Position, velocity, specific force in the world (n, 3): sines under a smooth take-off and landing."""
    import numpy as np

    def at(t: Any) -> Any:
        ramp = np.clip(np.minimum(t - 1.0, seconds - 1.0 - t) / 3.0, 0.0, 1.0)
        ramp = ramp**3 * (10.0 - 15.0 * ramp + 6.0 * ramp**2)
        frequencies = np.array([0.11, 0.23, 0.37, 0.53])
        waves = [np.sin(2.0 * np.pi * frequencies * t[:, None] + phase).sum(axis=1) for phase in phases]
        place = np.column_stack([0.25 * waves[0], 0.25 * waves[1], 1.0 + 0.1 * waves[2]])
        return ramp[:, None] * place

    h = 2e-3
    before, here, after = at(t - h), at(t), at(t + h)
    return here, (after - before) / (2.0 * h), (after - 2.0 * here + before) / h**2 + [0.0, 0.0, 9.81]


def _direction(t: Any, seconds: float, phases: Any) -> Any:
    import numpy as np

    force = _path(t, seconds, phases)[2]
    return force / np.linalg.norm(force, axis=1, keepdims=True)


def _upright(z: Any) -> Any:
    """(n, 4) shortest rotation (x, y, z, w) that takes the vertical to the unit vectors `z` (n, 3)."""
    import numpy as np

    q = np.column_stack([-z[:, 1], z[:, 0], np.zeros(len(z)), 1.0 + z[:, 2]])
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def _relative(a: Any, b: Any) -> Any:
    """(n, 3) vector part of conj(a) b."""
    import numpy as np

    return a[:, 3:] * b[:, :3] - b[:, 3:] * a[:, :3] - np.cross(a[:, :3], b[:, :3])


def write_usd(path: Path, *, rows: int) -> None:
    """A uSD card log, version 2, block by block."""
    import numpy as np

    names = STATE + SENSORS + MOTORS
    header = b"\xbc" + struct.pack("<HHH", 2, 1, 0xFFFF) + b"fixedFrequency\0" + struct.pack("<H", len(names))
    header += b"".join(f"{n}({'H' if n in MOTORS else 'f'})".encode() + b"\0" for n in names)
    layout = [("id", "<u2"), ("t", "<u8")] + [(n, "<u2" if n in MOTORS else "<f4") for n in names]
    with path.open("wb") as file:
        checksum = zlib.crc32(header)
        file.write(header)
        for stamps, columns in blocks(rows=rows):
            records = np.zeros(stamps.size, layout)
            records["id"], records["t"] = 0xFFFF, stamps
            for name, column in columns.items():
                records[name] = column
            data = records.tobytes()
            checksum = zlib.crc32(data, checksum)
            file.write(data)
        file.write(struct.pack("<I", checksum))


def write_csv(path: Path, *, rows: int) -> None:
    """The same as a plain CSV, numbers as short as they can be."""
    import pyarrow as pa
    from pyarrow import csv

    writer = None
    for stamps, columns in blocks(rows=rows):
        batch = pa.record_batch({"time": stamps / 1e6, **columns})
        if writer is None:
            writer = csv.CSVWriter(str(path), batch.schema, write_options=csv.WriteOptions(quoting_style="none"))
        writer.write(batch)
    assert writer is not None
    writer.close()


def make(folder: Path, *, rows: int) -> dict[str, list[str]]:
    """Make the files: format -> arguments of a command on it. Other processes make them, to keep this one small."""
    usd, csv, mapping = folder / "log00", folder / "plain.csv", folder / "map.toml"
    mcap, exported, part = folder / "imported.mcap", folder / "exported.csv", folder / "part.mcap"
    mapping.write_text(MAPPING)
    me = [sys.executable, __file__, "--rows", str(rows)]
    measured([*me, "--make", "usd", str(usd)])
    measured([*me, "--make", "csv", str(csv)])
    measured([sys.executable, __file__, "--rows", str(rows // SLICE), "--make", "usd", str(folder / "log01")])
    measured([*CRAZYEM, "import", str(usd), "-o", str(mcap), "--motor", "duty"])
    measured([*CRAZYEM, "import", str(folder / "log01"), "-o", str(part), "--motor", "duty"])
    measured([*CRAZYEM, "export", str(usd), "-o", str(exported), "--motor", "duty"])
    return {
        "uSD card log": [str(usd), "--motor", "duty"],
        "MCAP": [str(mcap)],
        "CSV with --map": [str(csv), "--map", str(mapping)],
        "exported CSV": [str(exported)],
    }


def measure_commands(files: dict[str, list[str]], *, rounds: int) -> list[dict[str, Any]]:
    """`crazyem info` and `crazyem doctor` on each file, in interleaved rounds."""
    jobs = {(name, what): [*CRAZYEM, what, *rest] for name, rest in files.items() for what in ("info", "doctor")}
    if "uSD card log" in files:
        source = files["uSD card log"]
        target = str(Path(source[0]).parent / "again")
        jobs["uSD card log", "import"] = [*CRAZYEM, "import", *source, "-o", f"{target}.mcap", "--force"]
        jobs["uSD card log", "export to CSV"] = [*CRAZYEM, "export", *source, "-o", f"{target}.csv", "--force"]
    if "exported CSV" in files:
        again = str(Path(files["exported CSV"][0]).parent / "again.parquet")
        jobs["exported CSV", "export to Parquet"] = [
            *(*CRAZYEM, "export", *files["exported CSV"]), "-o", again, "--force",
        ]  # fmt: skip
    used: dict[tuple[str, str], list[Usage]] = {job: [] for job in jobs}
    for _ in range(rounds):
        for job, command in jobs.items():
            used[job].append(measured(command))
    return [row(name, what, used[name, what], Path(files[name][0]).stat().st_size) for name, what in jobs]


_OURS = """
import sys, time
from crazyem.recordings import ReadOptions, open_recording
options = ReadOptions(**dict(word.split("=") for word in sys.argv[2:]))
begin = time.perf_counter()
recording = open_recording(sys.argv[1], options)
print(time.perf_counter() - begin)
"""
_PANDAS = """
import sys, time
import pandas
begin = time.perf_counter()
pandas.read_csv(sys.argv[1])
print(time.perf_counter() - begin)
"""
_MCAP = """
import sys, time
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
begin = time.perf_counter()
with open(sys.argv[1], "rb") as file:
    count = sum(1 for _ in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
print(time.perf_counter() - begin)
"""
_STRUCT = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from usd_folder import plain
begin = time.perf_counter()
plain(Path(sys.argv[1]))
print(time.perf_counter() - begin)
"""


def measure_peers(files: dict[str, list[str]], *, rounds: int) -> list[dict[str, Any]]:
    """Reading alone, interpreter and imports not counted in the time; memory is that of the whole process."""
    usd, mcap, exported = (files[name][0] for name in ("uSD card log", "MCAP", "exported CSV"))
    csv, _, mapping = files["CSV with --map"]
    jobs = {
        ("uSD card log", "crazyem"): (python(_OURS, usd, "motor=duty"), 1),
        ("uSD card log", "plain struct loop, into lists"): (python(_STRUCT, usd, str(Path(__file__).parent)), 1),
        ("MCAP", "crazyem"): (python(_OURS, mcap), 1),
        ("MCAP", f"mcap + mcap-protobuf-support (1/{SLICE}, scaled)"): (
            python(_MCAP, str(Path(mcap).parent / "part.mcap")),
            SLICE,
        ),
        ("CSV with --map", "crazyem"): (python(_OURS, csv, f"mapping={mapping}"), 1),
        ("CSV with --map", "pandas.read_csv"): (python(_PANDAS, csv), 1),
        ("exported CSV", "crazyem"): (python(_OURS, exported), 1),
        ("exported CSV", "pandas.read_csv"): (python(_PANDAS, exported), 1),
    }
    used: dict[tuple[str, str], list[Usage]] = {job: [] for job in jobs}
    for _ in range(rounds):
        for job, (command, scale) in jobs.items():
            usage = measured(command)
            used[job].append(Usage(scale * float(usage.output), scale * usage.processor_s, usage.memory_mb, ""))
    return [row(name, what, used[name, what], Path(files[name][0]).stat().st_size) for name, what in jobs]


def row(name: str, what: str, used: list[Usage], size: int) -> dict[str, Any]:
    """A row with minimum, median and maximum of some runs."""
    result: dict[str, Any] = {"format": name, "what": what, "bytes": size, "rounds": len(used)}
    for key in ("wall_s", "processor_s", "memory_mb"):
        values = [getattr(u, key) for u in used]
        result[key] = {"least": min(values), "median": median(values), "most": max(values)}
    return result


def table(rows: list[dict[str, Any]], *, limits: tuple[float, float] | None = None) -> str:
    """Rows as Markdown."""
    lines = ["| format | MB | what | s (least..most) | processor s | MB at most |", "|---|---|---|---|---|---|"]
    for r in rows:
        wall, memory = r["wall_s"], r["memory_mb"]
        over = limits and r["what"] in ("info", "doctor") and (wall["most"] > limits[0] or memory["most"] > limits[1])
        lines.append(
            f"| {r['format']} | {r['bytes'] / 1e6:.0f} | {r['what']} "
            f"| {wall['median']:.2f} ({wall['least']:.2f}..{wall['most']:.2f}) | {r['processor_s']['median']:.2f} "
            f"| {memory['most']:.0f}{' OVER THE LIMIT' if over else ''} |"
        )
    return "\n".join(lines)


def measure(folder: Path, *, rows: int, rounds: int, only: set[str]) -> dict[str, Any]:
    """Make the requested measurements; files go into `folder`."""
    result: dict[str, Any] = {"rows": rows}
    if only & {"commands", "peers"}:
        files = make(folder, rows=rows)
        if "commands" in only:
            result["commands"] = measure_commands(files, rounds=rounds)
        if "peers" in only:
            result["peers"] = measure_peers(files, rounds=rounds)
    return result


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", default="commands,peers,folder")
    parser.add_argument("--folder", type=Path, help="for the files; default: a temporary one")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--make", nargs=2, metavar=("FORMAT", "FILE"), help="only write one file: usd or csv")
    parser.add_argument("--rows", type=int, help="instead of --minutes")
    arguments = parser.parse_args()
    rows = arguments.rows or int(60_000 * arguments.minutes)
    if arguments.make:
        {"usd": write_usd, "csv": write_csv}[arguments.make[0]](Path(arguments.make[1]), rows=rows)
        return
    only = set(arguments.only.split(","))
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        result = measure(Path(name), rows=rows, rounds=arguments.rounds, only=only)
    if "commands" in result:
        print(f"{rows} rows, {arguments.rounds} rounds; limits {LIMITS[0]:g} s and {LIMITS[1]:g} MB\n")
        print(table(result["commands"], limits=LIMITS))
    if "peers" in result:
        print("\nReading alone\n")
        print(table(result["peers"]))
    if "folder" in only:
        import usd_folder

        result["folder"] = usd_folder.measure_folder(files=450, kilobytes=220, rounds=arguments.rounds)
        print(f"\n450 uSD card logs of 220 KB, median of {arguments.rounds} rounds (range); limit 5 s on two cores\n")
        for name, r in result["folder"]["rows"].items():
            print(f"{name:30s} {r['median_s']:7.2f} s ({r['least_s']:.2f}..{r['most_s']:.2f})")
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
