"""Cold starts in closed loop over many seeds: how soon the estimates are right, and whether every drone stays up.

    python benchmarks/cold_start.py --seeds 100 --out cold_start          # 1200 flights, 3 s of processor time each
    python benchmarks/cold_start.py --seeds 100 --out cold_start --minutes 3     # a piece; run again to go on
    python benchmarks/cold_start.py --out cold_start --write-docs         # table and plot of docs/results/cold_start.md
    python benchmarks/cold_start.py --check docs/results/cold_start.json --seeds 1       # flown again: is it still so?

Every flight is one line of OUT/flights.jsonl, written when it has landed, so an interrupted study goes on where it was.
Lines of an older version of the code are flown again. The judging is done in benchmarks/cold_start_study.py.
"""

import argparse
import hashlib
import json
import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from cold_start_study import (
    BANDS,
    SENSORS,
    SETTLED_SECONDS,
    SMOOTH_SETTINGS,
    STEP_SETTINGS,
    ColdStart,
    Settling,
    cold_start,
    summarise,
)

from crazyem.paper.runner import code_of
from crazyem.paper.settings import LITERAL

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs" / "results"
MARKS = ("<!-- cold start: table -->", "<!-- /cold start -->")
STARTS = {"air": False, "floor": True}
REFERENCES = {"smooth": SMOOTH_SETTINGS, "steps": STEP_SETTINGS, "literal": LITERAL}
SERIES = ("time", "ratio", "heights")
SHOWN = 5.0  # s of the series that are kept
Kind = tuple[str, str, str]  # start, reference, sensor


def version() -> str:
    """A hash of the settings and of all code that a flight depends on, without comments and docstrings."""
    digest = hashlib.sha256(repr([astuple(settings) for settings in REFERENCES.values()]).encode())
    digest.update(code_of(Path(__file__).with_name("cold_start_study.py")).encode())
    of_paper = ("bound", "flight", "plant", "product", "settings")
    for folder in ("paper", "estimation", "control", "physics"):
        for path in sorted((ROOT / "crazyem" / folder).rglob("*.py")):
            if folder != "paper" or path.stem in of_paper:
                digest.update(code_of(path).encode())
    return digest.hexdigest()[:16]


# lines of the study <-> flights -----------------------------------------------------------------------------------


def line_of(flight: ColdStart, *, reference: str, code: str) -> dict[str, Any]:
    """A flight as a line of the file: the record, and its series thinned and rounded."""
    kept = flight.time <= SHOWN
    rows = slice(0, round(SHOWN / SMOOTH_SETTINGS.dt) + 1, 4)
    return {
        "code": code,
        "reference": reference,
        **flight.to_json(),
        "time": np.round(flight.time[kept], 4).tolist(),
        "ratio": np.round(flight.ratio[kept], 5).tolist(),
        "heights": np.round(flight.heights[rows], 4).tolist(),
    }


def flight_of(line: Mapping[str, Any]) -> ColdStart:
    """Inverse of `line_of`."""

    def number(value: float | None, missing: float) -> float:
        return missing if value is None else float(value)

    known = {k: v for k, v in line.items() if k not in ("code", "reference", "settling", *SERIES)}
    for name in ("lift_off", "left_floor"):
        known[name] = number(known[name], math.inf)
    for name in ("rms", "rms_known"):
        known[name] = number(known[name], math.nan)
    for name in ("bound", "over_bound"):
        known[name] = tuple(number(v, math.nan) for v in known[name])
    bands = {
        name: Settling(number(s["first"], math.inf), number(s["stays"], math.inf), s["leaves_later"])
        for name, s in line["settling"].items()
    }
    return ColdStart(**known, settling=bands, **{name: np.array(line[name]) for name in SERIES})


def read(path: Path, *, code: str | None = None) -> dict[tuple[Kind, int], ColdStart]:
    """Flights of a file by kind and seed; only those of one version of the code, if one is named."""
    found = {}
    for text in path.read_text().splitlines() if path.exists() else ():
        try:
            line = json.loads(text)
        except ValueError:
            continue  # an incomplete line: flown again
        if code is None or line["code"] == code:
            kind = ("floor" if line["ground"] else "air", line["reference"], line["sensor"])
            found[kind, int(line["seed"])] = flight_of(line)
    return found


