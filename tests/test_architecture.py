"""The architecture as rules a machine can check: who may import whom, docstrings first, files readable in one sitting.

Read with `ast`, so nothing under test is executed. docs/explanation/architecture.md explains the rules."""

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("crazyem", "firmware_sim")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
READABLE = 450  # lines

LONG: set[str] = set()  # files that may be longer, each with its reason: none now

# What every part may import: errors, optional dependencies, how results show themselves, old names.
BASE = ("errors", "extras", "notebook", "deprecated", "toml_file", "atomic_file")

# What the parts of crazyem may import of crazyem, besides themselves and `BASE`. Nothing here is circular.
ALLOWED: dict[str, set[str]] = {
    **{name: set() for name in BASE},
    "compiled": set(),
    "vehicle": set(),
    "physics": {"vehicle", "compiled"},
    "signals": set(),
    "control": {"vehicle", "compiled", "physics"},
    "links": {"signals"},
    "estimation": {"vehicle", "compiled", "physics", "signals"},
    "recordings": {"vehicle", "compiled", "physics", "signals", "links", "estimation"},
    "monitoring": {"vehicle", "compiled", "physics", "estimation"},
    "doctor": {"vehicle", "physics", "signals", "recordings"},
    "diagnosis": {"vehicle", "compiled", "physics", "signals", "estimation", "recordings"},
    "planning": {"vehicle", "compiled", "physics", "control", "estimation", "diagnosis"},
    "simulators": {"vehicle", "physics", "recordings", "diagnosis"},
    "paper": {"vehicle", "compiled", "physics", "signals", "control", "estimation"},
    "live": {
        *("compiled", "vehicle", "physics", "signals", "control", "links", "estimation", "recordings"),
        "monitoring",
    },
    "api": {
        *("vehicle", "physics", "signals", "control", "links", "estimation", "recordings", "doctor", "diagnosis"),
        *("live", "monitoring", "planning", "simulators"),
    },
    "commands": {
        *("vehicle", "physics", "signals", "control", "links", "estimation", "recordings", "doctor", "diagnosis"),
        *("live", "monitoring", "paper", "api", "simulators"),
    },
    "cli": {"commands"},
    "__main__": {"cli"},
    # the library's front door: lazily, on first use
    "__init__": {
        "api",
        "diagnosis",
        "estimation",
        "live",
        "monitoring",
        "planning",
        "recordings",
        "signals",
        "vehicle",
    },
}

# The same for the folders of the diagnosis, in the order in which data pass through them; `workers` serves all.
DIAGNOSIS: dict[str, set[str]] = {
    "workers": set(), "flights": set(), "prediction": {"flights"}, "fitting": {"flights", "workers"},
    "locating": {"flights", "fitting", "workers"},
    "naming": {"flights", "prediction", "fitting", "locating", "workers"},
}  # fmt: skip

# Finer than folders: the only modules that a part may import from another. Each says what the exception is for.
ONLY: dict[tuple[str, str], set[str]] = {
    # a type, 24-bit stamps, and how MAVLink frames are found and checked
    ("recordings", "links"): {"crazyem.links.base", "crazyem.links.clock", "crazyem.links.mavlink.frames"},
    ("recordings", "estimation"): {"crazyem.estimation.result"},  # the type it writes
}

# Arrows that point up today. Shorten this list, never lengthen it.
DEBTS: set[tuple[str, str]] = set()  # imports that break the rule and are to go: (file, module)


@functools.cache
def tree_of(path: Path) -> ast.Module:
    """A module's syntax tree."""
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def imports(path: Path) -> tuple[str, ...]:
    """Every module a file imports, wherever in it: absolute dotted names; for `from x import y` both x and x.y."""
    return tuple(_imports(path))


def _imports(path: Path) -> Iterator[str]:
    package = path.relative_to(ROOT).with_suffix("").parts
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: -node.level]) if node.level else ""
            module = ".".join(part for part in (base, node.module or "") if part)
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call):  # importlib.import_module("x"), __import__("x")
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if name in ("import_module", "__import__"):
                yield from (a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str))


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def part_of(path: Path) -> str:
    """Folder or module directly below the package: `crazyem/live/push.py` -> `live`."""
    return path.relative_to(ROOT).with_suffix("").parts[1]


def of_package(package: str) -> list[Path]:
    return [path for path in MODULES if path.relative_to(ROOT).parts[0] == package]


def modules_below(package: str) -> set[str]:
    """Dotted names of all modules and packages of a package: tells a module from a name inside one."""
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts) for path in of_package(package)}
    return {name.removesuffix(".__init__") for name in names} | {name.rpartition(".")[0] for name in names}


