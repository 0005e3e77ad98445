"""`vehicle sample`: draws that keep what flights know and spread what they do not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_flight import made_flight

from benchmarks.ensemble_bands import RANDOM, randomised
from crazyem.cli import main
from crazyem.diagnosis.prediction.ensemble import ensemble, error_scale, offset
from crazyem.diagnosis.settings import PREDICTION
from crazyem.errors import DataError, FileFormatError, UsageError
from crazyem.physics.rotations import quaternion_from_rotation_vector
from crazyem.simulators.constants import from_vehicle
from crazyem.simulators.sampling import sample
from crazyem.vehicle import Posterior, Vehicle, load_vehicle, parse_vehicle

NAMES = ("thrust_scale.scale", "inertia.xx", "linear_drag.x")
SD = np.array([0.01, 5e-7, 2e-3])
COVARIANCE = np.outer(SD, SD) * np.array([[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 1.0]])


def fitted() -> Vehicle:
    posterior = Posterior(NAMES, (0.95, 2.5e-5, 0.02), tuple(tuple(row) for row in COVARIANCE.tolist()))
    effects = {"thrust_scale": {"scale": 0.95}, "inertia": {"xx": 2.5e-5}, "linear_drag": {"x": 0.02}}
    return replace(load_vehicle("cf21bl-busetto"), name="fitted", effects=effects, posterior=posterior)


def test_a_file_keeps_the_posterior() -> None:
    again = parse_vehicle(fitted().to_toml())
    assert again == fitted()


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('"inertia.xx"', "3", "must list texts"), ("mean = [0.95,", "mean = [", "needs 3 means"),
        ("mean = [0.95,", 'mean = ["x",', "must hold numbers"),
        (repr(float(COVARIANCE[0, 1])), "1.0", "no covariance matrix"),
    ],
)  # fmt: skip
def test_a_bad_posterior_is_refused(old: str, new: str, sentence: str) -> None:
    text = fitted().to_toml()
    assert old in text
    with pytest.raises(FileFormatError, match=sentence):
        parse_vehicle(text.replace(old, new, 1))


def test_draws_have_the_mean_and_covariance_of_the_file() -> None:
    found = sample(fitted(), 1500, seed=1, days=False, mass_sd=0.0)
    assert np.allclose(found.draws.mean(0), [0.95, 2.5e-5, 0.02], atol=4 * SD / np.sqrt(1500))
    assert np.allclose(np.cov(found.draws.T) / np.outer(SD, SD), COVARIANCE / np.outer(SD, SD), atol=0.15)


def test_the_mass_is_spread_and_thrust_over_mass_is_not() -> None:
    arrays = sample(fitted(), 400, seed=2, days=False, mass_sd=0.05).arrays()
    mass, thrust = arrays["mass"], arrays["thrust_per_speed2"]
    assert np.std(np.log(mass)) == pytest.approx(0.05, rel=0.15)
    assert np.std(np.log(thrust / mass)) == pytest.approx(0.01 / 0.95, rel=0.15)
    assert np.std(np.log(arrays["inertia_yy"] / mass)) < 1e-9


def test_other_days_differ_more() -> None:
    same, other = (sample(fitted(), 300, seed=3, days=d, mass_sd=0.0).arrays() for d in (False, True))
    assert np.std(other["thrust_per_speed2"]) > 1.5 * np.std(same["thrust_per_speed2"])
    assert "trim.x" in other


@given(seed=st.integers(0, 2**31 - 1), wide=st.floats(1.0, 6.0))
def test_every_drone_can_be(seed: int, wide: float) -> None:
    """Inertias obey the triangle inequality however wide the posterior is."""
    vehicle = fitted()
    assert vehicle.posterior is not None
    broad = replace(
        vehicle.posterior, covariance=tuple(tuple(wide**2 * v for v in r) for r in vehicle.posterior.covariance)
    )
    for drawn in sample(replace(vehicle, posterior=broad), 5, seed=seed).vehicles:
        c = from_vehicle(drawn)[0]
        moments = sorted(c.or_(f"inertia_{a}", 0.0) for a in ("xx", "yy", "zz"))
        assert moments[0] > 0.0
        assert moments[2] <= moments[0] + moments[1]
        assert drawn.effects["linear_drag"]["x"] >= 0.0


def test_the_same_seed_gives_the_same_drones() -> None:
    assert sample(fitted(), 3, seed=5).vehicles == sample(fitted(), 3, seed=5).vehicles


def test_without_a_posterior_nothing_is_sampled() -> None:
    with pytest.raises(UsageError, match=r"has no \[posterior\]"):
        sample(load_vehicle("cf2"), 3)
    bad = Posterior(("inertia.ab",), (1.0,), ((1.0,),))
    with pytest.raises(UsageError, match=r"unknown parameter 'inertia.ab'"):
        sample(replace(load_vehicle("cf2"), posterior=bad), 3)


def test_a_posterior_of_impossible_drones() -> None:
    bad = Posterior(("inertia.xx",), (1.0e-3,), ((1e-16,),))
    with pytest.raises(DataError, match="hardly any drone"):
        sample(replace(load_vehicle("cf2"), posterior=bad), 1)


def test_sample_writes_arrays_and_files_of_a_simulator(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, folder = tmp_path / "fitted.toml", tmp_path / "drones"
    source.write_text(fitted().to_toml())
    words = ["vehicle", "sample", str(source), "--count", "4", "--seed", "1"]
    assert main([*words, "-o", str(tmp_path / "s.npz")]) == 0
    with np.load(tmp_path / "s.npz") as arrays:
        assert arrays["mass"].shape == (4,)
        kf = arrays["thrust_per_speed2"]
    assert main([*words, "-o", str(folder), "--to", "gym-pybullet-drones"]) == 0
    assert sorted(p.name for p in folder.iterdir()) == [f"fitted_{k:03d}.urdf" for k in range(4)]
    assert (
        main(["vehicle", "convert", str(folder / "fitted_002.urdf"), "--to", "crazyem", "-o", str(tmp_path / "b.toml")])
        == 0
    )
    assert load_vehicle(tmp_path / "b.toml").rotor_constant == pytest.approx(kf[2])
    assert main([*words, "-o", str(folder)]) == 0
    assert (folder / "fitted_003.toml").exists()
    capsys.readouterr()


def test_offsets_of_states() -> None:
    turn = np.array([[0.02, -0.01, 0.03]])
    level = np.concatenate([np.zeros((1, 9)), np.ones((1, 1)), np.zeros((1, 3))], axis=1)
    other = level.copy()
    other[:, 6:10], other[:, 0], other[:, 12] = quaternion_from_rotation_vector(turn), 0.5, 2.0
    assert np.allclose(offset(other, level), [[0.5, 0, 0, 0, 0, 0, *turn[0], 0, 0, 2.0]])


def test_a_band_holds_what_it_says_where_the_model_is_right() -> None:
    """Made flights, whose errors are the noise of their own streams: learned from two, judged on a noisier one."""
    vehicle = replace(load_vehicle("cf2"), mass=0.036, rotor_constant=3e-8, effects={})
    flights = [made_flight(seconds=12.0, seed=seed, noise=noise) for seed, noise in ((4, 1.0), (5, 1.0), (11, 3.0))]
    found = ensemble(flights[2], vehicle, [vehicle] * 24, calibrate=flights[:2], seed=1)
    held = found.held()
    assert all(0.75 < share <= 1.0 for share in held.values()), held
    assert found.arrays()["low"].shape == (len(found.rows), 12)


def test_the_scale_of_errors_is_of_those_known_at_a_start() -> None:
    rng = np.random.default_rng(3)
    begin = np.cumsum(rng.uniform(0.05, 0.15, 40))
    end, errors, prior = begin + 0.5, rng.standard_normal((40, 2)), np.array([4.0, 0.25])
    errors[7] = np.nan
    found = error_scale(begin, end, errors, prior)
    for k in range(40):  # slow and plain
        square, total = PREDICTION.prior_time * prior, PREDICTION.prior_time
        for j in range(40):
            if end[j] <= begin[k] and j != 7:
                weight = min(PREDICTION.spacing, begin[j + 1] - begin[j]) * np.exp(
                    (end[j] - begin[k]) / PREDICTION.memory
                )
                square, total = square + weight * errors[j] ** 2, total + weight
        assert found[k] == pytest.approx(np.sqrt(square / total))
    later = np.where(end[:, None] > begin[20], 100.0, errors)
    assert np.array_equal(error_scale(begin, end, later, prior)[:21], found[:21])


@pytest.mark.parametrize("each_rotor", [False, True])
def test_the_randomisation_that_bands_are_compared_with(each_rotor: bool) -> None:
    vehicle = replace(fitted(), effects={"thrust_scale": {"scale": 0.95}})
    drawn = randomised(vehicle, 1, each_rotor=each_rotor)
    ratios = np.array([d.mass / vehicle.mass for d in drawn])
    assert np.abs(ratios - 1.0).max() <= RANDOM < 1.2 * np.abs(ratios - 1.0).max()
    assert all(abs(d.effects["thrust_scale"]["scale"] / 0.95 - 1.0) <= RANDOM for d in drawn)
    trims = np.array([list(d.effects["trim"].values()) for d in drawn])
    assert (np.abs(trims).max() > 1e-3) == each_rotor  # m: torque over thrust
    assert np.abs(trims[:, :2]).max() <= RANDOM / (1.0 - RANDOM) * max(vehicle.arm)