# flying -----------------------------------------------------------------------------------------------------------


def once(kind: Kind, seed: int) -> ColdStart:
    """One flight."""
    start, reference, sensor = kind
    settings = REFERENCES[reference]
    return cold_start(seed, sensor, ground=STARTS[start], smooth=settings.smooth, settings=settings)


def fly(out: Path, kinds: Sequence[Kind], seeds: Sequence[int], *, seconds: float) -> bool:
    """Fly what is missing for at most `seconds`; True if nothing is missing any more."""
    out.mkdir(parents=True, exist_ok=True)
    path, code = out / "flights.jsonl", version()
    done = read(path, code=code)
    todo = [(kind, seed) for seed in seeds for kind in kinds if (kind, seed) not in done]
    begin = time.monotonic()
    with path.open("a") as file:
        for count, (kind, seed) in enumerate(todo):
            if time.monotonic() - begin > seconds:
                print(f"\n{len(todo) - count} flights to go")
                return False
            start, reference, sensor = kind
            flight = once(kind, seed)
            file.write(json.dumps(line_of(flight, reference=reference, code=code)) + "\n")
            file.flush()
            crash = ", CRASHED\n" if flight.crashed else "   "
            print(f"\r{count + 1} of {len(todo)}: seed {seed}, {start}, {reference}, sensor {sensor}{crash}", end="")
            sys.stdout.flush()
    print()
    return True


def summary(flights: Mapping[tuple[Kind, int], ColdStart]) -> dict[str, Any]:
    """Summary of all kinds of flights, with single numbers of the first seeds for the check."""
    kinds = sorted({kind for kind, _ in flights})
    groups = {kind: [f for (k, _), f in sorted(flights.items()) if k == kind] for kind in kinds}
    return {
        "seeds": {" ".join(k): sorted(f.seed for f in group) for k, group in groups.items()},
        "kinds": {" ".join(k): summarise(group) for k, group in groups.items()},
        "first": {" ".join(k): [f.to_json() for f in group[:2]] for k, group in groups.items()},
    }


# saying -----------------------------------------------------------------------------------------------------------


