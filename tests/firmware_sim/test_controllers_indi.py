"""INDI: its low pass against SciPy's, its law against a plain version, g1 against the plant, and flights."""

import math

import numpy as np
import pytest
from flights import boot, hold, read
from scipy.signal import bilinear, butter, lfilter, lfilter_zi
from scipy.spatial.transform import Rotation

from firmware_sim.commander import setpoint as sp
from firmware_sim.controllers import indi, indi_position
from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import parameters as pm
from firmware_sim.controllers import variables as lv
from firmware_sim.controllers.power_distribution import motors_step
from firmware_sim.controllers.tick import plant_step
from firmware_sim.flight import Flight
from firmware_sim.plant import layout as at
from firmware_sim.plant.platforms import PLATFORMS

RATE = 500.0
NED = np.diag([1.0, -1.0, -1.0])
QUIET = {"noise": {"thrust": 0.0, "torque": 0.0}}


# The filter


@pytest.mark.parametrize("cutoff", [8.0, 30.0])
def test_the_low_pass_is_scipys_butterworth(cutoff: float) -> None:
    """But for a quality of 0.7071 where sqrt(1/2) is meant: 1e-5."""
    memory, given = np.zeros(7), np.random.default_rng(0).standard_normal(400)
    indi_position.design(memory, 0, cutoff, RATE)
    out = np.array([indi_position.butterworth(memory, 0, 3, value) for value in given])
    b, a = butter(2, cutoff, fs=RATE)
    assert memory[:3] == pytest.approx([a[1], a[2], b[0]], rel=2e-5)
    assert out == pytest.approx(lfilter(b, a, given), abs=2e-5)


# The law


class LowPass:
    """A vector through 1/(s^2/w^2 + s/(w Q) + 1), bilinear, by SciPy."""

    def __init__(self, cutoff: float, size: int) -> None:
        w = 2.0 * RATE * math.tan(math.pi * cutoff / RATE)
        self.b, self.a = bilinear([1.0], [1.0 / w**2, 1.0 / (w * 0.7071), 1.0], RATE)
        self.z = np.zeros((len(lfilter_zi(self.b, self.a)), size))
        self.out = self.before = np.zeros(size)

    def __call__(self, value: np.ndarray) -> np.ndarray:
        self.before = self.out
        out, self.z = lfilter(self.b, self.a, np.atleast_2d(value), axis=0, zi=self.z)
        self.out = out[0]
        return self.out


class Plain:
    """controller_indi.c and position_controller_indi.c as vectors, forward-right-down, with their defaults."""

    g1, g2 = np.array([0.0066146, 0.0052125, 0.001497]), 0.000043475
    act_dyn = 0.03149

    def __init__(self) -> None:
        self.rate, self.sent, self.acc, self.angle = (LowPass(8.0, 3) for _ in range(4))
        self.lifted = LowPass(8.0, 1)
        self.act, self.du_yaw, self.lift, self.lift_act = np.zeros(3), 0.0, 0.0, 0.0

    def outer(self, place: np.ndarray, p: np.ndarray, v: np.ndarray, acc: np.ndarray, angle: np.ndarray) -> tuple:
        wanted = 5.0 * (1.0 * (place - p) - v)
        f = self.angle(angle)

        def down(a: np.ndarray) -> np.ndarray:
            return Rotation.from_euler("ZYX", [a[2], a[1], a[0]]).as_matrix()

        missing = wanted - (down(f) @ self.acc(acc) + [0.0, 0.0, 9.81])
        step = 1e-6  # the derivative of -9.81 M e3 by roll and pitch, and M e3 for thrust
        columns = [-9.81 * (down(f + step * e) - down(f - step * e))[:, 2] / (2 * step) for e in np.eye(3)[:2]]
        gain = np.linalg.pinv(np.column_stack([*columns, down(f)[:, 2]])) @ missing
        self.lift_act += self.act_dyn * (self.lifted(np.array([self.lift]))[0] - self.lift_act)
        self.lift = float(np.clip(self.lift_act - gain[2] / 0.0002473, 0.0, 60000.0))
        return np.clip(f[:2] + gain[:2], -math.radians(10.0), math.radians(10.0)), self.lift

    def step(self, tilts: np.ndarray, yaw: float, angle: np.ndarray, rate: np.ndarray) -> np.ndarray:
        wanted = 24.0 * (5.0 * (np.array([*tilts, yaw]) - angle) - rate)
        slope = (self.rate(rate) - self.rate.before) * RATE
        sent = self.sent(self.act)
        du = (wanted - slope) / self.g1
        self.du_yaw = (wanted[2] - slope[2] + self.g2 * self.du_yaw) / (self.g1[2] + self.g2)
        du[2] = self.du_yaw
        u = np.clip(sent + du, -32000.0, 32000.0)
        self.act = self.act + self.act_dyn * (u - self.act)
        return u


