"""The figures of crtp.md about behaviour, one test each, on the whole firmware: flights, stops, refusals.

What concerns bytes alone is in test_services.py, test_server.py and test_wire_tables.py (docs: firmware_sim.md lists
which figure is tested where). [M] in a docstring: measured on the real C firmware. No sockets, no real time.
"""

import math
import struct

import numpy as np
import pytest

from firmware_sim import wire
from firmware_sim.firmware import Firmware
from firmware_sim.flight import Flight
from firmware_sim.plant import layout as at
from firmware_sim.plant.platforms import PLATFORMS
from firmware_sim.scenario import parse_scenario

PID, MELLINGER, INDI, LEE = 1, 2, 3, 5
CAN_ARM, ARMED, AUTO, CAN_FLY, FLYING, TUMBLED, LOCKED, CRASHED, HL_ACTIVE, HL_FINISHED = (1 << n for n in range(10))
EBUSY = 16
PERIOD = 4.0  # s of the circle
# As the real firmware was measured: 30 ms of rotor lag and no noise but the sensors'
MEASURED = {"vehicle": {"motor_time_constant": 0.03}, "noise": {"thrust": 0.0, "torque": 0.0}}


class Drone:
    """A firmware with its flight, spoken to in packets."""

    def __init__(self, table=None, *, seed=1, **parameters):
        table = table or {}
        scenario = parse_scenario(table, "test")
        boot = {name.replace("__", "."): float(value) for name, value in parameters.items()}
        self.flight = Flight(scenario, seed)
        self.firmware = Firmware(self.flight, platform=scenario.platform, seed=seed, parameters=boot)
        self.ask(wire.LINK, 0, b"\0")
        self.run(0.2)

    def ask(self, port, channel, data):
        """Data of the replies on that port and channel."""
        self.firmware.outbox.clear()
        self.firmware.receive(wire.Packet(port, channel, data))
        packets = [wire.decode(datagram) for datagram, _ in self.firmware.outbox]
        return [p.data for p in packets if (p.port, p.channel) == (port, channel)]

    def run(self, seconds, stream=None, every=0.02):
        """Let time pass, sending the packet stream(t) every so often."""
        self.watch(seconds, (), stream, every)

    def watch(self, seconds, names, stream=None, every=0.01):
        """The same; the values of the named log variables after each step."""
        seen = []
        for n in range(round(seconds / every)):
            if stream is not None:
                self.ask(wire.SETPOINT_GENERIC, 0, stream(n * every))
            self.firmware.advance(round(every * 1000))
            seen.append([self[name] for name in names])
        return np.array(seen)

    def __getitem__(self, name):
        return self.firmware.log.table.by_name[name].value

    def write(self, name, value):
        item = self.firmware.param.table.by_name[name]
        self.firmware.param.set(item, value)

    @property
    def info(self):
        """The supervisor's bits, as a client asks for them."""
        return struct.unpack("<H", self.ask(wire.SUPERVISOR, 0, b"\x0c")[0][1:])[0]

    @property
    def motors(self):
        return [self[f"motor.m{n}"] for n in range(1, 5)]

    @property
    def height(self):
        """True, m."""
        return float(self.flight.state[at.POS + 2])

    def takeoff(self, height=1.0, seconds=2.0):
        """The high-level command; its error code."""
        packet = struct.pack("<BBff?f", 7, 0, height, 0.0, True, seconds)
        return self.ask(wire.SETPOINT_HIGH_LEVEL, 0, packet)[0][3]

    def notify_stop(self):
        self.ask(wire.SETPOINT_GENERIC, 1, b"\0" + struct.pack("<I", 0))

    def arm(self, on=True):
        """Success and whether it is armed then."""
        return tuple(self.ask(wire.SUPERVISOR, 1, bytes((1, on)))[0][1:])


def hovering(table=None, controller=LEE, **parameters):
    """A drone that hovers at 1 m, flown there by the high-level commander."""
    drone = Drone(table, stabilizer__controller=controller, **parameters)
    if drone.flight.log.get("motor.m1_rpm"):
        drone.arm()
        drone.run(1.0)
    assert drone.takeoff() == 0
    drone.run(5.0)
    return drone


