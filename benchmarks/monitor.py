"""The monitor on flights of random worlds: false alarms per hour, and faults drawn at random, named or not, how late.

    python -m benchmarks.monitor run --undisturbed 600 --faulty 100 --out out/monitor   # 10 h, 300 faults
    python -m benchmarks.monitor score --out out/monitor --docs                         # docs: results/monitor.md

Goes on where it stopped. A flight is flown in this process, faster than real time; estimator and monitor are those of a
session. Beside it a residual detector: the mean innovation of 0.2 s of vertical velocity and body rates over a band, as
wide as gives as many false alarms in the undisturbed flights.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.monitor_flight import FAULTS, draw, samples
from crazyem.estimation.steps import estimator_for
from crazyem.live.flight_monitor import FlightMonitor
from crazyem.live.policy import FaultRules
from crazyem.monitoring.fault import Fault
from crazyem.physics import folding

UNDISTURBED_SECONDS, FAULTS_EACH = 60.0, 3  # s of trajectory; faults of a flight with faults
FAULTY_SECONDS = 64.0  # s of trajectory
SPAN = 18  # innovations in a residual: 0.2 s
CHANNELS = (5, 9, 10, 11)  # vertical velocity, body rates
WITHIN = 3.0  # s after the onset of a fault in which a report counts for this fault
APART = 10.0  # s; alarms within this time count once
DOCS = Path(__file__).resolve().parents[1] / "docs" / "results" / "monitor.md"
MARKS = ("<!-- monitor: table -->", "<!-- /monitor -->")


def fly(seed: int, faults: int, kinds: Sequence[str] = tuple(FAULTS)) -> dict[str, Any]:
    """One flight: its faults, reports and residuals."""
    seconds = FAULTY_SECONDS if faults else UNDISTURBED_SECONDS
    world = draw(seed, kinds=kinds, faults=faults)
    vehicle, _ = folding.fold(world.vehicle)
    reports: list[Fault] = []
    monitor = FlightMonitor(vehicle, FaultRules(), on_fault=reports.append)
    estimator = estimator_for(vehicle)
    monitor.watch(estimator)
    cost, residuals = [0.0, 0], [(0.0, 0.0, 0.0, 0.0, 0.0)]
    inner, recent = estimator.inner, np.zeros((0, len(CHANNELS)))
    watched = inner.on_filtered
    assert watched is not None

    def on_filtered(em: Any, p: Any, first: int, last: int, sd: Any) -> None:
        nonlocal recent
        begin = time.process_time()
        watched(em, p, first, last, sd)
        cost[0], cost[1] = cost[0] + time.process_time() - begin, cost[1] + 1
        recent = np.concatenate([recent, em.tape.e[first:last][:, CHANNELS]])[-SPAN:]
        residuals.append((float(em.tape.time[last - 1]), *np.abs(recent.mean(0)).tolist()))

    inner.on_filtered = on_filtered
    end = begun = math.nan
    for sample in samples(world, duration=seconds):
        monitor.take(sample, airborne=estimator.airborne)
        estimator.feed(sample)
        end = sample.time
        begun = end if estimator.airborne and math.isnan(begun) else begun
    return {
        "seed": seed,
        "style": world.style,
        "gusts": world.gusts,
        "airborne_s": end - begun,
        "end": end,
        "events": [[e.kind, list(e.expected), e.time, e.size] for e in world.events],
        "reports": [{**r.to_json(), "name": r.name} for r in reports],
        "residuals": np.round(residuals[:: max(1, len(residuals) // 2000)], 5).tolist(),
        "monitor_ms": 1e3 * cost[0] / max(cost[1], 1),
        "update_ms": 1e3 * float(np.mean(estimator.update_seconds)),
    }


def run(
    folder: Path, undisturbed: int, faulty: int, first: int, minutes: float, kinds: Sequence[str] = tuple(FAULTS)
) -> None:
    """Fly the missing flights."""
    folder.mkdir(parents=True, exist_ok=True)
    until = time.monotonic() + 60.0 * minutes
    wanted = [(f"u{s}", s, 0) for s in range(first, first + undisturbed)]
    wanted += [(f"f{s}", 100_000 + s, FAULTS_EACH) for s in range(first, first + faulty)]
    for name, seed, faults in wanted:
        place = folder / f"{name}.json"
        if place.exists() or time.monotonic() > until:
            continue
        result = fly(seed, faults, kinds)
        place.write_text(json.dumps(result), encoding="utf-8")
        print(f"{name} {result['style']}: {[r['name'] for r in result['reports'] if not r['settled']]}", flush=True)


def alarms(times: Sequence[float], events: Sequence[Any]) -> list[float]:
    """Reports that neither onset nor end of a fault explains, one for each stretch of `APART`."""
    out: list[float] = []
    for t in times:
        explained = any(e[2] - 0.1 <= t < e[2] + (APART if e[0] == "" else 6.0 + APART) for e in events)
        if not explained and (not out or t - out[-1] > APART):
            out.append(t)
    return out


def rate_interval(count: int, hours: float) -> tuple[float, float]:
    """95 % interval of a Poisson rate per hour."""
    low = 0.0 if count == 0 else float(chi2.ppf(0.025, 2 * count)) / 2
    return low / hours, float(chi2.ppf(0.975, 2 * count + 2)) / 2 / hours


def crossings(flight: dict[str, Any], bands: NDArray[np.float64]) -> list[float]:
    """Times at which a residual exceeds its band, from the start of the monitor's tests on."""
    table = np.array(flight["residuals"])
    table = table[table[:, 0] > flight["end"] - flight["airborne_s"] + 3.0]
    return table[(table[:, 1:] > bands).any(1), 0].tolist()  # type: ignore[no-any-return]


