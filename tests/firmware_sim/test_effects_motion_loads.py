"""Suspended loads, the floor, gusts and vibration, against the plain model of `motion_model.py` and by hand."""

import numpy as np
import pytest
from motion_model import INERTIA, MASS, PLAIN, STILL, C, G, Model, about_origin, advance, compare, matrix, plant, seen
from scipy.spatial.transform import Rotation

from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.step import plant_step_with_effects
from firmware_sim.plant.quaternion import turn
from firmware_sim.scenario import parse_scenario


@pytest.mark.parametrize("c", [(0.0, 0.0, 0.0), C])
def test_suspended_load(c: tuple[float, ...]) -> None:
    wind = (1.0, 0.5, 0.0)
    effects = {
        "suspended_load": {"mass": 0.006, "length": 0.25},
        "center_of_mass": dict(zip("xyz", c)),
        "linear_drag": {"x": 0.01, "y": 0.01, "z": 0.01},
        "wind": dict(zip("xyz", wind)),
    }
    truth, x, _ = plant(effects)
    n = np.array([0.6, -0.3, -0.8])
    n /= np.linalg.norm(n)
    x[at.LOAD : at.LOAD + 3], x[at.LOAD_RATE : at.LOAD_RATE + 3] = n, np.cross(n, [2.0, 1.0, -3.0])
    model = Model(
        J_origin=about_origin(MASS, matrix(INERTIA), np.array(c)),
        c=c, load=(0.006, 0.25), friction=0.1, air=wind, force=lambda p, v, w,
        R: (-0.01 * (v - np.array(wind)), np.zeros(3)),
    )  # fmt: skip
    compare(model, truth, x, tolerance=2e-6)


def energy_and_momentum(truth: np.ndarray, x: np.ndarray, length: float) -> tuple[float, np.ndarray]:
    s, m, ml = seen(truth, x), truth[at.MASS], truth[at.LOAD_MASS]
    w, J = s[10:13], truth[at.INERTIA : at.INERTIA + 9].reshape(3, 3)
    p, v = s[:3] + length * s[13:16], s[3:6] + length * s[16:19]
    body_p, body_v = x[at.POS : at.POS + 3], x[at.VEL : at.VEL + 3]
    energy = 0.5 * m * body_v @ body_v + 0.5 * w @ J @ w + 0.5 * ml * v @ v + 9.81 * (m * body_p[2] + ml * p[2])
    return energy, m * body_v + ml * v


def test_a_wild_pendulum_keeps_energy_and_momentum() -> None:
    truth, x, _ = plant({"suspended_load": {"mass": 0.02, "length": 0.1}, "center_of_mass": dict(zip("xyz", C))})
    truth[at.LOAD_FRICTION] = 0.0
    x[at.PWM : at.PWM + 4] = 0.0
    x[at.OMEGA : at.OMEGA + 3] = 10.0, -8.0, 6.0
    x[at.LOAD_RATE : at.LOAD_RATE + 3] = 15.0, 10.0, 0.0  # 1.8 m/s
    energy, momentum = energy_and_momentum(truth, x, 0.1)
    advance(truth, x, 2000)
    end_energy, end_momentum = energy_and_momentum(truth, x, 0.1)
    assert end_energy == pytest.approx(energy, rel=2e-4)
    assert end_momentum == pytest.approx(momentum + 2.0 * 0.05 * G, abs=1e-6)
    n, rate = x[at.LOAD : at.LOAD + 3], x[at.LOAD_RATE : at.LOAD_RATE + 3]
    assert (n @ n, n @ rate) == pytest.approx((1.0, 0.0), abs=1e-12)


def test_process_noise_of_a_loaded_drone_is_an_impulse_through_the_string() -> None:
    effects = {"suspended_load": {"mass": 0.02, "length": 0.2}, "center_of_mass": dict(zip("xyz", C))}
    truth, x, _ = plant(effects)
    truth[at.NOISE_THRUST], truth[at.NOISE_TORQUE : at.NOISE_TORQUE + 3] = 2e-3, 1e-5
    turn(x, at.QUAT, 0.3, -0.2, 0.1)
    n = np.array([0.5, 0.4, -0.7])
    x[at.LOAD : at.LOAD + 3] = n / np.linalg.norm(n)
    kicked, noise = x.copy(), STILL.copy()
    noise[at.N_THRUST], noise[at.N_TORQUE : at.N_TORQUE + 3] = 1.3, (0.7, -1.1, 0.4)
    advance(truth, x, 1)
    plant_step_with_effects(truth, kicked, noise, 1e-3)
    change = energy_and_momentum(truth, kicked, 0.2)[1] - energy_and_momentum(truth, x, 0.2)[1]
    up = Rotation.from_quat(seen(truth, x)[6:10]).as_matrix()[:, 2]
    assert change == pytest.approx(up * 2e-3 * np.sqrt(1e-3) * 1.3, rel=1e-6, abs=1e-10)
    load = [seen(truth, s)[3:6] + 0.2 * seen(truth, s)[16:19] for s in (x, kicked)]
    jump = load[1] - load[0]  # the string pulls along itself only
    assert np.cross(jump, x[at.LOAD : at.LOAD + 3]) == pytest.approx(np.zeros(3), abs=1e-7)
    assert np.linalg.norm(jump) > 1e-4


