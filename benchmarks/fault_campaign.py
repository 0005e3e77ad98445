"""Flights under seeded faults, with and without guard, monitor and writes: what crashes, what goes unrecorded.

    python -m benchmarks.fault_campaign run --flights 500 --arms guarded --out out/faults    # goes on where it stopped
    python -m benchmarks.fault_campaign run --flights 100 --arms none monitored unguarded --out out/faults
    python -m benchmarks.fault_campaign score --out out/faults --docs                        # docs: fault_campaign.md

A crash counts as caused by a write if the same seed without writes did not crash; where a guarded flight crashed, the
same seed is flown without writes as well. One process flies many, one after the other; a flight over its limit of wall
time is a hang: the process is killed and another one goes on.
"""

import argparse
import contextlib
import dataclasses
import json
import math
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

LIMIT = 120.0  # s of wall time for one flight
START = 180.0  # s more for the first flight of a process, which may compile
OF_A_PROCESS = 40  # flights of a process; then a new one starts
ARMS = ("none", "guarded", "monitored", "unguarded")  # monitored: guarded, with the monitor of faults
DOCS = Path(__file__).resolve().parents[1] / "docs" / "results"
MARKS = ("<!-- faults: table -->", "<!-- /faults -->")


class Pilot:
    """A process that flies the requested flights one after the other."""

    def __init__(self, folder: Path, speed: float, later: float) -> None:
        command = [sys.executable, "-m", "benchmarks.fault_campaign", "pilot", "--out", str(folder)]
        self._child = subprocess.Popen(
            [*command, "--speed", str(speed), "--later", str(later)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=(folder / "pilot.log").open("a"),
            text=True,
            start_new_session=True,
        )
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()
        self.flown = 0

    def _read(self) -> None:
        assert self._child.stdout is not None
        for line in self._child.stdout:
            self._lines.put(line)
        self._lines.put("")

    def fly(self, seed: int, arm: str) -> dict[str, Any]:
        """The result of one flight, or the failure of the process, which is then not `usable`."""
        begun, failed = time.monotonic(), {"seed": seed, "arm": arm, "kinds": []}
        limit = LIMIT if self.flown else LIMIT + START
        self.flown += 1
        try:
            assert self._child.stdin is not None
            self._child.stdin.write(f"{seed} {arm}\n")
            self._child.stdin.flush()
            return dict(json.loads(self._lines.get(timeout=limit)))
        except queue.Empty:
            self.close()
            return {**failed, "hang": True, "seconds": time.monotonic() - begun}
        except (OSError, ValueError):
            self.close()
            return {**failed, "fault_of_ours": f"the process ended with {self._child.returncode}"}

    @property
    def usable(self) -> bool:
        """Whether the process can fly another flight."""
        return self._child.poll() is None and self.flown < OF_A_PROCESS

    def close(self) -> None:
        """End the process."""
        if self._child.poll() is None:
            os.killpg(self._child.pid, signal.SIGKILL)
        self._child.wait()


def run(
    folder: Path, *, flights: int, first: int, arms: Sequence[str], speed: float, minutes: float, later: float = 0.0
) -> int:
    """Fly the missing flights; returns their number."""
    folder.mkdir(parents=True, exist_ok=True)
    until, done, pilot = time.monotonic() + 60.0 * minutes, 0, None
    try:
        for seed, arm in _wanted(folder, range(first, first + flights), arms):
            if time.monotonic() > until:
                break
            if pilot is None or not pilot.usable:
                if pilot is not None:
                    pilot.close()
                pilot = Pilot(folder, speed, later)
            result = pilot.fly(seed, arm)
            place = folder / f"{seed}_{arm}.json"
            temporary = place.with_suffix(".part")
            temporary.write_text(json.dumps(result), encoding="utf-8")
            temporary.replace(place)
            done += 1
            what = result.get("crashed") or result.get("error") or result.get("fault_of_ours") or "landed"
            print(f"{seed} {arm}: {', '.join(result['kinds'])}: {'hang' if result.get('hang') else what}", flush=True)
    finally:
        if pilot is not None:
            pilot.close()
    return done


def _wanted(folder: Path, seeds: Sequence[int], arms: Sequence[str]) -> Iterator[tuple[int, str]]:
    """Missing flights; for each crash with writes also the same flight without."""
    for seed in seeds:
        for arm in sorted(arms, key=ARMS.index):
            place = folder / f"{seed}_{arm}.json"
            if not place.exists():
                yield seed, arm
            crashed = place.exists() and json.loads(place.read_text(encoding="utf-8")).get("crashed")
            if crashed and not (folder / f"{seed}_none.json").exists():
                yield seed, "none"


def pilot(folder: Path, speed: float, later: float) -> int:
    """In the child: fly the flights read from standard input; prints a line of JSON for each."""
    from benchmarks.fault_flight import fly

    out = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):
        for line in sys.stdin:
            seed, arm = line.split()
            try:
                result = dataclasses.asdict(fly(int(seed), arm, folder, speed=speed, later=later))
            except Exception as error:  # the campaign goes on and reports the error
                result = {"seed": int(seed), "arm": arm, "kinds": [], "fault_of_ours": repr(error)}
            cleaned = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in result.items()}
            print(json.dumps(cleaned), file=out, flush=True)
    return 0