def full_state(position, velocity=(0.0, 0.0, 0.0), acceleration=(0.0, 0.0, 0.0)):
    """Packet of a full-state setpoint: m, m/s, m/s^2, world; heading x."""
    numbers = [int(1000 * v) for v in (*position, *velocity, *acceleration)]
    return b"\x06" + struct.pack("<9hI3h", *numbers, 3 << 30, 0, 0, 0)


def circle(t, radius=0.5, height=1.0):
    """A point on a circle through the place (0, 0), entered smoothly, as a full-state packet."""
    w = 2 * math.pi / PERIOD
    u = min(t / 2.0, 1.0)
    a = radius * u * u * (3 - 2 * u)
    c, s = math.cos(w * t), math.sin(w * t)
    return full_state((a * s, a * c, height), (a * w * c, -a * w * s, 0), (-a * w * w * s, -a * w * w * c, 0))


def stays_locked(drone):
    """Motors off, bit 6, and nothing a client can ask for helps."""
    assert drone.motors == [0] * 4
    assert drone.info & (LOCKED | CAN_FLY | FLYING) == LOCKED
    assert drone.arm() == (0, 0)
    assert drone.takeoff() == EBUSY
    drone.ask(wire.SUPERVISOR, 1, b"\x02")
    drone.notify_stop()
    drone.run(1.0, lambda _t: full_state((0, 0, 1)))
    assert drone.motors == [0] * 4
    assert drone.info & LOCKED


# Section 4: setpoints


@pytest.mark.parametrize("controller", [PID, MELLINGER, INDI, LEE])
def test_a_setpoint_of_500_ms_levels_out_and_one_of_2000_ms_locks_until_reboot(controller):
    drone = Drone(stabilizer__controller=controller)
    drone.run(4.0, lambda t: full_state((0, 0, min(1.0, t / 2)), (0.3, 0.0, 0.0)))
    leaning = abs(drone["stabilizer.pitch"])
    drone.firmware.advance(440)  # the last one came 20 ms before
    assert drone["ctrltarget.mode_x"] == 1
    drone.firmware.advance(600)
    assert [drone[f"ctrltarget.mode_{n}"] for n in ("x", "y", "roll", "pitch", "yaw")] == [0, 0, 1, 1, 2]
    assert drone["ctrltarget.mode_z"] == 1  # height as it is
    assert abs(drone["stabilizer.pitch"]) < max(leaning, 3.0)
    assert drone.height == pytest.approx(1.0, abs=0.15)
    assert drone.info & FLYING
    drone.firmware.advance(840)  # 1.9 s old
    assert min(drone.motors) > 0
    drone.firmware.advance(280)
    stays_locked(drone)
    assert drone.height < 0.2


def test_the_zero_setpoint_of_close_link_cuts_the_motors_in_flight_and_locks_the_high_level_out():
    """[M]: the next take-off is silently without effect until a notice that the stream has stopped."""
    drone = Drone(stabilizer__controller=LEE)
    zero = struct.pack("<fffH", 0.0, 0.0, 0.0, 0)
    drone.ask(wire.SETPOINT, 0, zero)
    assert drone.takeoff() == 0  # the reply does not tell
    drone.run(3.0)
    assert drone.motors == [0] * 4
    assert drone.height == pytest.approx(0.0, abs=1e-3)
    drone.ask(wire.SETPOINT_HIGH_LEVEL, 0, b"\x03\0")  # else the plan, flown by nobody, goes on at its end
    drone.notify_stop()
    assert drone.takeoff() == 0
    drone.run(4.0)
    assert drone.height == pytest.approx(1.0, abs=0.05)
    drone.ask(wire.SETPOINT, 0, zero)
    drone.firmware.advance(40)
    assert drone.motors == [0] * 4
    drone.run(2.5)
    assert drone.height < 0.1