def controller() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parameters at boot, memory as after a switch to INDI, log."""
    boot = pm.defaults("cf2")
    param, memory = np.array([boot[name] for name in pm.PARAMETER_NAMES]), np.zeros(mem.MEMORY_SIZE)
    indi.reset(param, memory)
    return param, memory, np.zeros(len(lv.ALL_VARIABLES))


def test_every_command_is_the_plain_versions() -> None:
    """300 steps of any motion, a place and a heading: commands to 1e-9 of their size, thrust to 1e-6 of it."""
    param, memory, log = controller()
    plain, rng = Plain(), np.random.default_rng(1)
    setpoint, estimate, sensor = sp.null_setpoint(), np.zeros(at.ESTIMATE_SIZE), np.zeros(at.SENSOR_SIZE)
    setpoint[sp.MODE_X : sp.MODE_Z + 1] = setpoint[sp.MODE_YAW] = sp.ABSOLUTE
    place = np.array([0.3, -0.2, 1.0])
    setpoint[sp.X : sp.Z + 1], setpoint[sp.YAW] = place, 20.0
    p, v, a = rng.normal(0, 0.2, 3), rng.normal(0, 0.2, 3), np.array([0.1, -0.1, 0.3])
    for tick in range(0, 600, 2):
        p, v = p + rng.normal(0, 1e-3, 3), v + rng.normal(0, 1e-2, 3)
        a = a + rng.normal(0, 5e-3, 3)
        rate, acc = rng.normal(0, 0.5, 3), np.array([0.0, 0.0, 9.81]) + rng.normal(0, 0.5, 3)
        q = Rotation.from_euler("ZYX", a[::-1]).as_quat()
        estimate[at.E_POS : at.E_POS + 6] = *p, *v
        estimate[at.E_QUAT : at.E_QUAT + 4] = q[3], *q[:3]
        sensor[at.GYRO : at.GYRO + 3], sensor[at.ACCEL : at.ACCEL + 3] = rate, acc
        indi.indi_step(setpoint, estimate, sensor, param, memory, log, tick)
        angle = NED @ a
        tilts, lift = plain.outer(NED @ place, NED @ p, NED @ v, NED @ acc, angle)
        u = plain.step(tilts, -math.radians(20.0), angle, NED @ rate)
        assert memory[mem.LEGACY] == pytest.approx(lift, rel=1e-6, abs=0.1)
        assert memory[mem.INDI_TILTS : mem.INDI_TILTS + 2] == pytest.approx(tilts, abs=1e-8)
        assert memory[mem.INDI_U : mem.INDI_U + 3] == pytest.approx(u, rel=1e-6, abs=1e-2)
        assert memory[mem.LEGACY + 1 : mem.LEGACY + 4] == pytest.approx(np.trunc(u), abs=1.0)
    names = ("cmd_thrust", "du_r", "u_act_dyn_r", "n_r", "Omega_f_q")
    seen = [log[lv.VARIABLE_INDEX[f"ctrlINDI.{name}"]] for name in names]
    expected = [plain.lift, plain.du_yaw, plain.act[2], -math.radians(20.0), plain.rate.out[1]]
    assert seen == pytest.approx(expected, rel=1e-6)
    assert (
        log[lv.VARIABLE_INDEX["ctrlINDI.r_yaw"]] == log[lv.VARIABLE_INDEX["ctrlINDI.r_roll"]] == rate[0]
    )  # as the source has it
    assert log[lv.VARIABLE_INDEX["posCtrlIndi.T_incremented"]] == pytest.approx(plain.lift, rel=1e-6)


def test_thrust_below_the_threshold_holds_the_commands_at_zero() -> None:
    param, memory, log = controller()
    setpoint, estimate, sensor = sp.null_setpoint(), np.zeros(at.ESTIMATE_SIZE), np.zeros(at.SENSOR_SIZE)
    estimate[at.E_QUAT], setpoint[sp.ROLL] = 1.0, 20.0
    for thrust, still in ((299.0, True), (301.0, False), (0.0, True)):
        setpoint[sp.THRUST] = thrust
        indi.indi_step(setpoint, estimate, sensor, param, memory, log, 0)
        assert (memory[mem.INDI_U] == 0.0) == still
        assert memory[mem.LEGACY] == thrust


# The flight


def quiet(table: dict | None = None, **parameters: float) -> Flight:
    """A flight under INDI without process noise."""
    flight = boot(QUIET | (table or {}), stabilizer__controller=3, **parameters)
    flight.flying = True
    return flight


def hover(flight: Flight, seconds: float = 4.0, x: float = 0.0) -> np.ndarray:
    """At 1 m; position and body rate each 10 ms."""
    states = hold(flight, (x, 0.0, 1.0), seconds)
    return states[:, [*range(at.POS, at.POS + 3), *range(at.OMEGA, at.OMEGA + 3)]]


def effectiveness(platform: str) -> np.ndarray:
    """g1 by the mixer (power_distribution_quadrotor.c): two units of roll are one of each motor."""
    p = PLATFORMS[platform]
    unit, d = p.thrust_max / 65535.0, math.sqrt(0.5) * p.arm_length
    return np.array([2 * d, 2 * d, 4 * p.torque_per_thrust]) * unit / np.array(p.inertia)


@pytest.mark.parametrize("platform", ["cf2", "cf21bl"])
def test_hover_and_a_step_of_half_a_metre(platform: str) -> None:
    """Two cascaded first-order lags of 1/s and 5/s: 1.7 s after the step 0.4 m; no height lost."""
    flight = quiet({"platform": platform})
    seen = hover(flight, 6.0)
    assert seen[-1, :3] == pytest.approx([0.0, 0.0, 1.0], abs=0.03)
    seen = hover(flight, 1.7, x=0.5)
    assert seen[-1, 0] == pytest.approx(0.4, abs=0.04)
    assert seen[:, 2] == pytest.approx(np.ones(len(seen)), abs=0.03)


def test_a_step_of_the_command_accelerates_by_g1() -> None:
    """d(rate)/dt after a step of each command by hand, with rotors that follow at once, over the command: g1."""
    for axis, g1 in enumerate(effectiveness("cf2")):
        flight = quiet({"vehicle": {"motor_time_constant": 0.0}}, ctrlINDI__outerLoopActive=0)
        hover(flight, 0.1)
        flight.state[at.POS + 2], flight.state[at.ASLEEP], flight.state[at.FEET] = 5.0, 0.0, 0.0
        flight.state[at.VEL : at.OMEGA + 3] = 0.0
        flight.state[at.QUAT] = 1.0
        flight._memory[mem.MODE], flight._memory[mem.LEGACY] = mem.LEGACY_MODE, 38000.0
        before = flight.state[at.OMEGA + axis]
        flight._memory[mem.LEGACY + 1 + axis] = 2000.0

        for _ in range(10):
            motors_step(
                flight._board, flight.state, flight._sensor, flight._param, flight._memory, flight._log, True, True
            )
            flight.state[at.VOLTS] = flight._sensor[at.VBAT_FILTERED]  # a battery that is compensated for
            plant_step(flight._truth, flight.state, np.zeros(at.NOISE_WIDTH), 1e-3)
        sign = 1.0 if axis == 0 else -1.0
        assert sign * (flight.state[at.OMEGA + axis] - before) / 0.01 / 2000.0 == pytest.approx(g1, rel=0.02)


def believing(scale: float) -> Flight:
    """A flight whose controller believes so many times the true g1."""
    g1 = scale * effectiveness("cf2")
    return quiet(ctrlINDI__g1_p=g1[0], ctrlINDI__g1_q=g1[1], ctrlINDI__g1_r=g1[2])


@pytest.mark.parametrize(("scale", "falls"), [(0.7, False), (1.0, False), (1.5, False), (3.0, True)])
def test_g1_far_too_large_falls_and_near_the_truth_all_is_well(scale: float, falls: bool) -> None:
    flight = believing(scale)
    seen = np.vstack([hover(flight, 4.0), hover(flight, 2.0, x=0.5)])
    worst = np.abs(seen[-300:, 3:]).max()
    assert worst > 3.0 if falls else worst < 1.2


def test_g1_far_too_small_trembles() -> None:
    """The rates shake ten times as much as with the true one."""
    shaken = []
    for scale in (1.0, 0.3):
        shaken.append(hover(believing(scale), 5.0)[-200:, 3:5].std())
    assert shaken[1] > 10 * shaken[0]


def test_a_heading_by_rate_collapses_to_zero_as_in_the_source() -> None:
    flight = quiet()
    hover(flight, 3.0)
    flight.setpoint[sp.MODE_YAW], flight.setpoint[sp.RATE_YAW] = sp.VELOCITY, 45.0
    for _ in range(500):
        flight.step()
    assert read(flight, "ctrlINDI.n_r") == pytest.approx(math.radians(0.09), rel=0.1)
    assert abs(read(flight, "stabilizer.yaw")) < 2.0
