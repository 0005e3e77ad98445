"""`crazyem paper`: the paper's simulations, its method and ours, as tables, figures and a page."""

import argparse
import json
import time
from pathlib import Path
from typing import Any

from crazyem.commands.batch import each, processes
from crazyem.commands.output import Result, put, say
from crazyem.errors import UsageError
from crazyem.paper.settings import READINGS, Settings, describe_text, settings_with


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    settings = settings_with(arguments.set or (), READINGS[arguments.reading])
    if arguments.settings:
        put(describe_text(settings))
        return 0
    # imported only now: --settings and wrong arguments need no numba
    from crazyem.paper.experiments import plan
    from crazyem.paper.runner import assemble, fingerprint, prepare, stored
    from crazyem.paper.tables import derive

    begin = time.perf_counter()
    folder = Path(arguments.out)
    prepare(folder)
    tasks = plan(_all(arguments.experiment, ("table1", "offline", "online")), _all(arguments.sensor, ("A", "B", "C")),
                 _all(arguments.method, ("published", "crazyem"), word="both"), arguments.seeds)  # fmt: skip
    stamps = {task: fingerprint(settings, task.method) for task in tasks}
    found = {task: stored(folder, task, stamps[task]) for task in tasks}
    left = [task for task in tasks if found[task][0] is None]
    _say_reused(found.values(), len(tasks))
    failed = _work({task: stamps[task] for task in left}, settings, folder, arguments)
    if failed is not None:
        return failed
    records: list[Any] = []
    for task in tasks:
        record = found[task][0] or stored(folder, task, stamps[task])[0]
        if record is None:
            raise UsageError(
                f"the result of {task.name} is not in {folder} although it was computed (a cluster must see it)."
            )
        records.append(record)
    simulated = time.perf_counter() - begin
    derived = derive(records, settings)
    figures, drawn, failed = _draw(records, settings, folder, arguments.jobs)
    if failed is not None:
        return failed
    timing = {
        "jobs": processes(arguments.jobs, len(tasks)), "tasks_reused": len(tasks) - len(left),
        "simulations_s": round(simulated, 2), "figures": len(figures), "figures_s": round(drawn, 2),
        "wall_s": round(time.perf_counter() - begin, 2),
    }  # fmt: skip
    results = assemble(records, settings, {"reading": arguments.reading, **derived, "figures": figures}, timing)
    write_results(folder, results)
    _summary(results, folder)
    return 0


def _all(choice: str, names: tuple[str, ...], *, word: str = "all") -> tuple[str, ...]:
    return names if choice == word else (choice,)


def _say_reused(found: Any, count: int) -> None:
    reasons = [why for record, why in found if record is None]
    reused = count - len(reasons)
    if reused:
        say(f"{reused} of {count} simulations were finished before and are used again")
    for why, text in (("damaged", "damaged"), ("other", "of other settings or another version")):
        if n := reasons.count(why):
            say(f"{n} stored {'result is' if n == 1 else 'results are'} {text} and made again")


def _work(left: dict[Any, str], settings: Settings, folder: Path, arguments: argparse.Namespace) -> int | None:
    """Run the remaining tasks; returns the exit code of the first failure, None without failure."""
    calls = [(task, settings, str(folder.resolve()), stamp) for task, stamp in left.items()]
    code = None
    names = [task.name for task in left]
    for result in each(
        one, calls, names=names, what="paper", jobs=arguments.jobs, cluster=arguments.cluster, unit="simulations"
    ):
        if result.error:
            where = "" if result.file in result.error else f"{result.file}: "
            say(f"crazyem: {where}{result.error}")
            code = code or result.code
    return code


def one(task: Any, settings: Settings, folder: str, stamp: str) -> Result:
    """Run one simulation and write its record to the folder; may run in a worker process."""
    from crazyem.paper.runner import run_and_store

    run_and_store(task, settings, folder, stamp)
    return Result(task.name)


def _draw(
    records: list[Any], settings: Settings, folder: Path, jobs: int | None
) -> tuple[list[dict[str, Any]], float, int | None]:
    """Draw all figures, one call per experiment and sensor; returns figures, seconds, exit code of a failure."""
    begin = time.perf_counter()
    groups: dict[str, list[Any]] = {}
    for record in records:
        groups.setdefault(f"{record['experiment']} {record['sensor']}", []).append(record)
    calls = [(mine, settings, str(folder.resolve()), name) for name, mine in groups.items()]
    figures: list[dict[str, Any]] = []
    for result in each(draw_group, calls, names=list(groups), what="paper", jobs=jobs, unit="groups of figures"):
        if result.error:
            say(f"crazyem: {result.error}")
            return [], 0.0, result.code
        figures += result.detail
    return sorted(figures, key=lambda f: int(f["number"])), time.perf_counter() - begin, None


def draw_group(records: list[Any], settings: Settings, folder: str, name: str) -> Result:
    """Draw the figures of these records; may run in a worker process."""
    from crazyem.paper.figures import draw_all

    return Result(name, detail=draw_all(records, settings, Path(folder) / "figures"))


def write_results(folder: Path, results: dict[str, Any]) -> None:
    """Write results.json, tables.md and index.html."""
    from crazyem.atomic_file import write_file
    from crazyem.paper.pages import index_html, tables_markdown

    write_file(folder / "results.json", json.dumps(results, allow_nan=False, indent=None) + "\n")
    write_file(folder / "tables.md", tables_markdown(results))
    write_file(folder / "index.html", index_html(results, results["figures"]))


def _summary(results: dict[str, Any], folder: Path) -> None:
    from crazyem.paper.pages import notes, table_grid

    for table in ("II", "III", "IV", "V"):
        grid = table_grid(results["cells"], table)
        if grid is not None:
            put(grid.text() + "\n")
    for line in notes(results):
        put(line)
    seconds = results["timing"]["wall_s"]
    put(f"{folder / 'index.html'}, tables.md, results.json; {len(results['figures'])} figures; {seconds:.0f} s")
