"""`python benchmarks/paper_pages.py RESULTS.json`: the numbers of docs: paper.md and of README.md, from a run.

A page holds blocks between `<!-- paper:NAME -->` and `<!-- /paper:NAME -->`. What is written there comes from
docs: paper_results.json, the run without its single flights, so that a test can tell whether a page has drifted.
`--small FILE` takes the numbers of the first two seeds from the run, so that another test can repeat just those.
"""

import argparse
import json
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from crazyem.atomic_file import write_file
from crazyem.errors import CrazyemError, FileFormatError, UsageError
from crazyem.paper.experiments import Task
from crazyem.paper.pages import (
    Grid,
    convergence_grid,
    errors_grid,
    notes,
    number,
    percent,
    settings_grid,
    table1_grid,
    table_grid,
)  # fmt: skip
from crazyem.paper.published_values import ONLINE_ITERATIONS
from crazyem.paper.runner import SCHEMA

Record = Mapping[str, Any]
STORED_RESULTS = "explanation/paper_results.json"
SMALL_SEEDS = 2
STORED_FIELDS = ("position", "angles", "final", "dead_reckoned", "sd", "ci95", "bound", "bound_noise_known", "windows")
PAGES = ("docs/explanation/paper.md", "README.md")
LARGEST_RESULTS = 200_000_000  # bytes of results.json; 20 seeds take 9 MB
_BLOCK = re.compile(r"(<!-- paper:([a-z0-9_]+) -->\n)(.*?)(<!-- /paper:\2 -->)", re.DOTALL)


def summarised(results: Record) -> dict[str, Any]:
    """The part of a run that the pages use: all but single flights and figures."""
    return {k: v for k, v in results.items() if k not in ("tasks", "figures")}


def small(results: Record) -> dict[str, Any]:
    """The estimates of the first seeds of a run, by the name of the task; settings and code are those of the run."""
    kept = {}
    for record in results["tasks"]:
        if record["seed"] < SMALL_SEEDS:
            name = Task(*(record[k] for k in ("experiment", "sensor", "method", "seed"))).name
            kept[name] = {k: record[k] for k in STORED_FIELDS if k in record}
    return {"seeds": SMALL_SEEDS, "environment": results["environment"], "tasks": kept}


def filled(text: str, results: Record) -> str:
    """A page with its blocks replaced.

    Raises:
        UsageError: the page has a block that is unknown.
    """

    def block(match: re.Match[str]) -> str:
        start, name, _, end = match.groups()
        if name not in BLOCKS:
            raise UsageError(f"there is no block {name!r} (known: {', '.join(BLOCKS)}).")
        return f"{start}{wrapped(BLOCKS[name](results).strip())}\n{end}"

    return _BLOCK.sub(block, text)


def wrapped(text: str) -> str:
    """Prose in lines of at most 118 characters; tables stay as they are."""
    lines = []
    for line in text.split("\n"):
        indent = "  " if line.startswith("- ") else ""
        whole = line.startswith("|") or not line
        lines += [line] if whole else textwrap.wrap(line, 118, subsequent_indent=indent, break_on_hyphens=False)
    return "\n".join(lines)


def read_results(path: Path) -> dict[str, Any]:
    """results.json, or its summary.

    Raises:
        FileFormatError: the file cannot be read or has another content.
    """
    try:
        if path.stat().st_size > LARGEST_RESULTS:
            raise FileFormatError(f"{path} is too large for the results of `crazyem paper`.")
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}.") from None
    except (ValueError, RecursionError):
        raise FileFormatError(f"{path} is no JSON file.") from None
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        raise FileFormatError(f"{path} does not hold results of `crazyem paper` (schema {SCHEMA!r}).")
    return content


# blocks -------------------------------------------------------------------------------------------------------


def _tables(results: Record) -> str:
    found = [table1_grid(results["table1"])] if results["table1"] else []
    found += [g for t in ("II", "III", "IV", "V") if (g := table_grid(results["cells"], t)) is not None]
    return "\n\n".join(grid.markdown(heading="###") for grid in found)


def _notes(results: Record) -> str:
    return "\n".join(f"- {line}" for line in notes(results))


