"""A new format of recordings and one of simulators' files: one file each, and every command knows it."""

import sys
from pathlib import Path

import numpy as np
import pytest

from crazyem.physics import folding
from crazyem.recordings import registry as recordings
from crazyem.recordings.registry import Reader, open_recording
from crazyem.simulators.convert import FORMATS, convert, discover, load_source

RECORDING_FORMAT = '''
"""Text of a made-up logger: a line of "logger 1", then time, x, y, z."""

import numpy as np

from crazyem.recordings.recording import Recording, SignalArray


def recognises(head):
    return head.startswith(b"logger 1")


def read(path, options):
    rows = np.loadtxt(path, skiprows=1)
    unknown, ours = np.full(len(rows), np.nan), np.zeros(len(rows), bool)
    position = SignalArray(rows[:, 0], rows[:, 1:], np.arange(len(rows)), unknown, ours, quantity="position", unit="m")
    return Recording(str(path), "logger", {"position": position})
'''

SIMULATOR_FORMAT = '''
"""Files of a made-up simulator: TOML with mass in grams and inertia in g mm^2."""

from crazyem.simulators.documents.tables import TomlDocument
from crazyem.simulators.fields import Field, Format

MADE_UP = Format(
    name="made-up", suffix=".toml", words="a made-up simulator", open=TomlDocument, source="this test",
    recognises=lambda text: "mass_in_grams" in text,
    fields=lambda document, name: [
        Field(("mass_in_grams",), "mass", "g", 1e3),
        *(Field(("moments", k), f"inertia_{a}{a}", "g mm^2", 1e9) for k, a in enumerate("xyz")),
    ],
    skeleton=lambda name: "mass_in_grams = 0.0\\nmoments = [0.0, 0.0, 0.0]\\n",
)
'''


def test_a_format_of_recordings_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "logger_format_of_a_test.py").write_text(RECORDING_FORMAT)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(recordings, "READERS", (Reader("logger", "logger_format_of_a_test"), *recordings.READERS))
    path = tmp_path / "flight.txt"
    path.write_text("logger 1\n0.0 0.0 0.0 1.0\n0.1 0.2 0.0 1.0\n0.2 0.4 0.0 1.0\n")
    found = open_recording(path)
    sys.modules.pop("logger_format_of_a_test")
    assert found.source == "logger"
    np.testing.assert_array_equal(found.signals["position"].value[:, 0], [0.0, 0.2, 0.4])


def test_a_format_of_simulators_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "made_up_format_of_a_test.py").write_text(SIMULATOR_FORMAT)
    monkeypatch.syspath_prepend(tmp_path)
    found = discover([str(tmp_path)])
    sys.modules.pop("made_up_format_of_a_test")
    assert list(found) == ["made-up"]
    monkeypatch.setitem(FORMATS, "made-up", found["made-up"])
    drone = folding.load("cf21bl")
    made = convert(drone, "made-up", costs=False)
    path = tmp_path / "drone.toml"
    path.write_text(made.text)
    back = load_source(path)
    assert back.format == "made-up"
    assert back.vehicle.mass == pytest.approx(drone.mass, rel=1e-9)
    assert back.vehicle.inertia == pytest.approx(drone.inertia, rel=1e-9)