# Sections 5 and 6: stops, arming, crashes

STOPS = {
    "supervisor": (wire.SUPERVISOR, 1, b"\x03"),
    "supervisor_watchdog": (wire.SUPERVISOR, 1, b"\x04"),
    "localisation": (wire.LOCALISATION, 1, b"\x03"),
    "localisation_watchdog": (wire.LOCALISATION, 1, b"\x04"),
}


@pytest.mark.parametrize("which", STOPS)
def test_an_emergency_stop_lets_it_fall_and_latches(which):
    drone = hovering()
    port, channel, data = STOPS[which]
    assert drone.ask(port, channel, data) == []  # no reply
    if which.endswith("watchdog"):
        drone.firmware.advance(900)
        assert min(drone.motors) > 0
        drone.ask(port, channel, data)  # fed in time
        drone.firmware.advance(960)
        assert min(drone.motors) > 0
    drone.firmware.advance(120)
    assert drone.motors == [0] * 4
    drone.run(1.0)
    assert drone.height < 0.1
    stays_locked(drone)


def test_the_stop_parameter_is_an_emergency_stop_too():
    drone = hovering()
    drone.write("stabilizer.stop", 1)
    drone.firmware.advance(120)
    drone.write("stabilizer.stop", 0)
    stays_locked(drone)


def test_a_flipped_drone_is_crashed_and_flies_again_after_recovery():
    drone = hovering()
    drone.write("ctrlLee.KR_x", -0.02)  # it turns over and falls on its back
    drone.run(2.5)
    assert drone["acc.z"] < -0.5
    assert drone.info & (TUMBLED | CRASHED | CAN_FLY | ARMED) == TUMBLED | CRASHED
    assert drone.motors == [0] * 4
    assert drone.ask(wire.SUPERVISOR, 1, b"\x02") == [b"\x82\x00\x00"]  # refused: still on its back
    assert drone.takeoff() == EBUSY
    drone.write("ctrlLee.KR_x", 0.007)
    drone.flight.state[at.POS : at.POS + 3] = 0.0, 0.0, 0.02
    drone.flight.state[at.VEL : at.VEL + 3] = drone.flight.state[at.OMEGA : at.OMEGA + 3] = 0.0
    drone.flight.state[at.QUAT : at.QUAT + 4] = 1.0, 0.0, 0.0, 0.0  # somebody puts it on its feet
    drone.flight.state[at.ASLEEP] = 0.0
    drone.run(2.5)
    assert drone.info & (TUMBLED | CRASHED) == CRASHED  # until a client says so
    assert drone.ask(wire.SUPERVISOR, 1, b"\x02") == [b"\x82\x01\x01"]
    drone.run(0.5)
    assert drone.info & (CRASHED | AUTO | ARMED | CAN_FLY) == AUTO | ARMED | CAN_FLY
    drone.notify_stop()
    assert drone.takeoff() == 0
    drone.run(4.0)
    assert drone.height == pytest.approx(1.0, abs=0.05)


def test_without_the_tumble_check_nothing_stops_a_flipped_drone():
    drone = hovering(supervisor__tmblChckEn=0)
    drone.write("ctrlLee.KR_x", -0.02)
    drone.run(2.5)
    assert drone.info & (TUMBLED | CRASHED | CAN_FLY) == CAN_FLY


BRUSHLESS = {"platform": "cf21bl"}


def test_a_brushless_drone_arms_spins_idles_and_goes_through_the_recorded_bits():
    """0x201, 0x202, 0x20a, 0x11a: recorded from the real firmware (lee_brushless_39g); idle thrust 7000."""
    drone = Drone(BRUSHLESS, stabilizer__controller=LEE)
    assert drone.info == 0x0201
    assert drone.motors == [0] * 4
    assert drone.takeoff() == EBUSY
    assert drone.arm() == (1, 1)
    bits = drone.watch(1.0, ["supervisor.info"])[:, 0].astype(int)
    assert [b for b in dict.fromkeys(bits) if b != 0x203] == [0x202, 0x20A]  # 0x203: until the next update
    assert 200 <= 10 * np.sum(bits == 0x202) <= 700  # ms: up to speed, and 200 ms of that
    assert drone.motors == [7000] * 4
    drone.run(1.0)
    assert drone.height == pytest.approx(0.0, abs=1e-3)
    assert drone.takeoff() == 0
    drone.run(1.0)
    assert drone.info == 0x011A
    assert drone.arm(False) == (1, 0)  # in the air: it falls, and that is the end
    drone.run(1.0)
    assert drone.info & LOCKED


