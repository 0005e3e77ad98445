"""The supervisor's states, and the arbiter and decoders of setpoints."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_sim.commander import decode
from firmware_sim.commander import setpoint as sp
from firmware_sim.commander.setpoint import CRTP, HIGH_LEVEL, Arbiter
from firmware_sim.commander.supervisor import PERIOD, State, Supervisor
from firmware_sim.tables import slots


class Bench:
    """A supervisor with hand-operated sensors, motors and clock."""

    def __init__(self, *, auto_arm=True, rpm=False):
        names = [*(f"acc.{a}" for a in "xyz"), *(f"motor.m{n}" for n in range(1, 5))]
        names += [f"motor.m{n}_rpm" for n in range(1, 5)] if rpm else []
        self.log, self.tick, self.console, self.stamp = slots(dict.fromkeys(names, 0.0)), 0, [], None
        self.set("acc.z", 1.0)
        idle = slots({"powerDist.idleThrust": 7000.0})
        self.supervisor = Supervisor(
            self.log, idle, auto_arm=auto_arm, clock=lambda: self.tick, console=self.console.append
        )

    def set(self, name, value):
        array, index = self.log[name]
        array[index] = value

    def run(self, milliseconds):
        """Let time pass; setpoints keep coming unless `stamp` says when the last one came."""
        end = self.tick + milliseconds
        while self.tick < end:
            self.tick += PERIOD
            self.supervisor.update(self.tick if self.stamp is None else self.stamp)
        return self.supervisor.state

    def fly(self):
        self.run(200)
        self.set("motor.m1", 30000.0)
        assert self.run(80) == State.FLYING


@pytest.mark.parametrize(("limit", "seen", "crashes"), [(0.0, 9.0, False), (3.0, 4.5, True), (3.0, 3.5, False)])
def test_a_knock_beyond_crash_detect_gs_is_a_crash(limit, seen, crashes):
    """| |acc| - 1 g | > supervisor.crashDetectGs, 0 switches it off (supervisor.c); accNorm shows what it looks at."""
    bench = Bench()
    array, index = bench.supervisor.param["supervisor.crashDetectGs"]
    assert array[index] == 0.0  # as the firmware boots
    array[index] = limit
    bench.fly()
    bench.set("acc.x", math.sqrt(seen**2 - 1.0))
    bench.run(PERIOD)
    array, index = bench.supervisor.log["supervisor.accNorm"]
    assert array[index] == pytest.approx(seen)
    assert (bench.supervisor.state == State.CRASHED) == crashes
    assert any("Crash detected" in text for text in bench.console) == crashes


def test_arming_is_refused_before_the_checks_have_passed():
    assert not Bench(auto_arm=False).supervisor.request_arming(True)


def test_a_fresh_setpoint_saves_a_drone_that_levels_out_and_none_a_locked_one():
    """What levelling out is: test_like_the_real_one.py."""
    bench = Bench()
    bench.fly()
    bench.stamp = bench.tick
    assert bench.run(560) == State.LEVEL_OUT
    bench.stamp = bench.tick
    assert bench.run(40) == State.FLYING
    bench.stamp = bench.tick
    assert bench.run(2200) == State.LOCKED
    np.testing.assert_array_equal(bench.supervisor.override(sp.null_setpoint() + 1.0), sp.null_setpoint())
    bench.stamp = None
    assert bench.run(5000) == State.LOCKED
    assert bench.console == ["SUP: Locked, reboot required\n"]


@pytest.mark.parametrize(("z", "soon", "late"), [(0.4, 900, 1300), (-0.5, 80, 300)])
def test_a_tumble_is_a_crash_after_its_time(z, soon, late):
    """The recovery from it: test_like_the_real_one.py."""
    bench = Bench()
    bench.fly()
    bench.set("acc.z", z)
    bench.set("acc.x", 0.5)
    assert bench.run(soon) == State.FLYING
    assert bench.run(late) == State.CRASHED
    assert bench.supervisor.info & 0xA0 == 0xA0  # tumbled and crashed


def test_free_fall_is_no_tumble():
    bench = Bench()
    bench.fly()
    bench.set("acc.z", 0.05)
    assert bench.run(3000) == State.FLYING


def test_any_low_level_setpoint_locks_the_high_level_out_until_notified():
    events = []
    arbiter = Arbiter(low_level=lambda: events.append("low"), relaxed=lambda: events.append("relaxed"))
    high, low = sp.null_setpoint() + 1.0, sp.null_setpoint() + 2.0
    assert arbiter.disabled
    assert arbiter.offer(high, HIGH_LEVEL, 1)
    assert arbiter.offer(low, CRTP, 2)
    assert not arbiter.offer(high, HIGH_LEVEL, 3)
    assert (arbiter.setpoint is low, arbiter.stamp) == (True, 2)
    arbiter.relax()
    assert arbiter.setpoint is low  # until somebody gives another
    assert arbiter.offer(high, HIGH_LEVEL, 4)
    assert events == ["low", "relaxed"]


def test_thrust_stays_locked_until_a_zero_has_come():
    modes = {"stabModeRoll": 1.0, "stabModePitch": 1.0}
    decoder = decode.RpytDecoder(lambda name: modes.get(name, 0.0))
    assert decoder.decode(1.0, 2.0, 3.0, 40000, disabled=False)[sp.THRUST] == 0
    decoder.decode(0.0, 0.0, 0.0, 0, disabled=False)
    out = decoder.decode(1.0, -2.0, 3.0, 65000, disabled=False)
    assert (out[sp.THRUST], out[sp.ROLL], out[sp.PITCH], out[sp.RATE_YAW]) == (60000, 1.0, -2.0, 3.0)
    assert (out[sp.MODE_ROLL], out[sp.MODE_YAW], out[sp.MODE_Z]) == (sp.ABSOLUTE, sp.VELOCITY, sp.DISABLE)
    assert decoder.decode(0.0, 0.0, 0.0, 999, disabled=False)[sp.THRUST] == 0
    modes["althold"], modes["stabModeRoll"] = 1.0, 0.0
    out = decoder.decode(5.0, 0.0, 0.0, 65534, disabled=False)
    assert (out[sp.MODE_Z], out[sp.VZ], out[sp.RATE_ROLL]) == (sp.VELOCITY, 1.0, 5.0)


def test_full_state_is_in_millimetres_and_milliradians():
    data = struct.pack("<9hI3h", 1000, -2000, 500, 100, 0, -100, 9810, 0, 1, 3 << 30, 1000, -500, 0)
    out = decode.decode_generic(decode.FULL_STATE, data)
    np.testing.assert_allclose(out[sp.X : sp.AZ + 1], [1.0, -2.0, 0.5, 0.1, 0.0, -0.1, 9.81, 0.0, 0.001])
    np.testing.assert_allclose(out[sp.RATE_ROLL : sp.RATE_YAW + 1], np.degrees([1.0, -0.5, 0.0]))
    assert (out[sp.MODE_QUAT], out[sp.MODE_YAW], out[sp.QW]) == (sp.ABSOLUTE, sp.DISABLE, 1.0)
    assert decode.decode_generic(decode.FULL_STATE, data[:-1]) is None
    assert decode.decode_generic(99, data) is None


@pytest.mark.parametrize(
    ("legacy", "modern"),
    [
        (decode.VELOCITY_LEGACY, decode.VELOCITY_WORLD),
        (decode.Z_DISTANCE_LEGACY, decode.Z_DISTANCE),
        (decode.HOVER_LEGACY, decode.HOVER),
    ],
)
def test_legacy_types_only_invert_the_yaw_rate(legacy, modern):
    fields = [0.1, 0.2, 0.3, 0.4]
    turned = 3 if legacy == decode.VELOCITY_LEGACY else 2
    old = decode.decode_generic(legacy, struct.pack("<ffff", *fields))
    fields[turned] *= -1.0
    np.testing.assert_array_equal(old, decode.decode_generic(modern, struct.pack("<ffff", *fields)))


def test_the_other_generic_types():
    out = decode.decode_generic(decode.POSITION, struct.pack("<ffff", 1.0, 2.0, 3.0, 90.0))
    np.testing.assert_array_equal(out[[sp.X, sp.Y, sp.Z, sp.YAW, sp.MODE_YAW]], [1.0, 2.0, 3.0, 90.0, sp.ABSOLUTE])
    out = decode.decode_generic(decode.HOVER, struct.pack("<ffff", 0.5, 0.25, 10.0, 1.0))
    np.testing.assert_array_equal(
        out[[sp.VX, sp.VY, sp.Z, sp.RATE_YAW, sp.VELOCITY_BODY, sp.MODE_X]], [0.5, 0.25, 1.0, 10.0, 1.0, sp.VELOCITY]
    )
    out = decode.decode_generic(decode.MANUAL, struct.pack("<fffHB", 1.0, 2.0, 3.0, 30000, 1))
    np.testing.assert_array_equal(out[[sp.RATE_ROLL, sp.RATE_PITCH, sp.RATE_YAW, sp.THRUST]], [1.0, 2.0, 3.0, 30000.0])
    np.testing.assert_array_equal(decode.decode_generic(decode.STOP, b""), sp.null_setpoint())


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(lambda q: math.hypot(*q) > 0.1))
def test_quaternions_that_cflib_compresses_come_back(q):
    encoding = pytest.importorskip("cflib.utils.encoding")
    unit = np.array(q) / np.linalg.norm(q)
    back = np.array(decode.decompress_quaternion(encoding.compress_quaternion(unit)))
    assert min(np.abs(back - unit).max(), np.abs(back + unit).max()) < 0.004