def table(said: Mapping[str, Any]) -> str:
    """The table of docs/results/cold_start.md in markdown, from a summary; the JSON file has more."""
    lines = _head(
        "start, reference, sensor", "crashed", "mass within 5 % [s]", "within 1 % [s]", "inertia within 25 % [s]",
        "rms over known", "sag [mm]",
    )  # fmt: skip
    for kind, s in said["kinds"].items():
        cells = [", ".join(kind.split()), str(len(s["crashed"]))]
        cells += [_two(s[name]["stays"], "{:.3f}") for name in BANDS]
        cells += [_two(s["tracking_ratio"], "{:.3f}"), _two(s["sag"], "{:.0f}", 1e3)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _head(*names: str) -> list[str]:
    return [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]


def _two(spread: Mapping[str, float | None], form: str, scale: float = 1.0) -> str:
    """Median and worst."""
    values = (spread[k] for k in ("median", "worst"))
    return ", ".join("never" if v is None else form.format(v * scale) for v in values)


def put_table(page: str, text: str) -> str:
    """The page with its marked block replaced."""
    before, rest = page.split(MARKS[0])
    return f"{before}{MARKS[0]}\n\n{text}\n\n{MARKS[1]}{rest.split(MARKS[1])[1]}"


def plot(path: Path, flights: Mapping[tuple[Kind, int], ColdStart], *, sensor: str, reference: str) -> None:
    """Plot convergence and height of all flights with one sensor and reference, from the air and from the floor."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = [("mass", 0, 0.5), ("Ixx", 1, SETTLED_SECONDS), ("Iyy", 2, SETTLED_SECONDS), ("Izz", 3, SETTLED_SECONDS)]
    with matplotlib.rc_context({"font.size": 8}):
        figure = Figure(figsize=(10, 10), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(5, 2)
        for column, start in enumerate(STARTS):
            group = [f for (kind, _), f in sorted(flights.items()) if kind == (start, reference, sensor)]
            where = "in the air" if start == "air" else "on the floor"
            axes[0, column].set_title(f"{len(group)} cold starts {where}, sensor {sensor}, {reference} reference")
            for row, (name, index, until) in enumerate(panels):
                axis = axes[row, column]
                for f in group:
                    axis.step(f.time, f.ratio[:, index], "C0", where="post", linewidth=0.4, alpha=0.5)
                width = 0.05 if index == 0 else 0.25
                axis.axhspan(1 - width, 1 + width, color="C2", alpha=0.15, linewidth=0)
                axis.set(xlim=(0.0, until), ylim=(0.0, 2.0), ylabel=f"{name} / true")
            for f in group:
                axes[4, column].plot(np.arange(len(f.heights)) * 0.02, f.heights, "C1", linewidth=0.4, alpha=0.5)
            axes[4, column].set(
                xlim=(0.0, 1.5), ylim=(-0.3, 1.5), ylabel="height [m]", xlabel="time after take-over [s]"
            )
        for axis in axes.flat:
            axis.grid(alpha=0.3)
        figure.savefig(path, dpi=90)


def write_docs(out: Path) -> None:
    """Write summary, plot and table of docs/results/cold_start.md from the flights of the present code."""
    flights = read(out / "flights.jsonl", code=version())
    if not flights:
        sys.exit(f"{out} holds no flights of this version of the code")
    said = {"code": version(), **summary(flights)}
    (DOCS / "cold_start.json").write_text(json.dumps(said, indent=1) + "\n")
    plot(DOCS / "cold_start.png", flights, sensor="C", reference="smooth")
    page = DOCS / "cold_start.md"
    page.write_text(put_table(page.read_text(), table(said)))


def differences(said: Mapping[str, Any], seeds: int) -> Iterator[str]:
    """Sentences on differences from the stored summary, for the first seeds of each kind (at most two)."""
    for kind, stored in said["first"].items():
        start, reference, sensor = kind.split()
        for old in stored[:seeds]:
            new = once((start, reference, sensor), old["seed"]).to_json()
            where = f"{kind}, seed {old['seed']}"
            if new["crashed"] != old["crashed"]:
                yield f"{where}: crashed {new['crashed']}, was {old['crashed']}"
            for name, was in old["settling"].items():
                a, b = ((math.inf if s["stays"] is None else s["stays"]) for s in (new["settling"][name], was))
                if a != b and not abs(a - b) < 0.021:  # one update
                    yield f"{where}: {name} from {a} s on, was {b} s"
            for name, width in (("rms", 0.01), ("rms_known", 1e-4)):
                if not math.isclose(new[name], old[name], rel_tol=width):
                    yield f"{where}: {name} {new[name]}, was {old[name]}"


def main(argv: Sequence[str] | None = None) -> int:
    """Fly, print, write; 1 if a flight crashed or the check found a difference."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2, metavar="N", help="flights of each kind (default: 2)")
    parser.add_argument("--sensor", choices=tuple(SENSORS), action="append", help="default: all")
    parser.add_argument("--start", choices=tuple(STARTS), action="append", help="default: both")
    parser.add_argument("--reference", choices=tuple(REFERENCES), action="append", help="default: smooth, steps")
    parser.add_argument("--minutes", type=float, default=math.inf, metavar="M", help="stop after M; run again to go on")
    parser.add_argument("--out", type=Path, default=Path("cold_start"), metavar="DIR", help="default: ./cold_start")
    parser.add_argument("--write-docs", action="store_true", help="only write the docs from what is in DIR")
    parser.add_argument("--check", type=Path, metavar="JSON", help="only fly the first seeds of a summary again")
    given = parser.parse_args(argv)
    if given.seeds < 1:
        parser.error("--seeds must be positive")
    if given.check:
        found = list(differences(json.loads(given.check.read_text()), given.seeds))
        print("\n".join(found) or "as stored")
        return int(bool(found))
    if given.write_docs:
        write_docs(given.out)
        return 0
    kinds = list(product(given.start or STARTS, given.reference or ("smooth", "steps"), given.sensor or SENSORS))
    fly(given.out, kinds, range(given.seeds), seconds=60 * given.minutes)
    said = summary(read(given.out / "flights.jsonl", code=version()))
    (given.out / "summary.json").write_text(json.dumps(said, indent=1) + "\n")
    print(table(said))
    return int(any(s["crashed"] for s in said["kinds"].values()))


if __name__ == "__main__":
    sys.exit(main())
