"""The product's estimator against the Cramer-Rao bound on the paper's flights: figures of docs: paper_accuracy.md.

    python benchmarks/paper_accuracy.py --seeds 48                       # every part, an hour and a half on one core
    python benchmarks/paper_accuracy.py --part windows --sensor C --seeds 8
    python benchmarks/paper_accuracy.py --seeds 48 --docs                # nothing left to do: writes the docs

Finished flights are kept (`--records`), so a run that was broken off goes on where it was. Records are of the code that
made them: remove the file after a change of the estimator.
"""

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from accuracy_study import PARTS, Record, missed, study, summary, table

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs" / "results" / "paper_accuracy.md"
RESULTS = ROOT / "docs" / "results" / "paper_accuracy.json"
KEPT = 1  # flights of each part whose records are kept in the results, for the drift check


def load(path: Path) -> dict[tuple[str, str, int], list[Record]]:
    """Records of a file of JSON lines by part, sensor and seed; an incomplete last line is dropped."""
    found: dict[tuple[str, str, int], list[Record]] = {}
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            rows = [record(row) for row in json.loads(line)]
        except (ValueError, TypeError):
            continue
        if rows:
            found[rows[0].part, rows[0].sensor, rows[0].seed] = rows
    return found


def record(row: Mapping[str, Any]) -> Record:
    """A record from its JSON row."""
    return Record(**{k: tuple(v) if isinstance(v, list) else v for k, v in row.items()})


def run(parts: Sequence[str], sensors: str, seeds: range, path: Path, *, limit: float) -> bool:
    """Fly and estimate the missing flights, one line for each; False if `limit` s were not enough."""
    done = load(path)
    wanted = [(p, s, k) for k in seeds for p in parts for s in PARTS[p].sensors if s in sensors]
    wanted = [key for key in wanted if key not in done]
    begin = time.monotonic()
    for count, key in enumerate(wanted):
        if time.monotonic() - begin > limit:
            print(f"\n{len(wanted) - count} left", file=sys.stderr)
            return False
        rows = study(*key)
        with path.open("a") as file:
            file.write(json.dumps([asdict(row) for row in rows]) + "\n")
        print(f"\r{count + 1} of {len(wanted)}: {' '.join(map(str, key))}   ", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return True


def results(path: Path) -> dict[str, Any]:
    """Summaries by part and sensor, the aims they miss, and the first flights' records."""
    done = load(path)
    out: dict[str, Any] = {}
    for part, spec in PARTS.items():
        for sensor in spec.sensors:
            rows = [r for key, records in done.items() if key[:2] == (part, sensor) for r in records]
            if not rows:
                continue
            figures = summary(rows)
            first = [asdict(r) for r in rows if r.seed < KEPT]
            out.setdefault(part, {})[sensor] = {**figures, "missed": missed(part, sensor, figures), "records": first}
    return out


def blocks(found: Mapping[str, Any]) -> dict[str, str]:
    """The text between the markers of the docs, by part: the table of the last sensor, and a sentence on each."""
    out = {}
    for part, sensors in found.items():
        seeds = next(iter(sensors.values()))["seeds"]
        said = [
            f"{name} {100 * s['mass_bias'][0][0]:+.3f} ± {100 * s['mass_bias'][0][1]:.3f} %, "
            f"{100 * s['converged']:.1f} %, {s['passes']:.0f}, {len(s['missed']) or 'none'}"
            for name, s in sensors.items()
        ]
        lines = [
            _narrow(table(list(sensors.items())[-1:])),
            "",
            f"Seeds {seeds[0]} to {seeds[1]}. Mass off by, converged, median passes, aims missed:",
            f"{'; '.join(said)}.",
        ]
        out[part] = "\n".join(lines)
    return out


def _narrow(text: str) -> str:
    """A table without the columns that are too wide for the page."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.split("\n")]
    shown = [i for i, name in enumerate(rows[0]) if name not in ("n", "excess / bound", "claimed / bound")]
    return "\n".join(f"| {' | '.join(row[i] for i in shown)} |" for row in rows)


def filled(text: str, found: Mapping[str, Any]) -> str:
    """The page with its blocks `<!-- accuracy:PART -->` ... `<!-- /accuracy:PART -->` replaced."""
    for part, block in blocks(found).items():
        begin, end = f"<!-- accuracy:{part} -->", f"<!-- /accuracy:{part} -->"
        if begin in text and end in text:
            before, rest = text.split(begin, 1)
            text = f"{before}{begin}\n{block}\n{end}{rest.split(end, 1)[1]}"
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=[*PARTS, "all"], default="all")
    parser.add_argument("--sensor", default="ABC", help="letters of A, B, C")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--records", type=Path, default=Path("paper_accuracy.jsonl"))
    parser.add_argument("--limit", type=float, default=float("inf"), help="s after which no flight is begun")
    parser.add_argument("--docs", action="store_true", help="write docs/paper_accuracy.{json,md} at the end")
    arguments = parser.parse_args()
    parts = list(PARTS) if arguments.part == "all" else [arguments.part]
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    finished = run(parts, arguments.sensor, seeds, arguments.records, limit=arguments.limit)
    found = results(arguments.records)
    for part, block in blocks(found).items():
        print(f"\n{PARTS[part].title}\n\n{block}")
    if arguments.docs and finished:
        RESULTS.write_text(json.dumps(found, separators=(",", ":")) + "\n")
        DOCS.write_text(filled(DOCS.read_text(), found))


if __name__ == "__main__":
    main()