def _cost(results: Record) -> str:
    timing = results["timing"]
    rows = []
    for kind, entry in timing["profile"].items():
        updates = [number(entry.get(f"{who}_{q}_ms")) for who in ("update", "estimator") for q in ("median", "p99")]
        cost = (number(entry["mean_cpu_s"]), number(entry["total_cpu_s"], ".0f"))
        rows.append((kind, str(entry["tasks"]), *cost, *updates))
    rows.append(("figures", str(timing["figures"]), "-", number(timing["figures_s"], ".0f"), *["-"] * 4))
    head = (
        "simulations",
        "number",
        "mean s of processor",
        "total",
        "update, median ms",
        "99 %",
        "estimator, median ms",
        "99 %",
    )
    period = 1e3 * _setting(results, "dt") * _setting(results, "every")
    plural = "process" if timing["jobs"] == 1 else "processes"
    said = f"The whole run took {timing['wall_s']:.0f} s with {timing['jobs']} {plural}"
    said += f" ({timing['tasks_reused']} simulations were there before)." if timing["tasks_reused"] else "."
    said += f" An update is due every {period:g} ms."
    ours = timing["profile"].get("online crazyem", {})
    if "estimator_median_ms" in ours:
        median, high = (percent(ours[f"estimator_{q}_ms"] / period, 0) for q in ("median", "p99"))
        said += f" crazyem's takes {median} of that (median of the flights' medians; 99 %: {high})."
    return Grid("", head, tuple(rows), said).markdown(heading="")


def _setting(results: Record, name: str) -> float:
    return float(next(s["value"] for s in results["settings"] if s["name"] == name))


def _environment(results: Record) -> str:
    e = results["environment"]
    return (
        f"Python {e['python']}, numpy {e['numpy']}, scipy {e['scipy']}, numba {e['numba']}, {e['system']} "
        f"{e['machine']}; crazyem {e['crazyem']}, code {e['code']}; "
        f"seeds 0 to {max(f['flights'] for f in results['flights']) - 1}."
    )


# the table of README ------------------------------------------------------------------------------------------


def better_grid(results: Record) -> Grid:
    """Table of the paper, its method here, crazyem and the bound: widths, bias, convergence, coverage."""
    cells = results["cells"]

    def chosen(experiment: str, *, mass: bool) -> list[Record]:
        return [c for c in cells if c["experiment"] == experiment and (c["parameter"] == "mass") == mass]

    def width(one: Record, who: str) -> float | None:
        value = one[who]
        return None if not value else (value["range"][1] - value["range"][0]) / one["true"]

    def widths(some: Sequence[Record], who: str) -> str:
        """Widths of each sensor; for inertia the geometric mean of its three axes."""
        said = []
        for sensor in "ABC":
            values = [w for c in some if c["sensor"] == sensor and (w := width(c, who))]
            said.append(
                percent(float(np.exp(np.mean(np.log(values)))), 2 if len(values) == 1 else 0) if values else "-"
            )
        return _joined(said)

    def worst(some: Sequence[Record], of: Callable[[Record], float | None]) -> str:
        values = [v for c in some if (v := of(c)) is not None]
        return percent(max(values, key=abs), 1, sign=True) if values else "-"

    rows = []
    for mass, what in ((True, "mass"), (False, "inertia")):
        for experiment in ("offline", "online"):
            some = chosen(experiment, mass=mass)
            said = [widths(some, who) for who in ("paper", "published", "crazyem", "bound")]
            why = (
                "C's missing angles are unknown, not zero" if mass else "the flights tell no more, whatever the method"
            )
            rows.append((f"range of {what}, {experiment}, A, B, C", *said, why if experiment == "offline" else ""))
    for mass, what in ((True, "mass"), (False, "inertia")):
        for experiment in ("offline", "online"):
            some = chosen(experiment, mass=mass)
            said = [
                worst(some, lambda c: c["paper"]["middle_bias"]),
                *(worst(some, lambda c, w=who: c[w] and c[w]["bias"]) for who in ("published", "crazyem")),  # type: ignore[misc]
                "0",
            ]
            why = (
                "the tilt is seen through the velocity"
                if mass
                else "the smoother uses the Jacobian and separate noises"
            )
            rows.append((f"largest bias of {what}, {experiment}", *said, why if experiment == "offline" else ""))
    for key, what in (("mass_1_stays", "mass within 1 %, online"), ("inertia", "inertia within 25 %, online")):
        both = [_time(results, who, key) for who in ("published", "crazyem")]
        rows.append((f"{what}, A, B, C (worst)", f"about {ONLINE_ITERATIONS} updates, 4 s", *both, "-", "-"))
    crashes = [_crashes(results, who) for who in ("published", "crazyem")]
    rows.append(
        ("flights that crash, online", "says nothing", *crashes, "0", "estimates stay positive by construction")
    )
    why = "from the information, the noise estimated with the rest"
    rows.append(("95 % intervals that hold", "gives none", "gives none", _coverage(cells), "95 %", why))
    both = [_over_bound(cells, who) for who in ("published", "crazyem")]
    rows.append(("rms error over the bound, mass, inertia", "-", *both, "1", "maximum likelihood"))
    return Grid("", ("", "paper", "its method, here", "crazyem", "limit", "why"), tuple(rows))


