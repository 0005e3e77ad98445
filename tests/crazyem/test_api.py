"""`import crazyem`: every name typed and documented, the numbers of the commands, nothing printed, errors raised."""

import ast
import importlib
import inspect
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import crazyem
from crazyem import api
from crazyem.cli import main
from crazyem.deprecated import moved
from crazyem.errors import CrazyemError, DataError, FileFormatError, UsageError

LOG = str(Path(__file__).parents[2] / "logs" / "clean_figure8.mcap")
PART = crazyem.ReadOptions(end=3.5)
NAMES = sorted(set(crazyem.__all__) - {"__version__"})
RESULTS = ("Diagnosis", "Estimate", "FlightResult", "Prediction", "Recording")


def test_type_checkers_see_what_the_lazy_import_gives():
    """The imports under TYPE_CHECKING are those of `__getattr__`, so no name is of type Any."""
    tree = ast.parse(Path(crazyem.__file__).read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    imports = {
        alias.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert imports == {name: f"crazyem.{home}" for name, home in crazyem._HOME.items()}
    assert sorted(imports) == NAMES
    assert (Path(crazyem.__file__).parent / "py.typed").exists()


@pytest.mark.parametrize("name", NAMES)
def test_every_name_is_documented_and_typed(name):
    thing = getattr(crazyem, name)
    assert len(inspect.getdoc(thing) or "") > 30
    functions = [thing] if inspect.isfunction(thing) else [m for n, m in inspect.getmembers(thing, inspect.isfunction)]
    for function in functions:
        if function.__module__.startswith("crazyem") and not function.__name__.startswith("__"):
            signature = inspect.signature(function)
            given = [p.annotation for n, p in signature.parameters.items() if n != "self"]
            assert inspect.Parameter.empty not in [*given, signature.return_annotation], function
            if inspect.isfunction(thing):
                assert all("Any" not in str(a) for a in given), function
            if not function.__name__.startswith("_"):
                assert inspect.getdoc(function), function


@pytest.mark.parametrize("name", RESULTS)
def test_results_speak(name):
    thing = getattr(crazyem, name)
    assert all(callable(getattr(thing, method)) for method in ("to_dict", "_repr_html_", "plot", "__str__"))
    assert thing.__dataclass_params__.frozen


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="nothing_such"):
        crazyem.nothing_such  # noqa: B018
    assert set(dir(crazyem)) == set(crazyem.__all__)


def test_the_import_loads_nothing_heavy_and_there_is_a_version():
    assert crazyem.__version__.count(".") == 2
    code = "import sys; before = set(sys.modules); import crazyem; print(*(set(sys.modules) - before))"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    assert {name.partition(".")[0] for name in loaded} <= {*sys.stdlib_module_names, "crazyem"}
    assert len(loaded) < 60
    assert [name for name in loaded if name.startswith("crazyem")] == ["crazyem"]


def test_a_replay_gives_the_numbers_of_the_command_and_prints_nothing(tmp_path, capfd):
    out = tmp_path / "replay.json"
    assert main(["replay", LOG, "--to", "3.5", "--json", str(out), "--plot", str(tmp_path / "a.png")]) == 0
    capfd.readouterr()
    result = crazyem.replay(LOG, options=PART)
    assert capfd.readouterr() == ("", "")
    command, function = json.loads(out.read_text()), json.loads(json.dumps(result.to_dict(), allow_nan=False))
    for summary in (command, function):
        summary.pop("update_ms")  # times of the machine
    assert command.pop("plot").endswith("a.png")
    assert function == command
    assert result.estimate["mass"].value == command["estimates"]["mass"]["value"]
    assert "<table>" in result._repr_html_()
    assert result.plot(tmp_path / "b.png").axes
    assert (tmp_path / "b.png").stat().st_size > 10_000
    assert "mass" in str(result)
    estimate = result.estimate
    assert estimate.to_dict()["estimates"] == command["estimates"]
    assert "Ixx" in estimate._repr_html_()
    assert estimate.plot().axes


def test_a_prediction_gives_the_arrays_of_the_command_and_prints_nothing(tmp_path, capfd):
    out = tmp_path / "p.npz"
    assert main(["predict", LOG, "--to", "3.5", "--horizon", "10", "--every", "20", "-o", str(out)]) == 0
    capfd.readouterr()
    recording = crazyem.open_recording(LOG, PART)
    found = crazyem.predict(recording, horizon=10, every=20)
    assert capfd.readouterr() == ("", "")
    with np.load(out) as arrays:
        assert set(arrays) == set(found.arrays())
        for name, array in found.arrays().items():
            assert np.array_equal(arrays[name], array), name
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert np.allclose(document["prediction"], found.prediction)
    assert found.vehicle.name in str(found)
    assert "<table>" in found._repr_html_()
    assert found.plot().axes
    assert recording.to_dict()["signals"]["position"]["unit"] == "m"
    assert "position" in recording._repr_html_()
    assert recording.plot().axes


@pytest.mark.slow
def test_a_diagnosis_gives_the_document_of_the_command_and_prints_nothing(tmp_path, capfd):
    out = tmp_path / "d.json"
    effects = ["linear_drag", "thrust_scale"]
    assert main(["diagnose", LOG, "--to", "9", "--candidates", ",".join(effects), "--json", str(out)]) == 0
    capfd.readouterr()
    found = crazyem.diagnose(LOG, candidates=effects, options=crazyem.ReadOptions(end=9.0))
    assert capfd.readouterr() == ("", "")
    command = json.loads(out.read_text())
    command.pop("seconds")
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False)) == command
    assert "<table>" in found._repr_html_()
    assert found.plot().axes
    found.report(tmp_path / "d.html")
    assert (tmp_path / "d.html").stat().st_size > 1000
    assert found.named_vehicle("fitted").name == "fitted"


