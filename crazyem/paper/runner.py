"""Records of finished tasks on disk, so that a stopped run can continue, and results.json from these records."""

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

from crazyem.atomic_file import write_file
from crazyem.errors import UsageError
from crazyem.paper.experiments import Task, run_task
from crazyem.paper.settings import Settings, described

SCHEMA = "crazyem paper 1"
LARGEST_TASK_FILE = 20_000_000  # bytes; larger task files count as damaged. The updates of a whole flight take 0.1 MB

_PACKAGE = Path(__file__).resolve().parents[1]
# Files on which the numbers of a task depend. Tables and figures are made anew in each run.
_CODE = ("physics/**/*.py", "signals/**/*.py", "control/**/*.py", "estimation/**/*.py", "presets/zhao.toml",
         "vehicle.py", "compiled.py", "paper/*.py")  # fmt: skip
_TEXT_MODULES = ("runner", "tables", "figures", "pages", "published_values")
_NOT_CODE = {f"paper/{name}.py" for name in _TEXT_MODULES}
_VERSIONED_PACKAGES = ("numpy", "scipy", "numba")


@cache
def code_hash(method: str = "crazyem") -> str:
    """Hash of all files on which the numbers of a method depend; only crazyem's numbers depend on the estimator."""
    digest = hashlib.sha256()
    for path in sorted({p for pattern in _CODE for p in _PACKAGE.glob(pattern)}):
        name = path.relative_to(_PACKAGE).as_posix()
        ours = name == "paper/product.py" or name.startswith("estimation/")
        if name not in _NOT_CODE and (method == "crazyem" or not ours):
            digest.update(f"{name}\0{code_of(path)}\0".encode())
    return digest.hexdigest()[:16]


@cache
def code_of(path: Path) -> str:
    """The content of a file without comments, docstrings and layout, which do not affect results."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        return text
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
            and ast.get_docstring(node, clean=False) is not None
        ):
            del node.body[0]
    return ast.dump(tree)


def environment() -> dict[str, Any]:
    """Versions and machine on which the numbers depend besides the settings."""
    return {
        "crazyem": metadata.version("crazyem"),
        "code": code_hash(),
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in _VERSIONED_PACKAGES},
        "machine": platform.machine(),
        "system": platform.system(),
    }


def fingerprint(settings: Settings, method: str) -> str:
    """Hash of everything on which a record depends besides its task."""
    text = json.dumps([SCHEMA, asdict(settings), {**environment(), "code": code_hash(method)}], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def task_file(folder: Path, task: Task) -> Path:
    """The file of a task's record in the output folder."""
    return folder / "tasks" / f"{task.name}.json"


def run_and_store(task: Task, settings: Settings, folder: str, stamp: str) -> None:
    """Run a task and write its record atomically. Raises UsageError: the record cannot be written."""
    record = run_task(task, settings)
    write_file(task_file(Path(folder), task), json.dumps({"fingerprint": stamp, "record": record}, allow_nan=False))


def prepare(folder: Path) -> None:
    """Make the output folder. Raises UsageError: it cannot be made."""
    try:
        (folder / "tasks").mkdir(parents=True, exist_ok=True)
        (folder / "figures").mkdir(exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot make the folder {folder}: {error.strerror or error}.") from None


def stored(folder: Path, task: Task, stamp: str) -> tuple[dict[str, Any] | None, str]:
    """The record of a finished task; or None and the reason: "missing", "other" (settings or version) or "damaged"."""
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
        derived: tables and statistics of the records (see `tables.derive`).
        timing: of the run; the cost of the tasks is added.
    """
    ordered = sorted(records, key=lambda r: (r["experiment"], r["sensor"], r["method"], r["seed"]))
    return {
        "schema": SCHEMA,
        "settings": described(settings),
        "environment": environment(),
        **derived,
        "tasks": [{k: v for k, v in r.items() if k != "timing"} for r in ordered],
        "timing": {**timing, "profile": cost_profile(ordered)},
    }


def cost_profile(records: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Cost of each kind of task: count, seconds, processor seconds; for updates the median over flights."""
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
    return profile
