"""Finished tasks on disk, so that a run that was stopped goes on where it was; and results.json made of them."""

import ast
import hashlib
import json
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from crazyem.atomic_file import TEMPORARY_PREFIX, write_file
from crazyem.errors import UsageError
from crazyem.paper.experiments import Task, run_task
from crazyem.paper.settings import Settings, described

SCHEMA = "crazyem paper 1"
LARGEST_TASK_FILE = 20_000_000  # bytes of a task file that is ours; a whole flight of updates takes 0.1 MB

_PACKAGE = Path(__file__).resolve().parents[1]
# What the numbers of a task come from. Tables and figures are made anew each time.
_CODE = ("physics/**/*.py", "signals/**/*.py", "control/**/*.py", "estimation/**/*.py", "presets/zhao.toml",
         "vehicle.py", "compiled.py", "paper/*.py")  # fmt: skip
_TEXT_MODULES = "runner tables table_text figures pages published_values"
_NOT_CODE = {f"paper/{name}.py" for name in _TEXT_MODULES.split()}
_VERSIONED_PACKAGES = ("numpy", "scipy", "numba")


def code_hash(method: str = "crazyem") -> str:
    """Of all files that the numbers of a method come from; only crazyem's come from the estimator."""
    return _hash(method == "crazyem")


@cache
def _hash(with_estimator: bool) -> str:
    digest = hashlib.sha256()
    for path in sorted({p for pattern in _CODE for p in _PACKAGE.glob(pattern)}):
        name = path.relative_to(_PACKAGE).as_posix()
        ours = name == "paper/product.py" or name.startswith("estimation/")
        if name not in _NOT_CODE and (with_estimator or not ours):
            digest.update(f"{name}\0{_meaning(path)}\0".encode())
    return digest.hexdigest()[:16]


@cache
def _meaning(path: Path) -> str:
    """What a file does: without comments and layout, which change nothing."""
    text = path.read_text(encoding="utf-8")
    return ast.dump(ast.parse(text)) if path.suffix == ".py" else text


def environment() -> dict[str, Any]:
    """What the numbers depend on besides the settings."""
    return {
        "crazyem": metadata.version("crazyem"),
        "code": code_hash(),
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in _VERSIONED_PACKAGES},
        "machine": platform.machine(),
        "system": platform.system(),
    }


def fingerprint(settings: Settings, method: str) -> str:
    """Of everything that a record depends on besides its task."""
    text = json.dumps([SCHEMA, asdict(settings), {**environment(), "code": code_hash(method)}], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def task_file(folder: Path, task: Task) -> Path:
    """Where a task's record is kept in the output folder."""
    return folder / "tasks" / f"{task.name}.json"


def run_and_store(task: Task, settings: Settings, folder: str, stamp: str) -> None:
    """Run a task and write its record, whole or not at all. Raises UsageError: it cannot be written."""
    record = run_task(task, settings)
    write_file(task_file(Path(folder), task), json.dumps({"fingerprint": stamp, "record": record}, allow_nan=False))


def prepare(folder: Path) -> None:
    """Make the output folder, without unfinished files of a stopped run. Raises UsageError: it cannot be made."""
    try:
        (folder / "tasks").mkdir(parents=True, exist_ok=True)
        (folder / "figures").mkdir(exist_ok=True)
        for unfinished in (folder / "tasks").glob(f"{TEMPORARY_PREFIX}*"):
            unfinished.unlink()
    except OSError as error:
        raise UsageError(f"cannot make the folder {folder}: {error.strerror or error}.") from None


def stored(folder: Path, task: Task, stamp: str) -> tuple[dict[str, Any] | None, str]:
    """The record of a finished task, or None and why: "missing", "other" (settings or version) or "damaged"."""
    path = task_file(folder, task)
    try:
        if path.stat().st_size > LARGEST_TASK_FILE:
            return None, "damaged"
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None, "missing"
    except (OSError, ValueError, RecursionError):
        return None, "damaged"
    if not isinstance(content, dict) or not isinstance(content.get("fingerprint"), str):
        return None, "damaged"
    if content["fingerprint"] != stamp:
        return None, "other"
    record = content.get("record")
    return (record, "") if _is_record_of(record, task) else (None, "damaged")


_REQUIRED_FIELDS = {
    ("table1", "filter"): ("position", "angles"),
    ("offline", "published"): ("theta", "final"),
    ("offline", "crazyem"): ("final", "ci95"),
    ("offline", "bound"): ("bound", "bound_noise_known"),
    ("online", "published"): ("theta", "windows", "path", "times", "crashed"),
    ("online", "crazyem"): ("theta", "windows", "path", "times", "crashed", "intervals"),
}


def _is_record_of(record: Any, task: Task) -> bool:
    return (
        isinstance(record, dict)
        and all(record.get(key) == value for key, value in asdict(task).items())
        and isinstance(record.get("timing"), dict)
        and all(isinstance(record["timing"].get(k), float | int) for k in ("seconds", "cpu_seconds"))
        and all(key in record for key in _REQUIRED_FIELDS[task.experiment, task.method])
    )


def assemble(
    records: Sequence[Mapping[str, Any]], settings: Settings, derived: Mapping[str, Any], timing: Mapping[str, Any]
) -> dict[str, Any]:
    """The content of results.json.

    Args:
        records: of all tasks, in any order.
        derived: tables and the like made of them (see `tables.derive`).
        timing: of the run; beside it stands what the tasks say of their own cost.
    """
    ordered = sorted(records, key=lambda r: (r["experiment"], r["sensor"], r["method"], r["seed"]))
    return {
        "schema": SCHEMA,
        "settings": described(settings),
        "environment": environment(),
        **derived,
        "tasks": [{k: v for k, v in r.items() if k != "timing"} for r in ordered],
        "timing": {**timing, **cost_profile(ordered)},
    }


def cost_profile(records: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """What each kind of task costs: count, seconds, processor seconds; of updates the median over flights."""
    kinds: dict[str, list[Mapping[str, Any]]] = {}
    for record in records:
        kinds.setdefault(f"{record['experiment']} {record['method']}", []).append(record["timing"])
    profile = {}
    for kind, timings in sorted(kinds.items()):
        total, cpu = (sum(t[k] for t in timings) for k in ("seconds", "cpu_seconds"))
        entry: dict[str, Any] = {
            "tasks": len(timings), "total_s": round(total, 2), "total_cpu_s": round(cpu, 2),
            "mean_cpu_s": round(cpu / len(timings), 3),
        }  # fmt: skip
        for name in sorted({k for t in timings for k in t if not k.endswith("seconds")}):
            values = sorted(t[name] for t in timings if name in t)
            entry[name] = values[len(values) // 2]
        profile[kind] = entry
    return {"profile": profile}