@pytest.mark.parametrize("charge", [0.15, 1.0])
def test_a_brushless_drone_idles_within_those_limits_on_an_empty_and_on_a_full_battery(charge):
    drone = Drone({**BRUSHLESS, "battery": {"charge": charge}})
    drone.arm()
    drone.run(1.0)
    assert drone.info & CAN_FLY
    assert 1000 < drone["motor.m1_rpm"] < 3500


@pytest.mark.parametrize(("constant", "turns"), [(6e-7, "slow"), (2e-8, "fast")])
def test_rotors_too_slow_or_too_fast_for_2_s_after_arming_are_refused(constant, turns):
    """1000 to 3500 rpm for 200 ms."""
    drone = Drone({**BRUSHLESS, "vehicle": {"rotor_constant": constant}})
    drone.arm()
    drone.run(1.9)
    assert drone.info & (CAN_FLY | ARMED) == ARMED
    rpm = drone["motor.m1_rpm"]
    assert rpm < 1000 if turns == "slow" else rpm > 3500
    drone.run(0.4)
    assert not drone.info & (CAN_FLY | ARMED)
    assert drone.motors == [0] * 4


def test_an_armed_drone_that_does_not_fly_disarms_after_30_s_and_a_landed_one_after_3_s():
    drone = Drone(BRUSHLESS, stabilizer__controller=LEE)
    drone.arm()
    drone.run(30.0, every=0.1)
    assert drone.info & ARMED
    drone.run(1.5)
    assert not drone.info & ARMED
    assert drone.motors == [0] * 4
    drone.arm()
    drone.run(1.0)
    drone.takeoff(0.5, 1.5)
    drone.run(2.0)
    drone.ask(wire.SETPOINT_HIGH_LEVEL, 0, struct.pack("<BBff?f", 8, 0, 0.0, 0.0, True, 1.5))
    drone.run(1.7 + 2.0 + 2.0)  # landed; 2 s below idle before it says so
    assert drone.info & (ARMED | FLYING) == ARMED
    assert drone.motors == [7000] * 4
    drone.run(2.5)
    assert not drone.info & ARMED
    assert drone.motors == [0] * 4


# Sections 9 and 10: variables and parameters


def test_a_mass_15_percent_low_hangs_0_24_m_low():
    """[M, bindings]."""
    drone = hovering(MEASURED, ctrlLee__mass=0.85 * 0.029)
    assert drone.height - 1.0 == pytest.approx(-0.24, abs=0.015)


def test_an_inertia_of_ten_times_changes_nothing_one_can_see():
    """[M, bindings]: 0.5 m circle, 4 s period."""
    paths = []
    for scale in (1.0, 10.0):
        believed = {f"ctrlLee__J_{a}": scale * j for a, j in zip("xyz", PLATFORMS["cf2"].inertia, strict=True)}
        drone = Drone(MEASURED, stabilizer__controller=LEE, **believed)
        drone.run(3.0, lambda t: full_state((0, 0, min(1.0, t / 2))))
        paths.append(drone.watch(6.0, [f"stateEstimate.{a}" for a in "xyz"], circle))
    assert np.ptp(paths[0][:, 0]) == pytest.approx(1.0, abs=0.1)
    assert np.abs(paths[0] - paths[1]).max() < 0.01