def on_the_floor(effects: dict, thrust: float) -> tuple[np.ndarray, np.ndarray]:
    """A drone that stands, with four rotors of `thrust` N each once a command comes."""
    vehicle = PLAIN["vehicle"] | {"thrust_curve": [thrust], "motor_time_constant": 0.0}
    table = {"effects": effects, "vehicle": vehicle, "noise": PLAIN["noise"]}
    scenario = parse_scenario(table, "test")
    x = scenario.start_state()
    x[at.PWM : at.PWM + 4] = 1000
    return scenario.truth(), x


@pytest.mark.parametrize(
    ("effects", "mass"),
    [
        ({"payload": {"mass": 0.01, "z": -0.02}}, 0.04),
        ({"suspended_load": {"mass": 0.01, "length": 0.3}}, 0.04),
        ({"center_of_mass": {"x": 0.0, "y": 0.0, "z": -0.005}}, 0.03),
    ],
)
def test_the_floor_carries_body_and_load(effects: dict, mass: float) -> None:
    truth, x = on_the_floor(effects, 0.97 * mass * 9.81 / 4)
    advance(truth, x, 1500)
    assert abs(seen(truth, x)[2]) < 1e-3
    assert np.abs(seen(truth, x)[[0, 1]]).max() < 2e-3
    truth, x = on_the_floor(effects, 1.05 * mass * 9.81 / 4)
    advance(truth, x, 1000)
    assert seen(truth, x)[2] == pytest.approx(0.5 * 0.05 * 9.81, rel=0.2)


def test_a_centre_of_mass_off_the_middle_stands_tilted_by_less_than_a_degree_and_feels_gravity() -> None:
    truth, x = on_the_floor({"center_of_mass": {"x": 0.01, "y": 0.0, "z": 0.0}}, 0.0)
    advance(truth, x, 1500)
    assert 2 * abs(x[at.QUAT + 2]) < np.radians(1.0)
    assert x[at.ACC : at.ACC + 3] == pytest.approx([0, 0, 9.81], abs=0.2)


def test_gusts_are_an_ornstein_uhlenbeck_process() -> None:
    truth, x, _ = plant({"gusts": {"standard_deviation": 0.8, "correlation_time": 0.05}})
    rng = np.random.default_rng(0)
    wind = np.empty((40_000, 3))
    start = x.copy()
    for n in range(len(wind)):
        gust, clock = x[at.GUST : at.GUST + 3].copy(), x[at.CLOCK]
        x[:] = start
        x[at.GUST : at.GUST + 3], x[at.CLOCK] = gust, clock
        plant_step_with_effects(truth, x, rng.standard_normal(at.NOISE_WIDTH), 1e-3)
        wind[n] = x[at.GUST : at.GUST + 3]
    assert wind.std(axis=0) == pytest.approx([0.8] * 3, rel=0.12)  # 400 independent values: 3.5 %
    late = (wind[50:] * wind[:-50]).mean(axis=0) / wind.var(axis=0)
    assert late == pytest.approx([np.exp(-1.0)] * 3, abs=0.1)
    assert np.abs(np.corrcoef(wind.T) - np.eye(3)).max() < 0.25


def test_gusts_use_no_noise_of_others() -> None:
    rows = np.random.default_rng(1).standard_normal((50, at.NOISE_WIDTH))
    truth, x, _ = plant({"gusts": {"standard_deviation": 1.0, "correlation_time": 1.0}})
    others = [i for i in range(at.NOISE_WIDTH) if not at.N_GUST <= i < at.N_GUST + 3]
    y = x.copy()
    for row in rows:
        plant_step_with_effects(truth, x, row, 1e-3)
        masked = row.copy()
        masked[others] = 0.0
        plant_step_with_effects(truth, y, masked, 1e-3)
    assert np.array_equal(x[at.GUST : at.GUST + 3], y[at.GUST : at.GUST + 3])
    assert np.any(x[at.GUST : at.GUST + 3] != 0)


def test_vibration_turns_with_its_rotor() -> None:
    truth, x, _ = plant({}, {"vibration": {"rotor": 3, "torque": 2e-4}}, inertia=[2e-5, 2e-5, 3e-5])
    x[at.OMEGA : at.OMEGA + 3] = 0.0
    x[at.PWM : at.PWM + 4] = 30000.0
    rates = []
    for _ in range(2000):
        plant_step_with_effects(truth, x, STILL, 1e-3)
        rates.append(x[at.OMEGA : at.OMEGA + 2].copy())
    speed = np.sqrt(0.03 * 30000 / 65535 * 4.2 / 2e-8)
    rates = np.array(rates) - np.mean(rates, axis=0)
    signal = rates[:, 0] + 1j * rates[:, 1]
    phase = np.exp(-1j * speed * 1e-3 * np.arange(1, 2001))
    assert abs((signal * phase).mean()) == pytest.approx(2e-4 / (2e-5 * speed), rel=0.01)
    assert abs((signal * phase.conj()).mean()) < 0.05 * abs((signal * phase).mean())  # counter-clockwise only
