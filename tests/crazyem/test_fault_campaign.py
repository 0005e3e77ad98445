"""The campaign's own judgement, without a flight: what it draws, what it calls a crash, what it counts."""

import importlib
import json
import math
import struct
import sys
import tomllib
from pathlib import Path

import pytest

from crazyem.links.base import ParameterWrite
from crazyem.recordings.mcap.writer import RecordingWriter
from crazyem.signals.sample import Block, Packet, Variable
from crazyem.vehicle import load_vehicle
from firmware_sim.relay.faults import UP, Fault
from firmware_sim.scenario import parse_scenario

FOLDER = Path(__file__).parents[2]
HEAD = "t,px,py,pz,vx,vy,vz,qw,qx,qy,qz,wx,wy,wz\n"


@pytest.fixture(scope="module")
def benches():
    """Campaign and flight, imported the way they run: from the repository."""
    sys.path.insert(0, str(FOLDER))
    yield tuple(importlib.import_module(f"benchmarks.{n}") for n in ("fault_campaign", "fault_flight"))
    sys.path.remove(str(FOLDER))


def test_a_seed_draws_the_same_case_and_every_kind_comes_up(benches):
    _, flight = benches
    cases = [flight.draw(seed) for seed in range(300)]
    assert repr(cases) == repr([flight.draw(seed) for seed in range(300)])
    kinds = {k for case in cases for k in case.kinds}
    assert kinds >= {"payload attached", "payload dropped"}
    for case in cases[:50]:
        scenario = parse_scenario(tomllib.loads(case.scenario()), f"seed {case.seed}")
        masses = [scenario.truth(n)[0] for n in range(len(case.payload) + 1)]
        assert masses[0] == pytest.approx(case.mass)
        assert masses[-1] == pytest.approx(case.mass_at_end())
    assert kinds >= {*flight.SENSORS, "battery", "stall"}
    assert kinds >= {f"link {w}" for w in ("drop", "duplicate", "reorder", "delay", "silence", "die")}
    for case in cases:
        assert case.kinds
        for fault in case.link:
            Fault(**{**fault, "kinds": frozenset(fault.get("kinds", ()))})  # raises if it does not fit


def rows(*states):
    return HEAD + "".join(
        f"{t},{x},0,{z},0,0,{vz},{math.cos(tilt / 2)},{math.sin(tilt / 2)},0,0,0,0,0\n" for t, x, z, vz, tilt in states
    )


@pytest.mark.parametrize(
    ("states", "says"),
    [
        ([(0, 0, 0, 0, 0), (2, 0, 1, 0, 0.3), (9, 0, 0.01, -0.3, 0)], ""),
        ([(0, 0, 0, -5, 0)], ""),  # never flew
        ([(2, 0, 1, 0, 0), (9, 0, 0.04, -2.4, 0)], ""),  # the last 0.3 m may be dropped
        ([(2, 0, 1, 0, 0), (9, 0, 0.04, -3.5, 0)], "hit the floor with 3.5 m/s at 9.00 s"),
        ([(2, 0, 1, 0, 1.4)], "tilted 80 degrees"),
        ([(2, 9, 1, 0, 0)], "flew away"),
        ([(2, 0, 1, 0, 0), (3, 0, 2.6, 0, 0)], "hit the ceiling at 3.00 s"),
        ([(2, 0, 1, 0, 0), (3, 0, 0.01, 0, 0), (3.05, 0, 0.2, 0, 0), (3.2, 0, 0.01, 0, 0)], ""),  # touched it twice
        ([(2, 0, 1, 0, 0), (3, 0, 0.01, 0, 0), (3.15, 0, 0.01, 0, 0)], "lay on the floor at 3.00 s"),
        ([(2, 0, 1, 0, 0), (8.5, 0, 0.01, 0, 0), (9, 0, 0.01, 0, 0)], ""),  # after it was told to
    ],
)
def test_what_is_a_crash(benches, tmp_path, states, says):
    path = tmp_path / "truth.csv"
    path.write_text(rows(*states))
    found = benches[1].crash(path, landing=8.0)
    assert found.startswith(says) if says else not found
    assert benches[1].crash(tmp_path / "none.csv") == ""


