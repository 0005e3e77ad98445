"""The hosted workflow runs what README promises, with the oldest Python that pyproject.toml allows."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
yaml = pytest.importorskip("yaml")  # comes with cflib


def test_the_two_commands_run_with_the_oldest_and_the_newest() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    job = workflow["jobs"]["commands"]
    steps = [step.get("run") for step in job["steps"]]
    assert steps.index("make oldest") < steps.index("make fly") < steps.index("make test")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lowest = project["requires-python"].removeprefix(">=")
    cells = [(cell["python"], cell["dependencies"]) for cell in job["strategy"]["matrix"]["include"]]
    assert {(lowest, "oldest"), (lowest, "newest")} < set(cells)
    assert max(tuple(map(int, python.split("."))) for python, _ in cells) > tuple(map(int, lowest.split(".")))


def test_each_command_of_the_workflow_is_a_target_of_make() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    runs = [step["run"] for job in workflow["jobs"].values() for step in job["steps"] if "run" in step]
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert {run.removeprefix("make ") for run in runs} <= set(targets)
