"""Unmodified cflib against the simulator process: scan, connect, log, parameters, memory, flights, a second client."""

import contextlib
import os
import queue
import subprocess
import sys
import threading
import time

import pytest
from processes import TIMEOUT, running

cflib_crtp = pytest.importorskip("cflib.crtp")
from cflib.crazyflie import Crazyflie  # noqa: E402
from cflib.crazyflie.log import LogConfig  # noqa: E402
from cflib.crazyflie.mem import MemoryElement, Poly4D  # noqa: E402
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie  # noqa: E402

SPEED = 4.0  # firmware seconds per second, in flights

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@contextlib.contextmanager
def connected(uri):
    """A fully connected Crazyflie object.

    cflib's ping thread fails if it sends while the link is closed, so it is stopped before.
    """
    with SyncCrazyflie(uri, cf=Crazyflie(ro_cache=None, rw_cache=None)) as scf:
        scf.wait_for_params()
        yield scf.cf
        scf.cf.link_statistics.stop()


@contextlib.contextmanager
def simulator(*arguments):
    """A running simulator: its URI."""
    with running("firmware_sim", "--port", "0", *arguments) as (_, uri):
        yield uri


@pytest.fixture(scope="module", autouse=True)
def drivers():
    os.environ["USE_CFLINK"] = ""
    cflib_crtp.init_drivers()


@pytest.fixture(scope="module")
def uri():
    with simulator() as address:
        yield address


def collect(cf, blocks, count, period_ms=10):
    """Log blocks of variables until each has given count samples: name -> list of (stamp, values)."""
    data = {name: [] for name in blocks}
    done = threading.Event()
    configs = []
    for name, variables in blocks.items():
        config = LogConfig(name, period_ms)
        for variable in variables:
            config.add_variable(*variable) if isinstance(variable, tuple) else config.add_variable(variable)
        cf.log.add_config(config)

        def received(stamp, values, block):
            data[block.name].append((stamp, values))
            if all(len(samples) >= count for samples in data.values()):
                done.set()

        config.data_received_cb.add_callback(received)
        configs.append(config)
    for config in configs:
        config.start()
    assert done.wait(TIMEOUT)
    for config in configs:
        config.stop()
        config.delete()
    return data


def wait_until(condition):
    end = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_scan_lists_the_simulator():
    for number in range(19850, 19860):
        command = [sys.executable, "-m", "firmware_sim", "--port", str(number)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
            if not process.stdout.readline():
                continue  # somebody else's simulator is there
            found = [address for address, _ in cflib_crtp.scan_interfaces() if address.startswith("udp")]
            process.terminate()
        assert f"udp://127.0.0.1:{number}" in found
        return
    pytest.skip("no port that cflib scans is free")


def test_it_connects_fully_and_a_second_client_can_follow(uri):
    for _ in range(2):
        with connected(uri) as cf:
            assert cf.platform.get_protocol_version() == 12
            assert "ctrlLee" in cf.param.toc.toc
            assert cf.param.get_value("deck.bcLighthouse4") == "0"
            assert cf.supervisor.is_auto_armed
            assert cf.supervisor.is_armed
            assert not cf.supervisor.is_flying
            samples = collect(cf, {"block": ["pm.vbat"]}, 5)
            assert 3.0 < samples["block"][0][1]["pm.vbat"] < 4.3
        assert not cf.is_connected()


def test_four_blocks_at_100_hz(uri):
    blocks = {
        "state": [f"stateEstimateZ.{n}" for n in ("x", "y", "z", "vx", "vy", "vz", "quat")],
        "imu": [*(f"gyro.{a}" for a in "xyz"), *(f"acc.{a}" for a in "xyz")],
        "motors": [*(f"motor.m{n}" for n in range(1, 5)), "pm.vbatMV", "supervisor.info"],
        "ten": [(f"stateEstimate.{n}", "FP16") for n in ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "roll")],
    }
    with connected(uri) as cf:
        data = collect(cf, blocks, 100)
    for name, samples in data.items():
        stamps = [stamp for stamp, _ in samples]
        assert abs(stamps[99] - stamps[0] - 990) <= 16, name
        assert set(samples[0][1]) == {v[0] if isinstance(v, tuple) else v for v in blocks[name]}
    imu = data["imu"][50][1]
    assert imu["acc.z"] == pytest.approx(1.0, abs=0.05)
    assert data["motors"][50][1]["motor.m1"] == 0
    assert len({samples[0][0] % 10 for samples in data.values()}) > 1  # not sampled at the same instant


