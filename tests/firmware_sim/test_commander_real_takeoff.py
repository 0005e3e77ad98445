"""A take-off of the whole simulator against the same take-off recorded from the real firmware (with another plant).

Real: C firmware of August 2026 with Lee's controller, believed mass 29 g, body 34 g, rotor lag 30 ms, take-off command
to 1 m in 2.5 s. Nothing is fitted; sensor and estimate noise differ, hence the tolerance.
"""

import csv
import gzip
import struct
from pathlib import Path

import numpy as np
import pytest

from firmware_sim import wire
from firmware_sim.firmware import Firmware
from firmware_sim.flight import Flight
from firmware_sim.scenario import load_scenario

RECORDING = (
    Path(__file__).parents[3] / "shared" / "recordings" / "real_firmware" / "lee_34g_mass_pushed_midflight.csv.gz"
)
ACTIVE = 0x100  # the bit of supervisor.info that says the high-level commander is flying


@pytest.mark.skipif(not RECORDING.exists(), reason="the recording of the real firmware is not at hand")
def test_takeoff_follows_the_real_firmware(tmp_path):
    with gzip.open(RECORDING, "rt") as file:
        rows = list(csv.DictReader(file))

    def signal(name):
        return np.array([(int(r["fw_ms"]), float(r["value"])) for r in rows if r["name"] == name]).T

    ticks, height = signal("stateEstimateZ.z")
    thrust_ticks, thrust = signal("ctrlLee.thrustSi")
    info_ticks, info = signal("supervisor.info")
    command = info_ticks[np.flatnonzero(info.astype(int) & ACTIVE)[0]] - 30  # updated at 25 Hz

    path = tmp_path / "scenario.toml"
    path.write_text("[vehicle]\nmass = 0.034\nmotor_time_constant = 0.03\n")
    scenario = load_scenario(path)
    believed = {"stabilizer.controller": 5.0, "ctrlLee.mass": 0.029}
    firmware = Firmware(Flight(scenario, 1), platform="cf2", seed=1, parameters=believed)
    firmware.advance(1000)
    takeoff = struct.pack("<BBff?f", 7, 0, 1.0, 0.0, True, 2.5)
    firmware.receive(wire.Packet(wire.SETPOINT_HIGH_LEVEL, 0, takeoff))
    times, flown, forces = np.arange(10, 3800, 10), [], []
    for _ in times:
        firmware.advance(10)
        flown.append(firmware.log.table.by_name["stateEstimate.z"].value)
        forces.append(firmware.log.table.by_name["ctrlLee.thrustSi"].value)

    real = np.interp(command + times, ticks, height / 1000.0)
    assert real.max() > 0.7
    np.testing.assert_allclose(flown, real, atol=0.03)  # m; the two estimates are that noisy
    settled = times > 3000
    hover = np.interp(command + times, thrust_ticks, thrust)[settled].mean()
    assert np.mean(np.array(forces)[settled]) == pytest.approx(hover, rel=0.01)
