"""A library of an extra that is missing is one sentence with the pip line; everything else works without."""

import re
import sys
import tomllib
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

import pytest

import crazyem
from crazyem import extras
from crazyem.commands.batch import each
from crazyem.commands.flights import wants_view
from crazyem.commands.output import plot_path
from crazyem.diagnosis.report import Series, html, write_report
from crazyem.live.foxglove import sdk
from crazyem.paper.figures import draw_all
from crazyem.recordings.autopilots import ulog_file
from crazyem.recordings.ros import rosbag2_file
from crazyem.simulators.documents.tables import TomlDocument, YamlDocument

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
ASKED = Namespace(plot="a.png", live=True, no_live=False, confirm=False)
PICTURE = {"a": Series("title", [0.0, 1.0], {"line": [0.0, 1.0]})}
DISTRIBUTIONS = {"foxglove": "foxglove-sdk", "ruamel": "ruamel.yaml"}

NEEDS: list[tuple[str, Callable[[Path], object]]] = [
    ("rosbags", lambda folder: rosbag2_file.read(folder, crazyem.ReadOptions())),
    ("pyulog", lambda folder: ulog_file._decode(folder, None)),  # type: ignore[arg-type]
    ("matplotlib", lambda folder: plot_path(ASKED)),
    ("matplotlib", lambda folder: draw_all([], None, folder)),  # type: ignore[arg-type, call-arg]
    ("matplotlib", lambda folder: write_report(folder / "r.html", {}, PICTURE)),
    ("jinja2", lambda folder: write_report(folder / "r.html", {}, {})),
    ("rich", lambda folder: wants_view(ASKED)),
    ("foxglove", lambda folder: sdk()),
    ("tomlkit", lambda folder: TomlDocument("", "a.toml")),
    ("ruamel", lambda folder: YamlDocument("", "a.yaml")),
    ("distributed", lambda folder: list(each(print, [()], names=[""], what="", cluster="127.0.0.1:1"))),  # type: ignore[arg-type]
]


@pytest.mark.parametrize(("library", "use"), NEEDS)
def test_a_missing_library_is_one_sentence(monkeypatch, tmp_path, library, use):
    for name in {library, *(n for n in sys.modules if n.startswith(f"{library}."))}:
        monkeypatch.setitem(sys.modules, name, None)
    html._template.cache_clear()  # another test may have made a report before
    with pytest.raises(extras.MissingExtraError) as raised:
        use(tmp_path)
    extra = next(name for name, modules in extras.EXTRAS.items() if library in modules)
    assert str(raised.value).endswith(f"needs {library}, which is not installed: pip install 'crazyem[{extra}]'.")
    assert raised.value.exit_code == 2
    assert not extras.installed(library)


def test_every_library_of_an_extra_is_tested_here():
    assert {library for library, _ in NEEDS} == {m for modules in extras.EXTRAS.values() for m in modules}


def test_without_matplotlib_there_is_no_default_plot_and_a_sentence(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert plot_path(Namespace(plot=None), "flight.mcap") is None
    assert "pip install 'crazyem[plots]'" in capsys.readouterr().err
    assert plot_path(Namespace(plot=None), None, "-") is None
    assert capsys.readouterr().err == ""


def test_a_library_that_lacks_something_of_its_own_says_so_itself(monkeypatch, tmp_path):
    (tmp_path / "rich.py").write_text("import no_such_module_at_all\n")
    monkeypatch.delitem(sys.modules, "rich", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="no_such_module_at_all"):
        extras.require("rich", "A test")


def test_the_extras_are_those_of_the_package():
    given = PROJECT["optional-dependencies"]
    for extra, modules in extras.EXTRAS.items():
        names = {re.split(r"[>=<\[]", requirement)[0] for requirement in given[extra]}
        assert names == {DISTRIBUTIONS.get(module, module) for module in modules}
    assert given["all"] == [f"crazyem[{','.join(extras.EXTRAS)}]"]


def test_a_plain_install_depends_on_few():
    named = {"numpy", "scipy", "cflib", "mcap", "pymavlink", "pyserial", "control", "numba"}
    names = {re.split(r"[>=<\[]", requirement)[0] for requirement in PROJECT["dependencies"]}
    assert named < names
    assert len(names - named) <= 5
