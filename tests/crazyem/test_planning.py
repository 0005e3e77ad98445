"""Plans: derivatives, information of a harmonic in closed form, limits, files that lie, odds between normal models."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from crazyem import cli
from crazyem.api.planning import look_alikes, noise_of, plan, plan_commands
from crazyem.control.harmonics import Axis, Harmonics
from crazyem.control.named_trajectories import duration_note, trajectory_maker
from crazyem.control.plan_file import HIGHEST_FREQUENCY, PlanFile, plan_toml, plan_trajectory, read_plan
from crazyem.errors import CrazyemError, FileFormatError, UsageError
from crazyem.estimation.inflation import steady_gain
from crazyem.estimation.model import Noise
from crazyem.physics.effects.effect import Situation
from crazyem.physics.motion import motion
from crazyem.planning import discrimination
from crazyem.planning.closed_loop import PERIOD, Flown, fly, mixing
from crazyem.planning.information import Expectation
from crazyem.planning.limits import Limits
from crazyem.planning.optimise import lines_of, optimise, within
from crazyem.planning.plan import Plan
from crazyem.vehicle import GRAVITY, load_vehicle

VEHICLE = load_vehicle("cf2")
SIDEWAYS = Axis((1.0, 2.5), (0.02, 0.0), (0.0, 0.004)), Axis((1.5,), (0.01,), (0.0,))
SMALL = Harmonics(6.0, 1.0, (*SIDEWAYS, Axis(), Axis((2.0,), (0.05,), (0.0,))))


# the manoeuvre


@given(
    st.floats(2.0, 20.0), st.floats(0.2, 0.9), st.floats(0.1, 5.0), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3),
)  # fmt: skip
def test_derivatives_are_those_of_the_path_and_vanish_at_the_ends(
    duration: float, ramp: float, frequency: float, cosine: float, sine: float
) -> None:
    made = Harmonics(duration, ramp, (Axis((frequency,), (cosine,), (sine,)), Axis(), Axis(), Axis()))
    time = np.array([0.37 * ramp, 0.5 * duration + 0.01, duration - 0.4 * ramp])
    step = 1e-5
    ahead, behind, here = (made.derivatives(time + s) for s in (step, -step, 0.0))
    for order in range(3):
        slope = (ahead[order] - behind[order]) / (2 * step)
        size = np.abs(here[order + 1]).max() + (2 * math.pi * frequency + 4 / ramp) ** (order + 1) * 0.3
        assert np.abs(slope - here[order + 1]).max() < 1e-4 * size
    assert np.abs(made.derivatives(np.array([0.0, duration, duration + 1.0]))).max() < 1e-9


def test_a_plan_turns_with_the_heading() -> None:
    """Flown from another place and heading, it is the same motion turned about the hover point."""
    one = SMALL.trajectory((0.0, 0.0, 1.0), 0.0).at(2.3)
    other = SMALL.trajectory((3.0, -1.0, 1.5), math.pi / 2).at(2.3)
    assert other.position[0] - 3.0 == pytest.approx(-one.position[1])
    assert other.position[1] + 1.0 == pytest.approx(one.position[0])
    assert other.acceleration[:2] == pytest.approx((-one.acceleration[1], one.acceleration[0]))
    assert other.yaw - math.pi / 2 == pytest.approx(one.yaw)


def test_no_two_axes_share_a_line_and_a_plan_file_may_have_all() -> None:
    for duration in (3.0, 3.1, 3.2, 3.3, 5.0, 10.0, 30.0):
        assert all(band for axis in lines_of(duration) for band in axis)
        lines = [f for axis in lines_of(duration) for band in axis for f in band]
        assert len(set(lines)) == len(lines)
        assert max(lines) <= HIGHEST_FREQUENCY
        assert np.allclose(np.array(lines) * duration, np.round(np.array(lines) * duration))


# what the model flies


def test_the_model_hovers_and_follows_a_height_as_its_transfer_function_says() -> None:
    """Vertical motion is linear: r'' and the errors of place and speed through the rotor lag."""
    still = fly(Harmonics(3.0, 1.0, (Axis(),) * 4), VEHICLE)
    assert np.abs(still.state[:, :6]).max() < 1e-9
    assert still.command == pytest.approx(np.full_like(still.command, VEHICLE.mass * GRAVITY / 4))
    f, size = 1.5, 0.02
    flown = fly(Harmonics(20.0, 1.0, (Axis(), Axis(), Axis((f,), (0.0,), (size,)), Axis())), VEHICLE)
    inside = (flown.time > 5.0) & (flown.time < 5.0 + 10 / f)
    phase = 2 * math.pi * f * flown.time[inside]
    seen = 2 * np.mean(flown.state[inside, 2] * np.exp(-1j * phase)) / (size / 1j)
    s = 2j * math.pi * f
    late = np.exp(-s * 3 * PERIOD / 5)  # poses are three steps of the loop old
    wanted = (s**2 + 4.0 * s + 7.0) / ((1.0 + s * VEHICLE.motor_time_constant) * s**2 + (4.0 * s + 7.0) * late)
    assert seen == pytest.approx(wanted, rel=0.04)


def test_noise_is_that_of_its_seed() -> None:
    noise = Expectation(VEHICLE).noise
    one, again, other = (fly(SMALL, VEHICLE, noise=noise, seed=s).measured for s in (1, 1, 2))
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)


# information


def test_information_of_a_harmonic_is_that_of_its_closed_form() -> None:
    """About z with rates alone: the sensitivity by log I is a first-order filter of the angular acceleration."""
    f, torque, n = 2.0, 3e-4, 2001
    rate_sd, impulse = 3e-3, 0.5
    noise = Noise(np.array([1.0, 1.0, 1.0, 1.0, 1.0, impulse]), np.array([1e3, 1e3, 1e3, rate_sd, 1.0]))
    time = PERIOD * np.arange(n)
    lag, inertia = VEHICLE.motor_time_constant, VEHICLE.inertia[2]
    rate = 2 * math.pi * f
    gain = 1.0 / (1.0 + 1j * rate * lag) * np.exp(-1j * rate * 3.5e-3)
    state = np.zeros((n, 13))
    state[:, 9] = 1.0
    alpha = torque / inertia * np.abs(gain)
    turn = torque / inertia * np.imag(gain * np.exp(1j * rate * time) / (1j * rate))
    state[:, 12] = turn
    angle = torque / inertia * np.imag(gain * np.exp(1j * rate * time) / (1j * rate) ** 2)
    state[:, 8], state[:, 9] = np.sin(angle / 2), np.cos(angle / 2)
    wrenches = np.zeros((n, 4))
    wrenches[:, 0], wrenches[:, 3] = VEHICLE.mass * GRAVITY, torque * np.sin(rate * time)
    command = wrenches @ np.linalg.inv(mixing(VEHICLE)).T
    found = Expectation(VEHICLE, noise).of(Flown(time, state, state, command, command)).information[3, 3]
    k, variance = steady_gain(impulse**2 * PERIOD, rate_sd**2)
    power = (PERIOD * alpha) ** 2 / 2 / abs(1 - (1 - k) * np.exp(-1j * rate * PERIOD)) ** 2
    mean = np.sinc(f * PERIOD) ** 2  # of the torque over a step
    assert found == pytest.approx(n * power * mean / variance, rel=0.03)


def test_thrust_scale_is_parallel_to_mass_and_inertia() -> None:
    """Rotors that give s times the thrust move a drone as one does that has 1/s of its mass and inertia."""
    random = np.random.default_rng(1)
    n, s = 20, 1.07
    rows = {k: random.standard_normal((n, 3)) for k in ("position", "velocity", "body_rate")}
    situation = Situation(
        time=np.arange(n) * 0.01, flown=np.ones(n), step=np.full(n, 0.01), height=np.ones(n),
        rotation=np.tile(np.eye(3), (n, 1, 1)), specific_force=np.zeros((n, 3)), angular_acceleration=np.zeros((n, 3)),
        thrust=random.uniform(0.03, 0.1, (n, 4)), thrust_rate=np.zeros((n, 4)), voltage=np.full(n, 4.0),
        rotor_constant=math.nan, air=np.zeros((n, 3)), **rows,
    )  # fmt: skip
    scaled = motion(situation, vehicle=VEHICLE, effects={"thrust_scale": {"scale": s}})
    i = VEHICLE.inertia
    lighter = replace(VEHICLE, mass=VEHICLE.mass / s, inertia=(i[0] / s, i[1] / s, i[2] / s))
    other = motion(situation, vehicle=lighter, effects={})
    assert scaled.specific_force == pytest.approx(other.specific_force)
    assert scaled.angular_acceleration == pytest.approx(other.angular_acceleration)


# limits and the search


def test_a_smooth_maximum_is_hardly_above_the_largest_value() -> None:
    limits = Limits()
    flown = fly(SMALL, VEHICLE)
    used = limits.used(SMALL, flown, VEHICLE)
    setpoints = SMALL.derivatives(flown.time)[0, :, :3]
    reach = np.maximum(np.abs(setpoints), np.abs(flown.state[:, :3])).max(0) / (0.9 * np.array(limits.box) / 2)
    assert np.all(used[:3] >= reach - 1e-12)
    assert np.all(used[:3] <= 1.15 * reach + 1e-12)
    assert used[3] >= flown.tilt.max() / limits.tilt


@pytest.fixture(scope="module")
def planned() -> Plan:
    """A short plan, once for all tests."""
    return plan(VEHICLE, parameters=("Ixx", "Izz"), duration=4.0, starts=1, seed=3)


def test_a_plan_keeps_its_limits_and_tells_more_than_a_manoeuvre_of_even_power(planned: Plan) -> None:
    assert planned.manoeuvre is not None
    assert planned.flown is not None
    low, high = planned.limits.rotor_range(VEHICLE)
    assert np.all(np.abs(planned.flown.state[:, :3]).max(0) <= np.array(planned.limits.box) / 2)
    assert planned.flown.tilt.max() <= planned.limits.tilt
    assert low <= planned.flown.command.min()
    assert planned.flown.command.max() <= high
    even = within(SMALL, lambda flown: 0.0, VEHICLE, planned.limits)
    expectation = Expectation(VEHICLE)
    best, usual = (expectation.of(f).sd[[1, 3]] for f in (planned.flown, even.flown))
    assert np.all(best < usual)
    assert set(planned.widths) == {"Ixx", "Izz"}
    assert all(0.0 < w < 0.5 for w in planned.widths.values())


def test_the_same_seed_gives_the_same_plan() -> None:
    def merit(flown: Flown) -> float:
        return float(np.std(flown.state[:, 12]))

    one, again = (optimise(merit, VEHICLE, Limits(), duration=3.0, starts=1, seed=5, iterations=1) for _ in range(2))
    assert one.manoeuvre == again.manoeuvre


def test_a_drone_without_reserve_has_no_plan() -> None:
    with pytest.raises(UsageError, match="no reserve"):
        Limits().rotor_range(replace(VEHICLE, mass=0.047))


# odds


def test_divergence_and_evidence_are_those_of_normal_distributions() -> None:
    random = np.random.default_rng(4)
    a, b = random.standard_normal((4, 2)), random.standard_normal((4, 1))
    one, other = (multivariate_normal(np.zeros(4), np.eye(4) + m @ m.T) for m in (a, b))
    z = one.rvs(200_000, random_state=5)
    assert discrimination._divergence(a, b) == pytest.approx(np.mean(one.logpdf(z) - other.logpdf(z)), rel=0.02)
    z = z[:50]
    difference = discrimination._log_evidence([a], z) - discrimination._log_evidence([b], z)
    assert difference == pytest.approx(one.logpdf(z) - other.logpdf(z))


def test_parallel_columns_give_no_odds() -> None:
    column = np.array([[3.0], [1.0], [0.0]])
    assert discrimination._divergence(column, column) == pytest.approx(0.0, abs=1e-12)
    assert discrimination._correlation(column, -2.0 * column) == pytest.approx(1.0)
    assert discrimination._correlation(column, np.array([[1.0], [-3.0], [5.0]])) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.slow
def test_inertia_and_torque_scale_are_alike_on_every_flight_and_wind_and_tilt_are_not() -> None:
    flown = fly(within(SMALL.scaled(3.0), lambda f: 0.0, VEHICLE, Limits()).manoeuvre, VEHICLE)
    alike = discrimination.Pair("inertia", "torque_scale", VEHICLE, Limits()).odds(flown, draws=200)
    assert alike.correlation == pytest.approx(1.0, abs=1e-3)
    assert not alike.decides
    apart = discrimination.Pair("motor_lag", "thrust_scale", VEHICLE, Limits()).odds(flown, draws=200)
    assert apart.correlation < 0.9
    assert apart.expected[0] > alike.expected[1]


def test_effects_that_cannot_be_planned_for_are_named() -> None:
    for pair, word in ((("nonsense", "wind"), "unknown"), (("gusts", "wind"), "random"), (("wind", "wind"), "two")):
        with pytest.raises(UsageError, match=word):
            discrimination.Pair(*pair, VEHICLE, Limits())


# files


def test_a_plan_file_reads_back(tmp_path: Path, planned: Plan) -> None:
    file = tmp_path / "plan.toml"
    file.write_text(planned.to_toml())
    read = read_plan(file)
    assert planned.manoeuvre is not None
    time = np.linspace(0.0, 4.0, 200)
    assert read.manoeuvre.derivatives(time) == pytest.approx(planned.manoeuvre.derivatives(time), abs=1e-6)
    assert read.box == planned.limits.box
    made = trajectory_maker(("plan", str(file)), 20.0)((1.0, 2.0, 1.0), 0.3)
    assert made.duration == 4.0
    assert made.at(0.0).position == pytest.approx((1.0, 2.0, 1.0))
    assert duration_note(("plan", str(file)), 20.0) == ""


HOSTILE = {
    "nothing": ("", "format"),
    "no toml": ("[[[", "TOML"),
    "another version": ("version = 1", "version = 2", "version"),
    "a word": ("duration = 6.0", 'duration = "long"', "duration"),
    "endless": ("duration = 6.0", "duration = inf", "duration"),
    "no number": ("duration = 6.0", "duration = nan", "duration"),
    "no ramp": ("ramp = 1.0", "ramp = 0.0", "ramp"),
    "a huge box": ("box = [1.0, 1.0, 0.6]", "box = [1000.0, 1.0, 0.6]", "box"),
    "a flat box": ("box = [1.0, 1.0, 0.6]", "box = [1.0, 1.0]", "box"),
    "on its side": ("tilt = 20.0", "tilt = 90.0", "tilt"),
    "out of the box": ("cosine = [0.02,", "cosine = [0.9,", "leaves its box"),
    "not a number": ("cosine = [0.02,", "cosine = [nan,", "cosine"),
    "infinite": ("cosine = [0.02,", "cosine = [inf,", "cosine"),
    "huge": ("cosine = [0.02,", f"cosine = [{10**400},", "cosine"),
    "true": ("cosine = [0.02,", "cosine = [true,", "cosine"),
    "a text": ("cosine = [0.02,", 'cosine = ["0",', "cosine"),
    "shorter": ("cosine = [0.02, 0]", "cosine = [0.02]", "one length"),
    "too quick": ("frequency = [1, 2.5]", "frequency = [1, 250.0]", "frequencies"),
    "backwards": ("frequency = [1, 2.5]", "frequency = [-1, 2.5]", "frequencies"),
    "many": ("frequency = [1, 2.5]", f"frequency = {[1.0] * 1000}", "at most"),
    "steep": ("frequency = [1, 2.5]", "frequency = [1, 9.9]", "m/s"),
    "spinning": ("cosine = [0.05]", "cosine = [3.0]", "turns"),
    "a table of nothing": ("[x]", "x = 3\n[w]", "x"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_plan_is_refused_in_one_sentence(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = plan_toml(PlanFile(SMALL, (1.0, 1.0, 0.6), 20.0, "cf2"))
    *change, word = HOSTILE[name]
    text = change[0] if len(change) == 1 else good.replace(*change)
    assert text != good
    file = tmp_path / "plan.toml"
    file.write_text(text)
    with pytest.raises(FileFormatError, match="(?s)" + word) as error:
        read_plan(file)
    assert "\n" not in str(error.value).strip()
    assert cli.main(["fly", "--trajectory", "plan", str(file)]) == 3
    shown = capsys.readouterr().err.strip()
    assert shown.startswith("crazyem: ")
    assert "Traceback" not in shown


def test_a_plan_does_not_go_through_the_floor(tmp_path: Path) -> None:
    deep = Harmonics(6.0, 1.0, (Axis(), Axis(), Axis((0.5,), (0.5,), (0.0,)), Axis()))
    read = PlanFile(deep, (1.0, 1.0, 1.0), 20.0, "cf2")
    with pytest.raises(FileFormatError, match="goes down to"):
        plan_trajectory(read, path="deep.toml", position=(0.0, 0.0, 0.5), yaw=0.0)


def test_noise_comes_from_a_flights_summary(tmp_path: Path) -> None:
    names = ("force_x", "force_y", "thrust", "torque_x", "torque_y", "torque_z")
    table = dict.fromkeys(names, 1e-3) | dict.fromkeys(("position", "velocity", "attitude", "body_rate"), 2e-3)
    file = tmp_path / "flight.json"
    file.write_text(json.dumps({"estimate": {"noise": table}}))
    noise = noise_of(file, VEHICLE)
    assert noise.impulse[2] == pytest.approx(1e-3 / VEHICLE.mass)
    assert noise.impulse[5] == pytest.approx(1e-3 / VEHICLE.inertia[2])
    assert noise.measurement[:4] == pytest.approx([2e-3] * 4)
    file.write_text(json.dumps({"estimate": {"noise": {**table, "thrust": -1.0}}}))
    with pytest.raises(FileFormatError, match="no noise scales"):
        noise_of(file, VEHICLE)


def test_look_alikes_come_from_a_diagnosis(tmp_path: Path) -> None:
    file = tmp_path / "diagnosis.json"
    file.write_text(json.dumps({"format": "crazyem-diagnosis", "indistinguishable": [["wind", "trim", "evil\n"]]}))
    assert look_alikes(file) == [("wind", "trim")]
    file.write_text(json.dumps({"format": "crazyem-diagnosis", "indistinguishable": []}))
    with pytest.raises(UsageError, match="told apart"):
        look_alikes(file)
    for text in ("{", "[]", '{"format": "other"}'):
        file.write_text(text)
        with pytest.raises(FileFormatError):
            look_alikes(file)


def test_a_diagnosis_gets_the_command_only_where_a_manoeuvre_tells() -> None:
    groups = [["inertia", "torque_scale"], ["wind", "attitude_misalignment"], ["wind", "gusts"]]
    told = plan_commands(groups, VEHICLE, "drone.toml")
    assert len(told) == 1
    assert "crazyem plan --split wind,attitude_misalignment --vehicle drone.toml -o plan.toml" in told[0]
    assert plan_commands(groups, replace(VEHICLE, mass=0.047), "heavy.toml") == []


def test_the_command_says_why_no_manoeuvre_will_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output, summary = tmp_path / "plan.toml", tmp_path / "plan.json"
    code = cli.main(["plan", "--for", "mass,thrust_scale", "-o", str(output), "--json", str(summary)])
    assert code == 5
    said = capsys.readouterr().err
    assert "parallel" in said
    assert "weigh" in said
    assert not output.exists()
    assert json.loads(summary.read_text())["possible"] is False


@pytest.mark.parametrize(
    "words", [("--for", "colour"), ("--split", "wind"), ("--split", "wind,colour"), ("--from", "nowhere.json"),
              ("--vehicle", "nobody"), ("--time", "1"), ("--for", "mass", "--split", "a,b"), ("--box", "1", "1", "nan")]
)  # fmt: skip
def test_bad_arguments_are_one_sentence(
    words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["plan", *words, "-o", str(tmp_path / "plan.toml")]) == 2
    assert capsys.readouterr().err.startswith("crazyem: ")


def test_goals_exclude_each_other() -> None:
    with pytest.raises(CrazyemError, match="one goal"):
        plan(VEHICLE, parameters=("mass",), split=("wind", "trim"))
