"""Power distribution: undone by the host's formulas it must give back what the controller asked for."""

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import parameters, variables
from firmware_sim.controllers.externalise import log_rotor_speed
from firmware_sim.controllers.power_distribution import motor_volts, motors_step
from firmware_sim.plant import layout as at
from firmware_sim.plant.platforms import PLATFORMS
from firmware_sim.scenario import Scenario, parse_scenario

NANODRONE = Path(__file__).resolve().parents[3] / "shared" / "recordings" / "nanodrone" / "raw"


class Board:
    """The power distribution of a platform with its arrays."""

    def __init__(self, platform: str = "cf2", volts: float = 3.9) -> None:
        self.constants = PLATFORMS[platform]
        self.board = Scenario(platform=platform).board()
        self.state, self.sensor = np.zeros(at.STATE_SIZE), np.zeros(at.SENSOR_SIZE)
        self.memory, self.log = np.zeros(mem.MEMORY_SIZE), np.zeros(len(variables.ALL_VARIABLES))
        self.param = np.array([parameters.defaults(platform)[name] for name in parameters.PARAMETER_NAMES])
        self.noise = np.zeros(at.NOISE_WIDTH)
        self.sensor[at.VBAT] = self.sensor[at.VBAT_FILTERED] = volts
        self.volts = volts

    def run(self, *, allowed: bool = True, armed: bool = True) -> np.ndarray:
        """One step; the four PWM ratios."""
        motors_step(self.board, self.state, self.sensor, self.param, self.memory, self.log, allowed, armed)
        return self.state[at.PWM : at.PWM + 4].copy()

    def ask(self, thrust: float, torque: tuple[float, float, float]) -> np.ndarray:
        """PWM for a force in N and torques in N m."""
        self.memory[mem.MODE] = mem.FORCE_TORQUE_MODE
        self.memory[mem.WRENCH : mem.WRENCH + 4] = thrust, *torque
        return self.run()

    def legacy(self, thrust: float, roll: float, pitch: float, yaw: float) -> np.ndarray:
        """Requests before compensation, recovered from the PWM with the thrust curve."""
        self.memory[mem.MODE] = mem.LEGACY_MODE
        self.memory[mem.LEGACY : mem.LEGACY + 4] = thrust, roll, pitch, yaw
        pwm = self.run()
        curve = np.polynomial.Polynomial(self.constants.curve)
        return curve(pwm / 65535 * self.volts) / self.constants.thrust_max * 65535


def reconstruct(board: Board, pwm: np.ndarray) -> tuple[float, float, float, float]:
    """F, Mx, My, Mz as a host rebuilds them from motor.m* and the battery voltage."""
    c = board.constants
    v = pwm / 65535 * board.volts
    f1, f2, f3, f4 = np.where(pwm == 0, 0, np.maximum(0, np.polynomial.polynomial.polyval(v, c.curve)))
    d, k = 0.707106781 * c.arm_length, c.torque_per_thrust
    return f1 + f2 + f3 + f4, d * (-f1 - f2 + f3 + f4), d * (-f1 + f2 + f3 - f4), k * (-f1 + f2 - f3 + f4)


@given(
    platform=st.sampled_from(["cf2", "cf21bl"]),
    volts=st.floats(3.2, 4.2),
    thrust=st.floats(0.15, 0.4),
    torque=st.tuples(st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3), st.floats(-3e-4, 3e-4)),
)
def test_force_and_torque_are_recovered(platform: str, volts: float, thrust: float, torque: tuple) -> None:
    board = Board(platform, volts)
    pwm = board.ask(thrust, torque)
    assume(pwm.max() < 65535 and board.log[variables.MOTOR_REQ : variables.MOTOR_REQ + 4].min() > 0)
    F, *M = reconstruct(board, pwm)
    assert pwm.max() == pwm.max().round()
    assert thrust == pytest.approx(F, abs=4e-5)  # integer steps of thrust and PWM
    assert torque == pytest.approx(M, abs=2e-6)


def test_cubic_is_inverted_over_the_whole_range() -> None:
    for platform, constants in PLATFORMS.items():
        board = Scenario(platform=platform).board()
        for f in np.linspace(constants.thrust_min, 2 * constants.thrust_max, 50):
            roots = np.polynomial.Polynomial([constants.curve[0] - f, *constants.curve[1:]]).roots()
            real = roots[np.abs(roots.imag) < 1e-9].real
            assert motor_volts(board, f) == pytest.approx(real[0], rel=1e-9)


def test_legacy_mixer() -> None:
    got = Board().legacy(30000, 4001.0, 2001.0, 700.0)  # halves truncate to 2000 and 1000
    assert got == pytest.approx(
        [30000 - 2000 + 1000 + 700, 30000 - 3000 - 700, 30000 + 2000 - 1000 + 700, 32300], abs=4
    )


def test_below_the_least_thrust_the_motor_stands() -> None:
    board = Board()
    assert board.ask(4 * 0.0127, (0, 0, 0)).tolist() == [0, 0, 0, 0]
    assert board.ask(4 * 0.0130, (0, 0, 0)).min() > 0


def test_too_much_is_taken_from_all_four() -> None:
    board = Board(volts=3.2)
    pwm = board.ask(0.75, (1e-3, 0, 0))
    request = board.log[variables.MOTOR_REQ : variables.MOTOR_REQ + 4]
    assert request.max() > 65535
    assert pwm.max() == 65535
    assert pwm == pytest.approx(request - (request.max() - 65535))


