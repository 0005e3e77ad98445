"""`crazyem replay` over recorded flights: two whose truth is known, and two of a real drone whose truth is not.

The recordings are not part of this repository; without them beside it these tests skip. docs: real_recordings.md says
what is found in them and why."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from crazyem.cli import main

RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "recordings"

# What the rigid body weighed that the real firmware flew, and its controller's default inertia (controller_lee.c).
INERTIA = {"Ixx": 1.657171e-5, "Iyy": 1.6655602e-5, "Izz": 2.9261652e-5}
LAG = 0.030
KNOWN = [("lee_34g_mass_pushed_midflight", "cf2", 0.0340), ("lee_brushless_39g", "cf21bl", 0.0393)]
# Intervals are tested at three standard deviations: with ten parameters looked at, two would fail by luck alone.
WIDE = 3.0

pytestmark = pytest.mark.slow


def replayed(tmp_path: Path, name: str, vehicle: str) -> dict[str, Any]:
    """The summary of `crazyem replay` for a recording, or skip."""
    path = RECORDINGS / f"{name}.csv.gz"
    if not path.exists():
        pytest.skip(f"the recording {path.name} is not here")
    summary, plot = tmp_path / "summary.json", tmp_path / "plot.png"
    arguments = ["replay", str(path), "--vehicle", vehicle, "--json", str(summary), "--plot", str(plot)]
    assert main(arguments) == 0
    assert plot.stat().st_size > 10_000
    result: dict[str, Any] = json.loads(summary.read_text())
    return result


def covered(estimate: dict[str, Any], truth: float) -> bool:
    """Whether the truth is within WIDE standard deviations, on the logarithmic scale that the intervals live on."""
    low, high = estimate["ci95"]
    sd = math.log(high / low) / (2 * 1.96)
    return abs(math.log(estimate["value"] / truth)) <= WIDE * sd


@pytest.mark.parametrize(("name", "vehicle", "mass"), KNOWN)
def test_flight_of_the_real_firmware(tmp_path: Path, name: str, vehicle: str, mass: float) -> None:
    """The thrust curve is the plant's own here, so mass itself is observable."""
    estimates = replayed(tmp_path, f"real_firmware/{name}", vehicle)["estimates"]

    found = estimates["mass"]
    assert found["identifiable"], found["reason"]
    assert found["value"] == pytest.approx(mass, rel=0.005)
    # 8 s of flight at 100 Hz: an sd of millionths would be a lie, one of several per cent no help.
    assert 2e-4 < found["sd"] / found["value"] < 1e-2
    assert covered(found, mass)

    # The 500 Hz loop feeds gyro noise into its command, and the log catches every fifth value: about pitch, which
    # this figure hardly excites, a fifth of its variance is noise. So a wide interval or a flag, either is right.
    for axis, truth in {**INERTIA, "motor_time_constant": LAG}.items():
        assert covered(estimates[axis], truth) or not estimates[axis]["identifiable"], (axis, estimates[axis])


@pytest.mark.parametrize("name", ["B3_figure8_medium_rep1", "B3_figure8_fast_rep1"])
def test_flight_of_a_real_drone(tmp_path: Path, name: str) -> None:
    """Of a real drone the data give mass over thrust scale only, and of its inertia nothing that may be believed."""
    summary = replayed(tmp_path, f"nanobench/{name}", "cf2")
    estimates = summary["estimates"]

    # The publisher claims 27 g. With the 2.1+ thrust curve the flight balances at 1.65 and 1.68 times that, and does
    # so without any estimator: mean vertical thrust over g. The range also allows for the curve's error.
    assert 1.55 < estimates["mass"]["value"] / 0.027 < 1.75
    assert any("thrust scale" in notice for notice in summary["notices"])

    # Below 2 Hz the rotors command 14 to 20 times the torque that the rotation takes, half of it in proportion to the
    # air speed: something else holds against it, and a model without it sees an enormous inertia. It must not say so.
    for axis in INERTIA:
        assert not estimates[axis]["identifiable"]
        assert estimates[axis]["reason"]