def score(folder: Path) -> dict[str, Any]:
    """The campaign's table."""
    results = [json.loads(p.read_text(encoding="utf-8")) for p in sorted(folder.glob("*_*.json"))]
    by = {(r["seed"], r["arm"]): r for r in results}
    table: dict[str, Any] = {}
    for arm in ARMS:
        rows = [r for r in results if r["arm"] == arm]
        paired = [r for r in rows if (r["seed"], "none") in by]
        caused = [r for r in paired if r.get("crashed") and r.get("writes") != 0]
        caused = [r for r in caused if not by[r["seed"], "none"].get("crashed")]
        errors = sorted(abs(r["mass_error"]) for r in rows if r.get("mass_error") is not None)
        table[arm] = {
            "flights": len(rows),
            "crashed": sum(bool(r.get("crashed")) for r in rows),
            "crashed_because_of_a_write": len(caused),
            "seeds_of_those": [r["seed"] for r in caused],
            "hangs": sum(bool(r.get("hang")) for r in rows),
            "faults_of_ours": [f"{r['seed']}: {r['fault_of_ours']}" for r in rows if r.get("fault_of_ours")],
            "writes": sum(r.get("writes") or 0 for r in rows),
            "different_writes_seen": sum(r.get("left") or 0 for r in rows),
            "unrecorded_writes": sum(r.get("unrecorded") or 0 for r in rows),
            "flights_with_writes": sum(bool(r.get("writes")) for r in rows),
            "flights_with_reverts": sum("revert" in (r.get("purposes") or {}) for r in rows),
            "flights_with_undone_sets": sum("undo" in (r.get("purposes") or {}) for r in rows),
            "median_last_mass_error": errors[len(errors) // 2] if errors else None,
            "largest_last_mass_error": errors[-1] if errors else None,
            "flights_with_reports": sum(bool(r.get("reports")) for r in rows),
            "failures": sum(bool(r.get("fault_of_ours")) for r in rows),
            "processor_s": _median([r["processor_s"] for r in rows if r.get("processor_s")]),
            "faults": dict(Counter(k for r in rows for k in r["kinds"])),
            "fell": dict(Counter(k for r in rows if r.get("crashed") for k in r["kinds"])),
        }
    return table


def _median(values: Sequence[float]) -> float | None:
    return round(sorted(values)[len(values) // 2], 2) if values else None


ROWS = (
    ("flights", "flights"),
    ("crashed", "crashed"),
    ("crashed_because_of_a_write", "crashed, and not without writes"),
    ("failures", "ended by an error of crazyem's own"),
    ("flights_with_writes", "flights in which anything was written"),
    ("writes", "parameter writes"),
    ("unrecorded_writes", "writes that left and are not in the recording"),
    ("flights_with_reverts", "flights in which values were taken back"),
    ("flights_with_reports", "flights with reports of the monitor"),
    ("flights_with_undone_sets", "flights in which half a set was undone"),
    ("median_last_mass_error", "last mass written, median error, %"),
    ("largest_last_mass_error", "largest, %"),
)


def page(table: dict[str, Any]) -> str:
    """The tables of docs/results/fault_campaign.md."""
    names = {"guarded": "guard", "monitored": "guard, monitor", "unguarded": "no guard", "none": "no writes"}
    lines = [f"| | {' | '.join(names.values())} |", "|---" * (1 + len(names)) + "|"]
    for key, label in ROWS:
        values = [table[arm][key] for arm in names]
        if key.endswith("mass_error"):
            values = ["-" if v is None else f"{100 * v:.1f}" for v in values]
        lines.append(f"| {label} | {' | '.join('-' if v is None else str(v) for v in values)} |")
    for arm, what in (
        ("guarded", "With the guard"),
        ("monitored", "With guard and monitor"),
        ("unguarded", "Without both"),
    ):
        seeds = ", ".join(map(str, table[arm]["seeds_of_those"]))
        lines += ["", f"{what}, seeds that crashed and did not without writes: {seeds or 'none'}."]
    return "\n".join(lines)


def write_docs(table: dict[str, Any]) -> None:
    """The tables into docs/results/fault_campaign.md."""
    place = DOCS / "fault_campaign.md"
    head, rest = place.read_text(encoding="utf-8").split(MARKS[0])
    tail = rest.split(MARKS[1])[1]
    place.write_text(f"{head}{MARKS[0]}\n\n{page(table)}\n\n{MARKS[1]}{tail}", encoding="utf-8")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fault_campaign", description=__doc__)
    parser.add_argument("step", choices=("run", "score", "pilot"))
    parser.add_argument("--out", type=Path, required=True, help="folder of the campaign")
    parser.add_argument("--flights", type=int, default=500, help="seeds (default %(default)s)")
    parser.add_argument("--first", type=int, default=1, help="seed (default %(default)s)")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS), help="default: all")
    parser.add_argument("--speed", type=float, default=3.0, help="of the simulator (default %(default)s)")
    parser.add_argument(
        "--later", type=float, default=0.0,
        help="s by which faults come later and flights are longer; the monitor tests from 8 s in the air on",
    )  # fmt: skip
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after that; run again to go on")
    parser.add_argument("--docs", action="store_true", help="with score: write docs/results/fault_campaign.md")
    a = parser.parse_args(argv)
    if a.step == "pilot":
        return pilot(a.out, a.speed, a.later)
    if a.step == "run":
        run(
            a.out, flights=a.flights, first=a.first, arms=a.arms, speed=a.speed, minutes=a.minutes, later=a.later
        )  # fmt: skip
    table = score(a.out)
    print(json.dumps(table, indent=2))
    if a.docs:
        write_docs(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
