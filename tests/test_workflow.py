"""The hosted workflow runs what README promises, with the oldest Python that pyproject.toml allows."""

import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import settings

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


def test_each_command_of_the_workflows_is_a_target_of_make() -> None:
    files = (ROOT / ".github" / "workflows").glob("*.yml")
    jobs = [job for file in files for job in yaml.safe_load(file.read_text(encoding="utf-8"))["jobs"].values()]
    runs = [step["run"] for job in jobs for step in job["steps"] if "run" in step]
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert {run.removeprefix("make ") for run in runs} <= set(targets)


def test_a_landing_depends_on_no_random_example() -> None:
    """The long tests draw new examples, except where they decide whether a commit passes."""
    commands = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    assert "make test" in commands
    assert "make slow-fixed" in commands
    assert "make slow" not in commands
    assert settings.get_profile("steady").derandomize
    assert not settings.get_profile("new").derandomize
