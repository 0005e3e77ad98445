"""Random torques of one rotor or of one band: signs and humps made by hand, and a flight that shakes."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from closed_loop import DRONE, SIGNS, fly
from diagnosis_parts import data_of, nominal_of, start_point
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.fit import nominal
from crazyem.diagnosis.fitting.model import Noise, Point
from crazyem.diagnosis.locating.random_torques import (
    amplitude_of,
    block_covariances,
    erratic_rotor,
    hump,
    humps,
    memoryless,
    peaks,
    spectrum,
)

ROWS, STEP = 2500, 0.01


def model_of(rates: NDArray[np.float64]) -> Any:
    """Stands for a flight whose rates' innovations (n, 3) have unit variance."""
    n = len(rates)
    innovation, variance = np.zeros((n, 12)), np.ones((n, 12))
    innovation[:, 9:] = rates
    time = STEP * np.arange(n)
    flight = SimpleNamespace(time=time, block=(time // 1.0).astype(int), blocks=int(time[-1]) + 1)
    return SimpleNamespace(flight=flight, sweep=lambda point: SimpleNamespace(innovation=innovation, variance=variance))


POINT = Point(DRONE, {}, Noise(np.ones(6), np.ones(4)))


@pytest.mark.parametrize("rotor", [0, 1, 2, 3])
def test_a_rotor_that_disturbs_is_told_by_the_signs_of_its_place(rotor: int) -> None:
    rng = np.random.default_rng(rotor)
    rates = rng.normal(size=(ROWS, 3)) + 0.35 * rng.normal(size=(ROWS, 1)) * SIGNS[:, rotor]
    found = erratic_rotor([model_of(rates)], POINT)
    assert (found.signal, found.regime, found.variable) == ("torque", f"rotor {rotor + 1} at random", "at random")
    assert found.effect_size > 0


def test_noise_and_a_product_of_inertia_are_no_rotor() -> None:
    mixed = 0
    for seed in range(40):
        rates = np.random.default_rng(seed).normal(size=(ROWS, 3))
        assert erratic_rotor([model_of(rates)], POINT) is None
        rates[:, 1] += 0.5 * rates[:, 0]  # two axes of three
        mixed += erratic_rotor([model_of(rates)], POINT) is not None
    assert mixed <= 3  # two rotors have each sign, so it is one in fifty by chance


def test_all_rotors_alike_are_noise() -> None:
    rng = np.random.default_rng(0)
    each = rng.normal(size=(ROWS, 4)) @ SIGNS.T
    assert erratic_rotor([model_of(each)], POINT) is None


@pytest.mark.parametrize("rotor", [0, 1, 2, 3])
def test_the_trim_of_another_day_is_no_random_torque(rotor: int) -> None:
    """A steady torque of one rotor in one of two flights, twice the innovations' standard deviation."""
    first, second = np.random.default_rng(rotor).normal(size=(2, ROWS, 3))
    steady = 2.0 * SIGNS[:, rotor]
    assert erratic_rotor([model_of(first), model_of(second + steady)], POINT) is None
    erratic = 0.35 * np.random.default_rng(9).normal(size=(ROWS, 1)) * SIGNS[:, rotor]
    found = erratic_rotor([model_of(first + erratic), model_of(second + erratic - steady)], POINT)
    assert found.regime == f"rotor {rotor + 1} at random"


def test_covariances_of_blocks_are_those_of_numpy() -> None:
    rng = np.random.default_rng(3)
    z, block = rng.normal((5.0, -3.0, 1.0), size=(60, 3)), np.repeat(np.arange(3), 20)
    seen = rng.random(60) < 0.8
    found = block_covariances(z, seen, block, 3)
    for b in range(3):
        rows = z[seen & (block == b)]
        slow = np.cov(rows.T, ddof=0) * len(rows)
        np.testing.assert_allclose(found[b], [slow[0, 1], slow[0, 2], slow[1, 2]], rtol=1e-10)


def test_a_spectrum_holds_the_variance() -> None:
    """Parseval, for noise and for a sine of amplitude 2."""
    time = STEP * np.arange(ROWS)
    for values, variance in (
        (np.random.default_rng(1).normal(size=ROWS), 1.0),
        (2 * np.sin(2 * np.pi * 7 * time), 2.0),
    ):
        frequency, power, _ = spectrum(values, STEP)
        assert np.trapezoid(power, frequency) == pytest.approx(variance, rel=0.1)
    assert hump(frequency, power + 1e-3)[1] > 100
    assert frequency[hump(frequency, power + 1e-3)[0]] == pytest.approx(7.0, abs=0.2)


def test_noise_has_no_hump() -> None:
    for seed in range(20):
        assert not peaks(model_of(np.random.default_rng(seed).normal(size=(ROWS, 3))), POINT)
    assert not peaks(model_of(np.ones((300, 3))), POINT)  # too short for a spectrum


@pytest.mark.slow
def test_a_flight_that_shakes() -> None:
    """3 rad/s^2 in roll and pitch about 6 Hz: found there with its torque."""
    data, point = nominal_of(fly(vibration=3.0))
    found = humps(data.models[0], point)
    assert {f.axis for f in found} == {"x", "y"}
    for f, inertia in zip(sorted(found, key=lambda f: f.axis), DRONE.inertia, strict=False):
        assert 5.5 < float(f.regime.split()[1]) < 6.5
        assert f.effect_size == pytest.approx(3.0 * inertia, rel=0.3)
    assert amplitude_of(data.models[0], point, 2, 6.0)[0] < 0.5


def test_a_healthy_made_flight_has_neither() -> None:
    data, point = nominal_of(fly(seconds=7.0))
    assert not humps(data.models[0], point)
    assert erratic_rotor(data.models, point) is None


@pytest.mark.parametrize("share", [0.15, 0.27])
def test_torques_that_products_of_inertia_turn_into_rates_are_no_rotor(share: float) -> None:
    """All axes are mixed with the signs of a rotor, and the model knows it: of the torques nothing goes together."""
    inertia = np.diag(DRONE.inertia)
    products = {"xy": -share, "xz": -share / 2, "yz": -share / 2}  # as rotor 1, whose signs are alike
    for (i, j), value in zip(((0, 1), (0, 2), (1, 2)), products.values(), strict=True):
        inertia[i, j] = inertia[j, i] = value * DRONE.inertia[0]
    knowing = Point(DRONE, {"inertia_products": {n: v * DRONE.inertia[0] for n, v in products.items()}}, POINT.noise)
    rng, said = np.random.default_rng(0), 0
    for _ in range(5):
        torque = rng.normal(size=(ROWS, 3)) * np.array(DRONE.inertia)  # rates of unit variance without products
        rates = torque @ np.linalg.inv(inertia)
        assert erratic_rotor([model_of(rates)], knowing) is None
        said += erratic_rotor([model_of(rates)], POINT) is not None
    assert said == 5


def test_what_a_filter_remembers_is_an_innovation_again() -> None:
    """Torques with a memory hide how the axes go together: most of it is foreseen. Without, noise takes their place."""
    data, point = nominal_of(fly(seconds=7.0, sway=6.0))
    assert point.noise.disturbance[3:].max() > 1.0
    quiet = memoryless(data.twin(), point)
    assert not quiet.noise.disturbance[3:].any()
    assert np.all(quiet.noise.impulse[3:5] > point.noise.impulse[3:5])
    assert quiet.effects == point.effects


def test_a_made_rotor_that_pushes_at_random_is_told() -> None:
    """By 4 mN with a memory of 0.05 s, for a roll of 4 mN times the arm: which rotor, and about how much."""
    data = data_of(fly(sticking=4e-3, seconds=14.0))
    quiet = memoryless(data, nominal(data, start_point()))
    data.settle(quiet)
    found = erratic_rotor(data.models, quiet)
    assert found.regime == "rotor 4 at random"
    assert 0.5 < found.effect_size / (4e-3 * DRONE.arm[0]) < 1.5