def test_voltage_filter_and_undervoltage() -> None:
    board = Board(volts=4.2)
    board.sensor[at.VBAT] = 3.2
    board.run()
    assert board.sensor[at.VBAT_FILTERED] == pytest.approx(4.2 - 0.01)
    board.sensor[at.VBAT] = board.sensor[at.VBAT_FILTERED] = 1.9
    assert board.ask(0.3, (0, 0, 0)).tolist() == [0, 0, 0, 0]


def test_idle_thrust_only_where_arming_is_required() -> None:
    brushed, brushless = Board("cf2"), Board("cf21bl")
    brushed.param[parameters.IDLE_THRUST] = 9000
    assert brushed.run(allowed=False).tolist() == [0] * 4
    assert brushless.run().tolist() == [7000] * 4
    assert brushless.run(allowed=False, armed=True).tolist() == [0] * 4  # stopped is stopped
    assert brushless.run(allowed=True, armed=False).tolist() == [0] * 4
    brushless.param[parameters.IDLE_THRUST] = 3000
    assert brushless.run().tolist() == [3000] * 4


def test_motor_power_set_overrides_the_controller() -> None:
    board = Board()
    board.param[parameters.POWER_SET : parameters.POWER_SET + 5] = 1, 100, 200, 300, 400
    assert board.run().tolist() == [100, 200, 300, 400]
    board.param[parameters.POWER_SET] = 2
    assert board.run().tolist() == [100] * 4
    board.param[parameters.POWER_SET : parameters.POWER_SET + 2] = 3, 30000
    expected = np.polynomial.Polynomial(board.constants.curve)(board.run() / 65535 * 3.9) / 0.12 * 65535
    assert expected == pytest.approx([30000] * 4, abs=4)


def test_what_is_not_a_number_stops_the_motors() -> None:
    assert Board().ask(float("nan"), (0, 0, 0)).tolist() == [0, 0, 0, 0]


@pytest.mark.skipif(not NANODRONE.is_dir(), reason="the shared recordings are not beside this checkout")
def test_rotors_at_rest_turn_as_fast_as_those_of_real_brushless_drones() -> None:
    """Idle stretches (duty 10000/65535 on all four) of the raw runs: median speed against ours at that voltage."""
    board, ratios = Board("cf21bl"), []
    for path in sorted(NANODRONE.glob("*.csv.gz")):
        with gzip.open(path, "rt") as file:
            rows = list(csv.DictReader(file))
        idle = [all(abs(float(r[f"m{i}_thrust"] or "nan") - 10000 / 65535) < 2e-4 for i in range(1, 5)) for r in rows]
        edges = np.flatnonzero(np.diff([0, *idle, 0]))
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            if b - a < 60:
                continue
            part = rows[a + 40 : b]  # spun down
            real = np.array([float(r[f"m{i}_erpm"] or 65535) / 6 for r in part for i in range(1, 5)])
            volts = np.median([float(r["Vbat"]) for r in part if r["Vbat"]]) * 10000 / 65535
            truth = np.zeros(at.TRUTH_SIZE)
            truth[at.ROTOR_CONSTANT], truth[at.RPM_SCALE : at.RPM_SCALE + 4] = board.constants.rotor_constant, 1.0
            board.state[at.ROTOR : at.ROTOR + 4] = np.polynomial.polynomial.polyval(volts, board.constants.curve)
            log_rotor_speed(truth, board.board, board.state, board.noise, board.log)
            ratios.append(np.median(real[real < 10000]) / board.log[variables.RPM])
    assert len(ratios) == 11
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.01)
    assert np.std(ratios) < 0.01


def test_a_share_of_the_reports_cannot_be_read_and_is_65535() -> None:
    """MOTORS_RPM_INVALID; in Busetto's flights 191 of 263,764 were missing."""
    assert Scenario(platform="cf21bl").sensors.rotor_speed_invalid == pytest.approx(191 / 263764, rel=0.05)
    board, noise = Board("cf21bl"), np.random.default_rng(1)
    truth = parse_scenario({"platform": "cf21bl", "sensors": {"rotor_speed_invalid": 0.1}}, "test").truth()
    board.state[at.ROTOR : at.ROTOR + 4] = 0.1
    seen = []
    for _ in range(2000):
        log_rotor_speed(truth, board.board, board.state, noise.standard_normal(at.NOISE_WIDTH), board.log)
        seen.append(board.log[variables.RPM : variables.RPM + 4].copy())
    lost = np.array(seen) == 65535.0
    assert lost.mean(axis=0) == pytest.approx([0.1] * 4, abs=0.02)
    assert len(np.unique(np.array(seen)[~lost])) == 1
    for share, expected in ((0.0, False), (1.0, True)):
        truth = parse_scenario({"platform": "cf21bl", "sensors": {"rotor_speed_invalid": share}}, "test").truth()
        log_rotor_speed(truth, board.board, board.state, noise.standard_normal(at.NOISE_WIDTH), board.log)
        assert np.all((board.log[variables.RPM : variables.RPM + 4] == 65535.0) == expected)


def test_reported_speeds_are_the_thrust_law_in_flight() -> None:
    board = Board("cf21bl")
    truth = np.zeros(at.TRUTH_SIZE)
    truth[at.ROTOR_CONSTANT], truth[at.RPM_SCALE : at.RPM_SCALE + 4] = 3.72e-8, 1.0
    for thrust in (board.constants.thrust_min, 0.1, 0.2):
        board.state[at.ROTOR : at.ROTOR + 4] = thrust
        log_rotor_speed(truth, board.board, board.state, board.noise, board.log)
        assert board.log[variables.RPM] == int(np.sqrt(thrust / 3.72e-8) * 30 / np.pi)