def test_errors_are_raised_and_not_printed(tmp_path, capfd):
    junk = tmp_path / "junk.mcap"
    junk.write_bytes(b"no recording at all")
    for wrong, error in (
        (lambda: crazyem.open_recording(tmp_path / "none.mcap"), UsageError),
        (lambda: crazyem.replay(junk), FileFormatError),
        (lambda: crazyem.replay(LOG, "no_such_vehicle"), UsageError),
        (lambda: crazyem.replay(LOG, options=crazyem.ReadOptions(end=0.5)), DataError),
        (lambda: crazyem.predict(LOG, horizon=0), UsageError),
        (lambda: crazyem.diagnose([]), UsageError),
        (lambda: crazyem.load_vehicle("no_such_vehicle"), UsageError),
        (lambda: crazyem.load_policy(tmp_path / "none.toml"), UsageError),
        (lambda: crazyem.fly(trajectory="loop"), UsageError),
        (lambda: crazyem.fly("nowhere"), UsageError),
        (lambda: crazyem.fly("udp://127.0.0.1:1", seed=1), UsageError),
        (lambda: crazyem.fly("mavlink:udpin:127.0.0.1:1"), UsageError),
    ):
        with pytest.raises(error) as raised:
            wrong()
        assert isinstance(raised.value, CrazyemError)
    assert capfd.readouterr() == ("", "")


def test_an_old_name_warns_and_works():
    attribute = moved("crazyem.old", {"Replay": "crazyem.live.flight_result:FlightResult"})
    with pytest.warns(DeprecationWarning, match=r"crazyem\.live\.flight_result\.FlightResult"):
        assert attribute("Replay") is crazyem.FlightResult
    with pytest.raises(AttributeError):
        attribute("another")


def test_the_functions_of_the_api_know_no_terminal():
    for path in Path(api.__file__).parent.glob("*.py"):
        tree = ast.parse(path.read_text())
        assert "print" not in {getattr(n.func, "id", "") for n in ast.walk(tree) if isinstance(n, ast.Call)}
        importlib.import_module(f"crazyem.api.{path.stem}")
