"""The floor: stands still, leaves when thrust exceeds weight, lands without bouncing off, tips over when it must."""

import numpy as np
import pytest

from firmware_sim.controllers.tick import plant_step
from firmware_sim.plant import layout as at
from firmware_sim.scenario import parse_scenario

STILL = np.zeros(at.NOISE_WIDTH)


def drone(thrust: float, start: dict | None = None, height: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Constants and state with rotors that give `thrust` N each whatever the command (unless it is 0)."""
    table = {
        "vehicle": {"thrust_curve": [thrust], "thrust_max": 1.0, "motor_time_constant": 0.0},
        "start": start or {"position": [0.0, 0.0, height]},
        "ground": {"height": height},
    }
    scenario = parse_scenario(table, "test")
    x = scenario.start_state()
    x[at.PWM : at.PWM + 4] = 1000 if thrust > 0 else 0
    return scenario.truth(), x


@pytest.mark.parametrize(("fraction", "leaves"), [(0.0, False), (0.25, False), (0.95, False), (1.05, True)])
def test_leaves_the_floor_when_thrust_exceeds_weight(fraction: float, leaves: bool) -> None:
    truth, x = drone(fraction * 0.029 * 9.81 / 4, height=1.5)
    rng = np.random.default_rng(0)
    for _ in range(1000):
        plant_step(truth, x, rng.standard_normal(at.NOISE_WIDTH), 1e-3)
    if leaves:
        assert x[at.POS + 2] - 1.5 == pytest.approx(0.5 * 0.05 * 9.81, rel=0.2)
    else:
        assert abs(x[at.POS + 2] - 1.5) < 1e-3
        assert np.abs(x[at.VEL : at.VEL + 3]).max() < 1e-3
        assert np.abs(x[[at.POS, at.POS + 1]]).max() < 1e-3


def test_resting_reads_one_g() -> None:
    truth, x = drone(0.0)
    for _ in range(10):
        plant_step(truth, x, STILL, 1e-3)
    assert x[at.ASLEEP] == 1.0
    assert x[at.ACC : at.ACC + 3] == pytest.approx([0, 0, 9.81])


@pytest.mark.parametrize("speed", [0.0, 0.5, 3.0])
def test_a_fall_ends_at_rest_on_the_floor(speed: float) -> None:
    truth, x = drone(0.0, {"position": [0.0, 0.0, 0.5], "velocity": [speed, 0.0, -speed]})
    for _ in range(4000):
        plant_step(truth, x, STILL, 1e-3)
    assert x[at.ASLEEP] == 1.0
    assert abs(x[at.POS + 2]) < 1e-3
    up = 1 - 2 * (x[at.QUAT + 1] ** 2 + x[at.QUAT + 2] ** 2)
    assert abs(abs(up) - 1.0) < 1e-2  # on its feet or on its back, nothing between


def test_gentle_landing_stays_below_four_g() -> None:
    truth, x = drone(0.0, {"position": [0.0, 0.0, 0.001], "velocity": [0.0, 0.0, -0.3]})
    peak = 0.0
    for _ in range(500):
        plant_step(truth, x, STILL, 1e-3)
        peak = max(peak, x[at.ACC + 2] / 9.81)
    assert 1.0 < peak < 6.0
