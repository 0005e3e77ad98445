"""What August 2026's firmware logs that is no physics: PID's resets at changes of the setpoint's modes, rpm of 65535.

Flights of the simulated firmware without a link: its log table at 100 Hz, as a recording.
"""

import struct

import numpy as np
import pytest

from crazyem.doctor import examine
from crazyem.estimation.online import OnlineEstimator
from crazyem.estimation.steps import StepAwareEstimator
from crazyem.recordings.finding import Grade
from crazyem.recordings.recording import Recording
from crazyem.recordings.tables import Table, signals_from_tables
from crazyem.signals.vocabulary import standard_variables
from crazyem.vehicle import load_vehicle
from firmware_sim import wire
from firmware_sim.firmware import Firmware
from firmware_sim.flight import Flight
from firmware_sim.scenario import parse_scenario

MASS = {"cf2": 0.033, "cf21bl": 0.0425}
LOST = 0.01  # share of the reports of a rotor's speed


def position(x, y):
    return struct.pack("<Bffff", 7, x, y, 1.0, 0.0)


def hover(vx, vy):
    return struct.pack("<Bffff", 10, vx, vy, 0.0, 1.0)


def flown(platform):
    """Under PID, from place to speed and back every second: eight resets."""
    table = {"platform": platform, "vehicle": {"mass": MASS[platform]}, "sensors": {"rotor_speed_invalid": LOST}}
    scenario = parse_scenario(table, "test")
    firmware = Firmware(Flight(scenario, 3), platform=platform, seed=3)
    names = standard_variables([item.name for item in firmware.log.table.items])
    rows = []

    def run(seconds, packet=None):
        for _ in range(round(seconds * 100)):
            if packet is not None:
                firmware.receive(wire.Packet(wire.SETPOINT_GENERIC, 0, packet))
            firmware.advance(10)
            rows.append([firmware.log.table.by_name[name].value for name in names])

    run(0.5)
    if platform == "cf21bl":
        firmware.receive(wire.Packet(wire.SUPERVISOR, 1, b"\x01\x01"))
        run(1.0)
    firmware.receive(wire.Packet(wire.SETPOINT_HIGH_LEVEL, 0, struct.pack("<BBff?f", 7, 0, 1.0, 0.0, True, 2.0)))
    run(5.0)
    for k in range(4):
        run(1.0, hover(0.0, 0.1 * (-1) ** k))
        run(1.0, position(0.0, 0.0))
    values = np.array(rows)
    time = 0.01 * np.arange(len(values))
    columns = dict(zip(names, values.T, strict=True))
    return columns, signals_from_tables([Table("log", columns, time, np.arange(len(values)))], motor="duty")


@pytest.fixture(scope="module", params=["cf2", "cf21bl"])
def flight(request):
    return request.param, *flown(request.param)


def test_a_reset_of_pid_is_no_payload_and_no_mass(flight):
    platform, columns, signals = flight
    z = columns["stateEstimateZ.z"] * 1e-3
    assert np.ptp(z[-800:]) > 0.02  # the transients are there
    estimator = StepAwareEstimator(OnlineEstimator(load_vehicle(platform)))
    estimates = [e for e in map(estimator.feed, Recording("flight", "test", signals).samples()) if e is not None]
    assert not [step for step in estimator.steps if step.real]
    late = [e["mass"].value for e in estimates if e.time > 8.0]
    assert late == pytest.approx([MASS[platform]] * len(late), rel=0.02)


def test_a_rotor_speed_of_65535_is_missing_everywhere(flight):
    platform, columns, signals = flight
    if platform == "cf2":
        assert "rotor_speed" not in signals  # a brushed drone has none
        return
    invalid = np.column_stack([columns[f"motor.m{n}_rpm"] for n in range(1, 5)]) == 65535
    assert invalid.mean() == pytest.approx(LOST, rel=0.3)
    speed = signals["rotor_speed"]
    assert np.array_equal(np.isnan(speed.value), invalid)
    assert np.array_equal(speed.marked, invalid.any(axis=1))
    assert np.nanmax(speed.value) < 3000.0  # rad/s; 65535 rpm are 6863
    worse = [f for f in examine(Recording("flight", "test", signals)) if f.grade is not Grade.HARMLESS]
    assert not [f.text for f in worse if f.signal.startswith("rotor_speed")]