def test_a_write_that_is_not_in_the_recording_is_noticed(benches, tmp_path):
    _, flight = benches
    engine = flight.Listening(0)
    for value in (0.03, 0.031):
        engine.take(0.0, "a", UP, bytes([0x2E]) + struct.pack("<Hf", 7, value))
    engine.take(0.0, "a", UP, bytes([0x2D]) + struct.pack("<H", 7))  # a read
    assert len(engine.written) == 2
    writer = RecordingWriter(str(tmp_path / "f.mcap"))
    block = Block(0, (Variable("pm.vbat", "float"),), 10)
    writer.blocks([block])
    writer.packet(Packet(0, 1000, 1.0, (3.9,)))
    writer.parameter_write(ParameterWrite("ctrlLee.mass", 0.03, None, False, 1.0))
    writer.close()
    names = {7: "ctrlLee.mass"}
    assert flight.unrecorded(engine.written, names, tmp_path / "f.mcap") == 1
    assert flight.unrecorded(set(engine.written), names, tmp_path / "missing.mcap") == 2


def test_the_table(benches, tmp_path):
    campaign, _ = benches
    for seed, arm, more in (
        (1, "none", {}),
        (1, "guarded", {"writes": 3, "left": 3, "purposes": {"push": 2, "revert": 1}, "mass_error": -0.1}),
        (1, "monitored", {"reports": ["payload"]}), (2, "monitored", {"reports": []}),
        (1, "unguarded", {"crashed": "tilted", "unrecorded": 1}), (2, "none", {"crashed": "fell"}),
        (2, "guarded", {"crashed": "fell"}), (2, "unguarded", {"hang": True}),
    ):  # fmt: skip
        text = json.dumps({"seed": seed, "arm": arm, "kinds": ["stall"], **more})
        (tmp_path / f"{seed}_{arm}.json").write_text(text)
    table = campaign.score(tmp_path)
    assert [table[a]["crashed_because_of_a_write"] for a in campaign.ARMS] == [0, 0, 0, 1]
    assert table["monitored"]["flights_with_reports"] == 1
    assert "| flights with reports of the monitor | 0 | 1 | 0 | 0 |" in campaign.page(table)
    assert table["guarded"]["crashed"] == 1
    assert table["guarded"]["flights_with_reverts"] == 1
    assert table["guarded"]["median_last_mass_error"] == 0.1
    assert table["unguarded"]["hangs"] == 1
    assert table["unguarded"]["unrecorded_writes"] == 1
    assert table["none"]["faults"] == {"stall": 2}


def test_a_later_case_has_the_same_faults_later(benches):
    _, flight = benches
    for seed in range(100):
        case = flight.draw(seed)
        later = case.later(8.0)
        assert later.kinds == case.kinds
        assert (later.sensor_from - 8.0, later.stall_at - 8.0) == pytest.approx((case.sensor_from, case.stall_at))
        assert [t - 8.0 for t, _ in later.payload] == pytest.approx([t for t, _ in case.payload])
        for one, other in zip(case.link, later.link, strict=True):
            assert {n: v + 8.0 if n in ("start", "end") else v for n, v in one.items()} == other
        assert case.later(0.0) == case


def test_the_monitor_observes_the_estimator_of_a_campaign(benches):
    _, flight = benches
    vehicle = load_vehicle("cf2")
    estimator = flight.Stalling(vehicle, flight.draw(1))
    monitor = flight.monitor_for(vehicle, flight.FaultRules(), enabled=True)
    assert monitor.watch(estimator)
    assert estimator.inner.on_filtered == monitor._filtered


# --- scripts that leave their attachment ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def attached(benches):
    return importlib.import_module("benchmarks.attached_flight")


def test_an_attached_flight_draws_every_way_out(attached):
    cases = [attached.draw(seed) for seed in range(1, 201)]
    assert repr(cases) == repr([attached.draw(seed) for seed in range(1, 201)])
    assert {c.way for c in cases} == set(attached.WAYS)
    assert {k for c in cases for k in c.kinds} >= {"slow estimator", "stalled estimator", "deaf", "lost echoes"}
    assert min(c.left - c.land for c in cases) < 0 < max(c.left - c.land - c.lasts for c in cases)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 17, 27, 75])
def test_a_script_that_leaves_around_its_landing_writes_nothing_on_the_ground(attached, seed):
    """Ctrl-C, exception, by itself, link lost, the estimator seconds behind."""
    result = attached.fly(seed)
    assert result.fault_of_ours == ""
    assert result.landed
    assert result.on_ground == 0