def test_parameters_persist_and_echo(uri):
    with connected(uri) as cf:
        echoes = queue.Queue()
        cf.param.add_update_callback(group="ctrlLee", name="mass", cb=lambda name, value: echoes.put((name, value)))
        cf.param.set_value("ctrlLee.mass", "0.034")
        name, value = echoes.get(timeout=TIMEOUT)
        while float(value) != pytest.approx(0.034):
            name, value = echoes.get(timeout=TIMEOUT)
        assert name == "ctrlLee.mass"
        assert float(cf.param.get_value("ctrlLee.mass")) == pytest.approx(0.034)

        answers = queue.Queue()
        cf.param.persistent_get_state("supervisor.landedTimeout", lambda _name, state: answers.put(state))
        assert not answers.get(timeout=TIMEOUT).is_stored
        cf.param.set_value("supervisor.landedTimeout", "5000")
        cf.param.persistent_store("supervisor.landedTimeout", lambda _name, done: answers.put(done))
        assert answers.get(timeout=TIMEOUT) is True
        cf.param.persistent_get_state("supervisor.landedTimeout", lambda _name, state: answers.put(state))
        state = answers.get(timeout=TIMEOUT)
        assert state.is_stored
        assert state.stored_value == 5000
        cf.param.persistent_clear("supervisor.landedTimeout", lambda _name, done: answers.put(done))
        assert answers.get(timeout=TIMEOUT) is True
        cf.param.get_default_value("supervisor.landedTimeout", lambda _name, value: answers.put(value))
        assert answers.get(timeout=TIMEOUT) == pytest.approx(state.default_value)


@pytest.mark.slow
def test_a_parameter_stored_by_cflib_survives_a_restart(tmp_path):
    stored = ("--storage", str(tmp_path / "storage.json"))
    answers = queue.Queue()
    with simulator(*stored) as uri, connected(uri) as cf:
        assert float(cf.param.get_value("kalman.dragB_x")) == 0.0
        cf.param.set_value("kalman.dragB_x", "0.35")
        cf.param.persistent_store("kalman.dragB_x", lambda _name, done: answers.put(done))
        assert answers.get(timeout=TIMEOUT) is True
    with simulator(*stored) as uri, connected(uri) as cf:
        assert float(cf.param.get_value("kalman.dragB_x")) == pytest.approx(0.35)


def fly(cf):
    """Lee's controller, and the high-level commander in charge."""
    cf.param.set_value("stabilizer.controller", "5")
    cf.commander.send_notify_setpoint_stop()


def height(cf):
    return collect(cf, {"z": ["stateEstimate.z"]}, 3)["z"][-1][1]["stateEstimate.z"]


@pytest.mark.slow
def test_high_level_flight_and_uploaded_trajectory():
    with simulator("--speed", str(SPEED)) as uri, connected(uri) as cf:
        fly(cf)
        cf.high_level_commander.takeoff(0.8, 2.0)
        wait_until(lambda: height(cf) == pytest.approx(0.8, abs=0.05))
        assert cf.supervisor.is_flying
        memory = cf.mem.get_mems(MemoryElement.TYPE_TRAJ)[0]
        line = Poly4D(2.0, x=Poly4D.Poly([0.0, 0.0, 0.0, 0.5, -0.375, 0.075, 0.0, 0.0]))  # to x = 0.4 m
        hold = Poly4D(1.0)
        memory.trajectory = [line, hold]
        assert memory.write_data_sync()
        cf.high_level_commander.define_trajectory(1, 0, 2)
        cf.high_level_commander.start_trajectory(1, 1.0, relative_position=True)
        x = lambda: collect(cf, {"x": ["stateEstimate.x"]}, 3)["x"][-1][1]["stateEstimate.x"]  # noqa: E731
        wait_until(lambda: x() > 0.2)
        cf.high_level_commander.go_to(0.0, 0.5, 1.0, 0.0, 2.0)
        wait_until(lambda: height(cf) == pytest.approx(1.0, abs=0.05))
        cf.high_level_commander.land(0.0, 2.0)
        wait_until(lambda: not cf.supervisor.is_flying)
        assert height(cf) == pytest.approx(0.0, abs=0.05)


@pytest.mark.slow
def test_full_state_flight_and_what_closing_in_flight_does():
    with simulator() as uri:
        with connected(uri) as cf:
            fly(cf)
            begin = time.monotonic()
            while time.monotonic() < begin + 4.0:
                z = min(0.7, 0.5 * (time.monotonic() - begin))
                cf.commander.send_full_state_setpoint((0, 0, z), (0, 0, 0), (0, 0, 0), (0, 0, 0, 1), 0, 0, 0)
                time.sleep(0.005)
            assert height(cf) == pytest.approx(0.7, abs=0.1)
        with connected(uri) as cf:  # closing sent a zero setpoint: the motors are off, and then the supervisor locked
            wait_until(lambda: cf.supervisor.is_locked)
            assert not cf.supervisor.can_fly