def test_something_is_checked() -> None:
    assert len(of_package("crazyem")) > 30
    assert len(of_package("firmware_sim")) > 30


@pytest.mark.parametrize(("package", "other"), [PACKAGES, PACKAGES[::-1]])
def test_the_two_packages_never_import_each_other(package: str, other: str) -> None:
    """The wire is all there is between them: an estimator that could see the truth would prove nothing."""
    guilty = [(name_of(path), m) for path in of_package(package) for m in imports(path) if m.split(".")[0] == other]
    assert guilty == []


def test_arrows_point_down() -> None:
    known = modules_below("crazyem")
    guilty = []
    for path in of_package("crazyem"):
        part = part_of(path)
        assert part in ALLOWED, f"{name_of(path)}: say in ALLOWED what this new part may import"
        for module in imports(path):
            pieces = module.split(".")
            if pieces[0] != "crazyem" or len(pieces) < 2 or module not in known:
                continue
            target = pieces[1]
            if target in (part, *BASE) or (name_of(path), module) in DEBTS or module == "crazyem.commands":
                continue
            only = ONLY.get((part, target))
            deeper = len(pieces) > 2
            if target not in ALLOWED[part] or (only is not None and deeper and module not in only):
                guilty.append((name_of(path), module))
    assert guilty == []


def test_the_allowed_arrows_have_no_circle() -> None:
    """A part stands on parts that were placed before it, so some order of all parts exists."""
    placed: set[str] = set()
    while True:
        ready = {part for part, below in ALLOWED.items() if part not in placed and below <= placed}
        if not ready:
            break
        placed |= ready
    assert placed == set(ALLOWED)


def test_data_pass_through_the_diagnosis_one_way() -> None:
    """What stands above its folders (`diagnose.py`, `document.py`, `report/`) is used by none of them."""
    guilty = []
    for path in of_package("crazyem"):
        parts = path.relative_to(ROOT / "crazyem").with_suffix("").parts
        if parts[0] != "diagnosis" or parts[1] not in DIAGNOSIS:
            continue
        for module in imports(path):
            pieces = module.split(".")
            inside = pieces[:2] == ["crazyem", "diagnosis"] and len(pieces) > 2
            if inside and pieces[2] not in {parts[1], "settings", *DIAGNOSIS[parts[1]]}:
                guilty.append((name_of(path), module))
    assert guilty == []


def test_commands_are_only_used_from_above() -> None:
    for path in of_package("crazyem"):
        if part_of(path) in ("cli", "__main__", "commands"):
            continue
        above = {m for m in imports(path) if m.startswith(("crazyem.cli", "crazyem.commands"))}
        allowed = {module for file, module in DEBTS if file == name_of(path)}
        assert all(any(m in (a, "crazyem.commands") or m.startswith(a + ".") for a in allowed) for m in above), (
            name_of(path),
            above,
        )


@pytest.mark.parametrize("part", ["plant", "controllers", "commander", "flight", "scenario", "tables"])
def test_the_simulated_drone_knows_no_packets(part: str) -> None:
    """Physics and control do not know that a wire exists; only services, firmware and server do."""
    wire = ("firmware_sim.wire", "firmware_sim.server", "firmware_sim.services", "firmware_sim.firmware", "socket")
    guilty = [
        (name_of(path), module)
        for path in of_package("firmware_sim")
        if part_of(path) == part
        for module in imports(path)
        if any(module == w or module.startswith(w + ".") for w in wire)
    ]
    assert guilty == []


def test_only_links_know_cflib() -> None:
    """One narrow interface: cflib stays behind crazyem.links, and firmware_sim speaks CRTP without it."""
    guilty = [
        name_of(path)
        for path in MODULES
        if part_of(path) != "links" and any(m.split(".")[0] == "cflib" for m in imports(path))
    ]
    assert guilty == []


def test_modules_say_first_what_they_are_for() -> None:
    guilty = []
    for path in MODULES:
        tree = tree_of(path)
        documented = (ast.get_docstring(tree) or "").strip()
        marker = path.name == "__init__.py" and not tree.body
        if not marker and not (documented[:1].isalnum() or documented[:1] == "`"):
            guilty.append(name_of(path))
    assert guilty == []


def test_files_are_readable_in_one_sitting() -> None:
    lines = {name_of(path): len(path.read_text(encoding="utf-8").splitlines()) for path in MODULES}
    assert {name: n for name, n in lines.items() if n > READABLE and name not in LONG} == {}
