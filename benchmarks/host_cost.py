"""What a flight costs the host: processor time of crazyem and of the simulated firmware, and packets lost.

    python benchmarks/host_cost.py [--duration 20] [--trajectory excite] [--json FILE]

Starts `python -m firmware_sim` at speed 1 and `crazyem fly URI` against it as processes of their own, and reads their
processor time from /proc (Linux) once a second. The load is that of the flight itself, from the second live line on:
imports, compilation and connecting are told apart. Four log blocks at 100 Hz are what `crazyem fly` subscribes.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from crazyem.live.simulator import Simulator


def processor_seconds(pid: int) -> float:
    """User and system time of a process so far [s].

    Raises:
        OSError: it is gone, or this is not Linux.
    """
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def fly(*, duration: float, trajectory: str, seed: int) -> dict[str, Any]:
    """One flight; loads as fractions of one core, the summary's packet counts and update costs."""
    with tempfile.TemporaryDirectory() as folder, Simulator(seed=seed) as simulator:
        assert simulator._process is not None
        summary = Path(folder) / "flight.json"
        command = [
            sys.executable, "-m", "crazyem", "fly", simulator.uri, "--trajectory", trajectory, "--duration",
            str(duration), "--json", str(summary), "--record", str(Path(folder) / "flight.mcap"),
        ]  # fmt: skip
        process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        lines: list[tuple[float, str]] = []

        def read() -> None:
            lines.extend((time.monotonic(), line.rstrip()) for line in process.stderr or ())

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        pids = {"crazyem": process.pid, "firmware_sim": simulator._process.pid}
        marks: list[tuple[float, dict[str, float]]] = []
        while process.poll() is None:
            if len(lines) >= 3:
                try:
                    marks.append((time.monotonic(), {n: processor_seconds(p) for n, p in pids.items()}))
                except OSError:
                    break
            time.sleep(1.0)
        process.wait()
        reader.join(timeout=5.0)
        if process.returncode != 0:
            raise SystemExit(f"crazyem fly failed: {lines[-1][1] if lines else process.returncode}")
        told = json.loads(summary.read_text())
    # later marks belong to landing, final estimate and plot
    inside = [m for m in marks if m[0] - marks[0][0] <= duration]
    (begin, before), (end, after) = inside[0], inside[-1]
    seconds = end - begin
    return {
        "measured_s": seconds,
        "load": {n: (after[n] - before[n]) / seconds for n in pids},
        "before_and_after_s": {"crazyem": marks[-1][1]["crazyem"] - (after["crazyem"] - before["crazyem"])},
        "samples": told["samples"],
        "updates": told["updates"],
        "update_ms": told["update_ms"],
        "pushes": len(told["pushes"]),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; prints a table, optionally writes JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--duration", type=float, default=20.0)
    parser.add_argument("--trajectory", default="excite")
    parser.add_argument("--flights", type=int, default=3)
    parser.add_argument("--json", help="write the numbers to this file")
    arguments = parser.parse_args(argv)
    flights = [
        fly(duration=arguments.duration, trajectory=arguments.trajectory, seed=s) for s in range(arguments.flights)
    ]
    print("| flight | crazyem, share of a core | firmware_sim | received | lost | update median ms | p99 ms |")
    print("|---|---|---|---|---|---|---|")
    for number, f in enumerate(flights):
        print(
            f"| {number} | {100 * f['load']['crazyem']:.1f} % | {100 * f['load']['firmware_sim']:.1f} % "
            f"| {f['samples']['received']} | {f['samples']['lost']} | {f['update_ms']['median']:.3g} "
            f"| {f['update_ms']['p99']:.3g} |"
        )
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(flights, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