def _time(results: Record, method: str, key: str) -> str:
    """Median s of each sensor's flights, in brackets the worst of all; of inertia the slowest axis."""
    keys = [key] if key != "inertia" else [f"{name}_25_first" for name in ("Ixx", "Iyy", "Izz")]
    mine = [f for f in results["flights"] if f["method"] == method]

    def slowest(entries: Sequence[Record], which: str) -> str:
        values = [e[which] for e in entries]
        return "never" if None in values else f"{max(values):.2f}"

    if not mine:
        return "-"
    medians = [slowest([f[k] for k in keys], "median_s") for f in mine]
    return f"{', '.join(medians)} s ({slowest([f[k] for f in mine for k in keys], 'worst_s')})"


def _crashes(results: Record, method: str) -> str:
    mine = [f for f in results["flights"] if f["method"] == method]
    key = "crashed_as_printed" if method == "published" else "crashed"
    return f"{sum(f[key] for f in mine)} of {sum(f['flights'] for f in mine)}" if mine else "-"


def _coverage(cells: Sequence[Record]) -> str:
    some = [c["crazyem"] for c in cells if c["crazyem"] and "coverage" in c["crazyem"]]
    total = sum(c["intervals"] for c in some)
    return f"{percent(sum(c['coverage'] * c['intervals'] for c in some) / total, 1)} of {total}" if total else "-"


def _over_bound(cells: Sequence[Record], method: str) -> str:
    said = []
    for mass in (True, False):
        some = [c[method]["rms_over_bound"] for c in cells if c[method] and (c["parameter"] == "mass") == mass]
        said.append(number(float(np.sqrt(np.mean(np.square(some))))) if some else "-")
    return ", ".join(said)


def _joined(said: Sequence[str]) -> str:
    """Several percentages with one sign at the end."""
    return f"{', '.join(s.removesuffix(' %') for s in said)}{' %' if any(s.endswith(' %') for s in said) else ''}"


BLOCKS: dict[str, Callable[[Record], str]] = {
    "tables": _tables,
    "errors": lambda r: errors_grid(r["cells"]).markdown(heading=""),
    "convergence": lambda r: convergence_grid(r["flights"]).markdown(heading=""),
    "notes": _notes,
    "settings": lambda r: settings_grid(r["settings"]).markdown(heading=""),
    "cost": _cost,
    "environment": _environment,
    "better": lambda r: better_grid(r).markdown(heading=""),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Write docs/explanation/paper_results.json and every page that has blocks; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python benchmarks/paper_pages.py", description=__doc__.split("\n", maxsplit=1)[0]
    )
    parser.add_argument("results", nargs="?", help="results.json of a run (default: what is kept of the last one)")
    parser.add_argument("--small", metavar="FILE", help="also write the first two seeds there (needs results)")
    parser.add_argument("--root", default=".", help="of the repository (default: here)")
    arguments = parser.parse_args(argv)
    root = Path(arguments.root)
    try:
        kept = root / "docs" / STORED_RESULTS
        if arguments.results:
            results = read_results(Path(arguments.results))
            write_file(kept, json.dumps(summarised(results), indent=1, allow_nan=False) + "\n")
            if arguments.small:
                write_file(Path(arguments.small), json.dumps(small(results), indent=1, allow_nan=False) + "\n")
        results = read_results(kept)
        for name in PAGES:
            page = root / name
            if page.is_file():
                write_file(page, filled(page.read_text(encoding="utf-8"), results))
    except CrazyemError as error:
        parser.exit(error.exit_code, f"{parser.prog}: {error}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
