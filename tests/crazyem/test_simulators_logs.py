"""Logs of simulators as recordings, and as the simulated side of `diagnose --against`."""

from pathlib import Path

import numpy as np
import pytest
from made_flight import Motion
from scipy.spatial.transform import Rotation

from crazyem.diagnosis.compare import compare
from crazyem.recordings import open_recording

MOTION = Motion(seconds=12.0, seed=2)
HEAD = "pos_x,pos_y,pos_z,quat_x,quat_y,quat_z,quat_w,vel_x,vel_y,vel_z,ang_vel_x,ang_vel_y,ang_vel_z"


def table(path: Path, head: str, *columns: np.ndarray) -> None:
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=head, comments="")


@pytest.mark.parametrize("simulator", ["crazyflow", "gym_pybullet_drones"])
def test_states_of_a_simulator_are_a_recording(simulator: str, tmp_path: Path) -> None:
    t = np.arange(0.0, 12.0, 0.01)
    turn, rate = MOTION.attitude(t), MOTION.body_rate(t)
    speeds = np.tile([1000.0, 1100.0, 1200.0, 1300.0], (t.size, 1)) * 60 / (2 * np.pi)
    path = tmp_path / "simulated.csv"
    if simulator == "crazyflow":
        head = f"time,{HEAD},rotor_vel_0,rotor_vel_1,rotor_vel_2,rotor_vel_3"
    else:
        head, rate = f"t,{HEAD},rpm0,rpm1,rpm2,rpm3", turn.apply(rate)  # Bullet's rates are in the world
    table(path, head, t, MOTION.position(t), turn.as_quat(), MOTION.velocity(t), rate, speeds)
    found = open_recording(path)
    assert np.allclose(found.signals["position"].value, MOTION.position(t))
    assert np.allclose(found.signals["body_rate"].value, MOTION.body_rate(t), atol=1e-6)
    off = Rotation.from_quat(found.signals["attitude"].value).inv() * turn
    assert off.magnitude().max() < 1e-6
    if simulator == "crazyflow":
        assert np.allclose(found.signals["rotor_speed"].value, [1000.0, 1100.0, 1200.0, 1300.0])
    other = tmp_path / "other.csv"
    table(
        other, head, t, MOTION.position(t) + np.array([0.1, 0.0, 0.0]), turn.as_quat(), MOTION.velocity(t), rate, speeds
    )
    against = compare(found, open_recording(other))
    assert against["signals"]["position"]["rms"] == pytest.approx(0.1)
    assert against["signals"]["body_rate"]["rms"] == pytest.approx(0.0, abs=1e-9)