def bands_for(flights: Sequence[dict[str, Any]], wanted: int) -> NDArray[np.float64]:
    """Bands that give no more than `wanted` false alarms: a multiple of the mean squares of all undisturbed flights."""
    rms = np.sqrt(np.mean([np.mean(np.square(np.array(f["residuals"])[:, 1:]), 0) for f in flights], 0))
    for multiple in np.geomspace(3.0, 300.0, 200):
        if sum(len(alarms(crossings(f, multiple * rms), [])) for f in flights) <= wanted:
            break
    return np.asarray(multiple * rms)


def score(folder: Path) -> dict[str, Any]:
    """False alarms, and a row for each kind of fault."""
    flights = [json.loads(p.read_text(encoding="utf-8")) for p in sorted(folder.glob("*.json"))]
    quiet = [f for f in flights if not f["events"]]
    hours = sum(f["airborne_s"] for f in quiet) / 3600.0
    false = [a for f in quiet for a in alarms([r["detected"] for r in f["reports"]], [])]
    bands = bands_for(quiet, len(false)) if quiet else np.full(len(CHANNELS), math.inf)
    rows: dict[str, list[dict[str, Any]]] = {}
    for f in flights:
        for kind, expected, onset, size in f["events"]:
            if not kind or onset > f["end"] - 1.0:
                continue
            mine = [r for r in f["reports"] if onset - 0.1 <= r["detected"] < onset + WITHIN]
            before = any(onset - APART < r["detected"] < onset - 0.1 for r in f["reports"])
            first = next((r for r in mine if not r["settled"] or not r["sizes"]), None)
            named = next((r for r in reversed(mine[:2])), None)
            late = next((t for t in crossings(f, bands) if t >= onset), math.inf) - onset
            value = next(iter(named["sizes"].values()))["value"] if named and named["sizes"] else math.nan
            rows.setdefault(kind, []).append({
                "delay": first["detected"] - onset if first else math.inf,
                "named": bool(named and named["name"] in expected),
                "first_named": bool(first and first["name"] in expected),
                "error": value - size if size else math.nan,
                "residual": late if late < WITHIN else math.inf,
                "before": before,
            })  # fmt: skip
    return {
        "hours": hours,
        "flights": len(quiet),
        "false_alarms": len(false),
        "rate": len(false) / max(hours, 1e-9),
        "interval": rate_interval(len(false), max(hours, 1e-9)),
        "monitor_ms": float(np.median([f["monitor_ms"] for f in flights])),
        "update_ms": float(np.median([f["update_ms"] for f in flights])),
        "kinds": rows,
    }


def page(table: dict[str, Any]) -> str:
    """The table of docs/results/monitor.md."""
    low, high = table["interval"]
    columns = ("fault", "n", "found", "delay", "90 %", "named", "settled", "error", "band", "delay")
    lines = [
        f"undisturbed: {table['flights']} flights, {table['hours']:.2f} h in the air, {table['false_alarms']} false "
        f"alarms: {table['rate']:.2f} an hour [{low:.2f}, {high:.2f}]",
        f"cost: {table['monitor_ms']:.2f} ms an update, of the estimator {table['update_ms']:.2f} ms",
        "",
        "{:<24}{:>4}{:>7}{:>7}{:>7}{:>7}{:>9}{:>7}{:>7}{:>7}".format(*columns),
    ]
    for kind in FAULTS:
        rows = table["kinds"].get(kind, [])
        if not rows:
            continue
        delays, others = (np.array([r[key] for r in rows]) for key in ("delay", "residual"))
        errors = np.abs([r["error"] for r in rows if r["named"] and math.isfinite(r["error"])])
        found, first, named = (
            np.isfinite(delays).sum(),
            sum(r["first_named"] for r in rows),
            sum(r["named"] for r in rows),
        )
        error = f"{np.median(errors):.3f}" if len(errors) else "-"
        lines.append(
            f"{kind:<24}{len(rows):>4}{found:>7}{_quantile(delays, 0.5):>7}{_quantile(delays, 0.9):>7}{first:>7}"
            f"{named:>9}{error:>7}{np.isfinite(others).sum():>7}{_quantile(others, 0.5):>7}"
        )
    return "\n".join(["```text", *lines, "```"])


def _quantile(values: NDArray[np.float64], share: float) -> str:
    at = sorted(values)[min(int(share * len(values)), len(values) - 1)]
    return f"{at:.2f}" if math.isfinite(at) else "-"


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.monitor", description=__doc__)
    parser.add_argument("step", choices=("run", "score"))
    parser.add_argument("--out", type=Path, required=True, help="folder of the flights")
    parser.add_argument("--undisturbed", type=int, default=600, help="flights of a minute (default %(default)s)")
    parser.add_argument("--faulty", type=int, default=100, help="flights with 3 faults each (default %(default)s)")
    parser.add_argument("--first", type=int, default=1000, help="seed (default %(default)s)")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after that; run again to go on")
    parser.add_argument("--kind", action="append", choices=tuple(FAULTS), help="faults to draw from (default: all)")
    parser.add_argument("--docs", action="store_true", help="with score: write docs/results/monitor.md")
    a = parser.parse_args(argv)
    if a.step == "run":
        run(a.out, a.undisturbed, a.faulty, a.first, a.minutes, a.kind or tuple(FAULTS))
    text = page(score(a.out))
    print(text)
    if a.docs:
        head, rest = DOCS.read_text(encoding="utf-8").split(MARKS[0])
        DOCS.write_text(f"{head}{MARKS[0]}\n\n{text}\n\n{MARKS[1]}{rest.split(MARKS[1])[1]}", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
