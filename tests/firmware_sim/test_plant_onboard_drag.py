"""kalman.dragB_* and kalman.cop_* in the onboard filter, and the barometer, against closed forms."""

import math

import numpy as np
import pytest

from firmware_sim.controllers import parameters as pm
from firmware_sim.controllers import variables as lv
from firmware_sim.controllers.externalise import BARO_NOISE, log_baro
from firmware_sim.plant import layout as at
from firmware_sim.plant.onboard_estimate import drag, integrate, predict

DT = 1e-3


def parameters(**values: float) -> np.ndarray:
    boot = pm.defaults("cf2") | {f"kalman.{name}": value for name, value in values.items()}
    return np.array([boot[name] for name in pm.PARAMETER_NAMES])


def estimate(velocity: tuple, yaw: float = 0.0, rate: tuple = (0.0, 0.0, 0.0)) -> np.ndarray:
    e = np.zeros(at.ESTIMATE_SIZE)
    e[at.E_VEL : at.E_VEL + 3] = velocity
    e[at.E_QUAT], e[at.E_QUAT + 3] = math.cos(yaw / 2), math.sin(yaw / 2)
    e[at.E_GYRO : at.E_GYRO + 3] = rate
    return e


def test_speed_decays_by_drag_b_a_second_in_body_axes() -> None:
    """v_n = v_0 (1 - dt dragB)^n; at a yaw of 90 degrees the body's x is the world's y."""
    e = estimate((1.0, 2.0, 3.0), math.pi / 2)
    for _ in range(500):
        drag(e, parameters(dragB_x=0.5, dragB_y=0.2, dragB_z=0.1), DT)
    expected = np.array([1.0, 2.0, 3.0]) * (1.0 - DT * np.array([0.2, 0.5, 0.1])) ** 500
    assert e[at.E_VEL : at.E_VEL + 3] == pytest.approx(expected, rel=1e-9)


def test_a_centre_of_pressure_off_the_centre_of_mass_moves_when_the_drone_turns() -> None:
    """-dragB (v + w x r): turning about z by 2 rad/s with r = (0.1, 0, 0) is 0.2 m/s of side wind."""
    e = estimate((0.0, 0.0, 0.0), rate=(0.0, 0.0, 2.0))
    drag(e, parameters(dragB_x=0.5, dragB_y=0.5, dragB_z=0.5, cop_x=0.1), DT)
    assert e[at.E_VEL : at.E_VEL + 3] == pytest.approx([0.0, -DT * 0.5 * 0.2, 0.0], abs=1e-15)


def test_the_covariance_knows_of_the_drag() -> None:
    """A diagonal covariance of velocity shrinks by (1 - dt dragB)^2, beside the same process noise."""
    plain, dragged = np.diag([1e-4] * 3 + [1e-2] * 3 + [0.0] * 3), np.diag([1e-4] * 3 + [1e-2] * 3 + [0.0] * 3)
    predict(estimate((0.0,) * 3, 0.7), plain, parameters(), 0.01, True)
    predict(estimate((0.0,) * 3, 0.7), dragged, parameters(dragB_x=2.0, dragB_y=2.0, dragB_z=2.0), 0.01, True)
    lost = 1e-2 * (1.0 - (1.0 - 0.01 * 2.0) ** 2)
    assert np.diag(plain - dragged)[3:6] == pytest.approx([lost] * 3, rel=1e-9)
    assert np.allclose(dragged, dragged.T)


def test_height_and_pressure_of_the_barometer_are_the_firmwares_formula() -> None:
    state, log, noise = np.zeros(at.STATE_SIZE), np.zeros(len(lv.ALL_VARIABLES)), np.random.default_rng(0)
    state[at.POS + 2] = 12.0
    seen = []
    for tick in range(20_000):
        log_baro(state, noise.standard_normal(at.NOISE_WIDTH), tick, log)
        if tick % 20 == 0:
            seen.append(log[lv.BARO : lv.BARO + 3].copy())
    asl, temperature, pressure = np.array(seen).T
    assert ((1015.7 / pressure) ** 0.1902630958 - 1.0) * (25.0 + 273.15) / 0.0065 == pytest.approx(asl)
    assert (asl.mean(), asl.std()) == pytest.approx((12.0, BARO_NOISE), rel=0.1)
    assert set(temperature) == {25.0}


@pytest.mark.parametrize("flying", [False, True])
def test_in_the_air_only_the_accelerometers_z_moves_the_estimate(flying: bool) -> None:
    """v <- v + dt (a - g e3) with the mean of the accelerometer; flying, its x and y count as 0."""
    e = estimate((0.0, 0.0, 0.0))
    e[at.E_SUM + 3 : at.E_SUM + 6] = np.array([0.4, -0.3, 10.0]) * 10
    e[at.E_COUNT] = 10
    integrate(e, 0.01, flying)
    expected = [0.0, 0.0, 0.19e-2] if flying else [0.4e-2, -0.3e-2, 0.19e-2]
    assert e[at.E_VEL : at.E_VEL + 3] == pytest.approx(expected, abs=1e-12)
