"""The first flight over many seeds: how wrong, how honest, and what the pushes do to the height. Truth is typed here.

    python benchmarks/first_flight.py --seeds 20                 # real time: about 35 s for each excite flight
    python benchmarks/first_flight.py --seeds 20 --speed 2 --trajectory excite --json first_flight.json

Every flight is the command line's own (`crazyem fly`, simulated firmware in a process of its own), so what is measured
is what a user gets: the wire, the losses, the threads and the pushes included. A busy machine delays setpoints, so
nothing else should run; the host's load is printed with the result.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SCENARIO = ROOT / "firmware_sim" / "scenarios" / "payload.toml"
TRUTH = {"mass": 0.036, "Ixx": 2.0e-5, "Iyy": 2.1e-5, "Izz": 3.6e-5, "motor_time_constant": 0.060}
DURATION = {"excite": 20.0, "hover": 20.0}  # s


def fly(seed: int, *, trajectory: str, duration: float, speed: float, folder: Path) -> dict[str, Any]:
    """One flight's summary, as `crazyem fly --json` writes it.

    Args:
        seed: of the simulator's noise.
        duration: of the trajectory, s.
        speed: firmware seconds per second.

    Raises:
        RuntimeError: the flight ended with an error; the message is its own sentence.
    """
    out = folder / f"{trajectory}-{seed}.json"
    command = [sys.executable, "-m", "crazyem", "fly", "--scenario", str(SCENARIO), "--trajectory", trajectory]
    command += ["--duration", f"{duration:g}", "--speed", f"{speed:g}", "--seed", str(seed), "--json", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    if done.returncode:
        raise RuntimeError(f"seed {seed}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    return dict(json.loads(out.read_text()))


def table(flights: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """For each parameter: worst and rms relative error, coverage, median relative half width, identifiable flights."""
    rows = {}
    for name, truth in TRUTH.items():
        estimates = [f["estimates"][name] for f in flights]
        errors = [e["value"] / truth - 1 for e in estimates]
        # A side that JSON gives as null is unbounded.
        sides = [(-math.inf if e["ci95"][0] is None else e["ci95"][0],
                  math.inf if e["ci95"][1] is None else e["ci95"][1]) for e in estimates]  # fmt: skip
        widths = sorted((high - low) / 2 / truth for low, high in sides)
        rows[name] = {
            "worst": max(map(abs, errors)),
            "rms": math.sqrt(sum(e * e for e in errors) / len(errors)),
            "mean": sum(errors) / len(errors),
            "covered": sum(low <= truth <= high for low, high in sides),
            "half_width": widths[len(widths) // 2],
            "identifiable": sum(bool(e["identifiable"]) for e in estimates),
        }
    return rows


def heights(flights: Sequence[Mapping[str, Any]]) -> dict[str, list[float | None]]:
    """Mean height error of every flight before the first push and after it has settled, m."""
    return {when: [f["height_error_m"][when] for f in flights] for when in ("before_push", "after_push")}


def show(trajectory: str, flights: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Print the table of one trajectory; returns it for the JSON."""
    n, rows = len(flights), table(flights)
    print(f"\n{trajectory}: {n} flights")
    print(f"{'parameter':<20} {'worst':>8} {'rms':>8} {'mean':>8} {'+-95 %':>8} {'covered':>9} {'identifiable':>13}")
    for name, r in rows.items():
        percent = "".join(f" {100 * r[k]:>6.2f} %" for k in ("worst", "rms", "mean", "half_width"))
        print(f"{name:<20}{percent} {r['covered']:>4.0f} of {n:<2} {r['identifiable']:>8.0f} of {n}")
    spread = heights(flights)
    for when, values in spread.items():
        known = [v for v in values if v is not None]
        if known:
            worst = max(known, key=abs)
            mean = sum(known) / len(known)
            print(f"height error {when:<12} mean {mean:+.3f} m, largest {worst:+.3f} m ({len(known)} flights)")
    pushes = [p for f in flights for p in f["pushes"]]
    verified = sum(p["verified"] for p in pushes)
    received, lost = (sum(f["samples"][k] for f in flights) for k in ("received", "lost"))
    print(f"pushes: {len(pushes)}, verified {verified}; packets: {received} received, {lost} lost")
    return {
        "flights": n,
        "parameters": rows,
        "height_error_m": spread,
        "pushes": {"written": len(pushes), "verified": verified},
        "samples": {"received": received, "lost": lost},
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Fly, print, write; 1 if a flight failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, metavar="N", help="flights per trajectory (default: 20)")
    parser.add_argument("--first-seed", type=int, default=0, metavar="N", help="the others follow it (default: 0)")
    parser.add_argument("--trajectory", choices=tuple(DURATION), action="append", help="default: excite and hover")
    parser.add_argument("--duration", type=float, metavar="S", help="of the trajectory (default: 20)")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="times real time (default: 1)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="flights at a time (default: 1)")
    parser.add_argument("--json", metavar="FILE", help="the tables, for programs")
    given = parser.parse_args(argv)
    if given.seeds < 1 or given.jobs < 1:
        parser.error("--seeds and --jobs must be positive")
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    result: dict[str, Any] = {"seeds": list(seeds), "speed": given.speed, "truth": TRUTH, "trajectories": {}}
    print(f"seeds {seeds[0]} to {seeds[-1]}, speed {given.speed:g}, jobs {given.jobs}, {os.cpu_count()} cores, "
          f"load {os.getloadavg()[0]:.1f}", flush=True)  # fmt: skip
    failed = []
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(given.jobs) as pool:
        for trajectory in given.trajectory or DURATION:
            duration = given.duration or DURATION[trajectory]
            tasks = [
                pool.submit(fly, s, trajectory=trajectory, duration=duration, speed=given.speed, folder=Path(folder))
                for s in seeds
            ]
            flights = []
            for task in tasks:
                try:
                    flights.append(task.result())
                    m = flights[-1]["estimates"]["mass"]
                    print(f"  {trajectory} {len(flights)}: mass {1e3 * m['value']:.3f} g", file=sys.stderr, flush=True)
                except RuntimeError as error:
                    failed.append(str(error))
                    print(error, file=sys.stderr)
            if flights:
                result["trajectories"][trajectory] = show(trajectory, flights)
    result["failed"] = failed
    if given.json:
        Path(given.json).write_text(json.dumps(result, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