def test_a_mass_pushed_in_flight_lifts_the_drone_from_0_27_to_0_03_m_below():
    """[M, SITL]: 34 g, believed 29 g, then 34 g."""
    table = {**MEASURED, "vehicle": {"mass": 0.034, "motor_time_constant": 0.03}}
    drone = Drone(table, stabilizer__controller=LEE)
    drone.run(3.0, lambda t: full_state((0, 0, min(1.0, t / 2))))
    before = drone.watch(6.0, ["stateEstimate.z"], circle)[200:].mean() - 1.0
    drone.write("ctrlLee.mass", 0.034)
    after = drone.watch(6.0, ["stateEstimate.z"], circle)[200:].mean() - 1.0
    assert before == pytest.approx(-0.27, abs=0.03)
    assert abs(after) < 0.04


@pytest.mark.parametrize(("platform", "factor"), [("cf2", 0.967), ("cf21bl", 1.61)])
def test_mellingers_mass_thrust_makes_0_967_and_1_61_of_the_wanted_force(platform, factor):
    """With ki_z = 0 the height error is what kp_z = 1.25 N/m must make up for."""
    drone = hovering({**MEASURED, "platform": platform}, MELLINGER, ctrlMel__ki_z=0.0)
    weight = PLATFORMS[platform].mass * 9.81
    assert drone.height - 1.0 == pytest.approx(weight * (1.0 - 1.0 / factor) / 1.25, abs=0.012)


def test_default_pid_hovers_at_the_request_of_its_weight_and_full_scale():
    """Legacy units are 65535 = THRUST_MAX a motor, whatever the controller."""
    for platform in ("cf2", "cf21bl"):
        drone = hovering({"platform": platform}, PID)
        request = drone.watch(1.0, ["controller.cmd_thrust"]).mean()
        constants = PLATFORMS[platform]
        assert request == pytest.approx(constants.mass * 9.81 / 4 / constants.thrust_max * 65535, rel=0.02)
        assert drone.height == pytest.approx(1.0, abs=0.06)


# Section 12: what a host can rebuild


@pytest.mark.parametrize("platform", ["cf2", "cf21bl"])
def test_force_from_the_motor_log_is_lees_and_the_truth(platform):
    """[M, SITL]: means .2910, .2909, .2905 N (cf21), .3922, .3920, .3923 N (cf21bl); F rms .009 N = the rotor lag;
    torques rebuilt from motor.m* correlate with ctrlLee.torque* by .996 to 1.000."""
    constants = PLATFORMS[platform]
    drone = Drone({**MEASURED, "platform": platform}, stabilizer__controller=LEE)
    if platform == "cf21bl":
        drone.arm()
        drone.run(1.0)
    drone.run(3.0, lambda t: full_state((0, 0, min(1.0, t / 2))))
    names = [*(f"motor.m{n}" for n in range(1, 5)), "pm.vbat", "ctrlLee.thrustSi"]
    names += [f"ctrlLee.torque{a}" for a in "xyz"]
    rows, true = [], []
    for n in range(1000):
        if n % 2 == 0:
            drone.ask(wire.SETPOINT_GENERIC, 0, circle(0.01 * n))
        drone.firmware.advance(10)
        rows.append([drone[name] for name in names])
        true.append(drone.flight.truth_row()[drone.flight.truth_header.index("F")])
    log, true = np.array(rows), np.array(true)
    volts = log[:, :4] / 65535 * log[:, 4:5]
    f = np.maximum(0, np.polynomial.polynomial.polyval(volts, constants.curve))
    d, k = 0.707106781 * constants.arm_length, constants.torque_per_thrust
    torque = f @ np.array([[-d, -d, -k], [-d, d, k], [d, d, -k], [d, -d, k]])
    assert f.sum(axis=1).mean() == pytest.approx(log[:, 5].mean(), rel=0.01)
    assert f.sum(axis=1).mean() == pytest.approx(true.mean(), rel=0.01)
    assert np.sqrt(np.mean((f.sum(axis=1) - true) ** 2)) < 0.015
    for axis in range(3):
        assert np.corrcoef(torque[:, axis], log[:, 6 + axis])[0, 1] > 0.99
