"""Flights of the MAVLink simulator with the real pymavlink: mass within its interval, hover thrust pushed, replayed."""

import json
import os
import struct
import threading
import time

import numpy as np
import pytest
from mavlink_pilot import Pilot, free_port, simulator
from mcap.reader import make_reader

from crazyem.cli import main
from crazyem.recordings import open_recording

pytestmark = pytest.mark.slow
MASS, THRUST, GRAVITY = 0.034, 0.48, 9.81


@pytest.fixture(scope="module")
def heavy(tmp_path_factory):
    path = tmp_path_factory.mktemp("truth") / "heavy.toml"
    path.write_text(f"[vehicle]\nmass = {MASS}\n")
    return str(path)


def watched(folder, scenario, *words, wire=None, seconds=12.0, speed=1.0, seed=0):
    """`crazyem watch` during a flight; exit code, its summary, its recording."""
    port, pilots = free_port(), free_port()
    recording, summary = str(folder / "a.mcap"), str(folder / "a.json")
    arguments = ("--scenario", scenario, "--speed", str(speed), "--seed", str(seed))
    with simulator(wire or f"udpout:127.0.0.1:{port}", f"udpout:127.0.0.1:{pilots}", arguments=arguments) as wires:
        pilot = Pilot(pilots, speed=speed)

        def fly():
            while not os.path.exists(recording):  # the watcher has connected
                time.sleep(0.05)
            time.sleep(1.5)
            pilot.fly(seconds)

        thread = threading.Thread(target=fly)
        thread.start()
        code = main(
            ["watch", wires[0], "--record", recording, "--json", summary, "--plot", str(folder / "a.png"),
             "--duration", str(seconds + 7.0 + 1.5 * speed), *words]
        )  # fmt: skip
        thread.join()
        hover = pilot.parameter("MPC_THR_HOVER")
        pilot.close()
    with open(summary, encoding="utf-8") as file:
        return code, json.load(file), recording, hover


def test_mass_is_found_pushed_as_hover_thrust_and_replayed_bit_for_bit(tmp_path, heavy, capsys):
    code, told, recording, hover = watched(tmp_path, heavy, "--push")
    assert code == 0
    mass = told["estimates"]["mass"]
    assert mass["identifiable"]
    assert mass["ci95"][0] <= MASS <= mass["ci95"][1]
    assert mass["value"] == pytest.approx(MASS, rel=0.01)
    # the vehicle file has 29 g; hover thrust was right for that
    assert hover == pytest.approx(MASS * GRAVITY / THRUST, rel=0.01)
    writes = [e for e in told["guard"]["decisions"] if e["action"] == "write"]
    assert writes
    assert all(0.1 <= w[1] <= 0.8 and w[0] == "MPC_THR_HOVER" for e in writes for w in e["writes"])
    assert told["guard"]["at_connect"]["MPC_THR_HOVER"] == pytest.approx(0.029 * GRAVITY / THRUST)

    again = tmp_path / "again.json"
    assert main(["replay", recording, "--json", str(again), "--plot", str(tmp_path / "b.png")]) == 0
    with again.open(encoding="utf-8") as file:
        assert json.load(file)["estimates"] == told["estimates"]

    # the frames in the file are a tlog: read as one, they have the same signals
    with open(recording, "rb") as file:
        frames = [(m.log_time, m.data) for _, _, m in make_reader(file).iter_messages(topics=["/mavlink"])]
    tlog = tmp_path / "a.tlog"
    tlog.write_bytes(b"".join(struct.pack(">Q", t // 1000) + data for t, data in frames))
    ours, theirs = open_recording(recording).signals, open_recording(str(tlog)).signals
    for name in ("position", "velocity", "attitude", "specific_force"):
        at = {round(1000 * t): v for t, v in zip(theirs[name].time.tolist(), theirs[name].value, strict=True)}
        rows = [(v, at[round(1000 * t)]) for t, v in zip(ours[name].time.tolist(), ours[name].value, strict=True)
                if round(1000 * t) in at]  # fmt: skip
        assert len(rows) > 0.95 * ours[name].time.size, name
        assert all(np.array_equal(a, b) for a, b in rows), name


def test_a_serial_port_and_a_dry_run_that_writes_nothing(tmp_path, heavy):
    code, told, _, hover = watched(tmp_path, heavy, wire="serial", seconds=8.0)
    assert code == 0
    mass = told["estimates"]["mass"]
    assert mass["ci95"][0] <= MASS <= mass["ci95"][1]
    assert hover == pytest.approx(0.029 * GRAVITY / THRUST, rel=1e-6)
    assert not told["pushes"]
    assert any(e["action"] == "would write" for e in told["guard"]["decisions"])
