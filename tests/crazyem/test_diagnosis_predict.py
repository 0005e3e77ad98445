"""Open-loop prediction: closed forms, an independent solver, causality, the nano-drone benchmark's own protocol."""

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flown import DRONE, START, G, fly, recording_of, smooth_thrust, speeds
from hypothesis import given, settings
from hypothesis import strategies as st
from made_flight import changed
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from crazyem.cli import main
from crazyem.diagnosis.prediction.course import ThrustCourse
from crazyem.diagnosis.prediction.predict import predict, recorded
from crazyem.diagnosis.prediction.simulate import Simulator
from crazyem.errors import DataError
from crazyem.physics.motion import RotorInput, rotor_thrust
from crazyem.recordings import open_recording
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle, load_vehicle

Array = NDArray[np.float64]
TIMES = np.arange(0.0, 1.2, 0.01)


def flight(
    thrust: Callable[[float], Array], *, times: Array = TIMES, vehicle: Vehicle = DRONE, **more: Any
) -> tuple[Recording, Array]:
    states = fly(thrust, times, vehicle=vehicle, **more)
    fine = np.arange(times[0], times[-1] + 1e-9, 0.001)
    return recording_of(times, states, rotor_speed=(fine, speeds(thrust, fine, vehicle))), states


def along(states: Array, starts: Array, count: int) -> Array:
    """(n, N, 13) what came after each start."""
    return np.stack([states[i + 1 : i + 1 + count] for i in starts])


def angle(p: Array, q: Array) -> float:
    turn = Rotation.from_quat(p.reshape(-1, 4)).inv() * Rotation.from_quat(q.reshape(-1, 4))
    return float(turn.magnitude().max())


def assert_near(found: Array, truth: Array, *, position: float, rest: float) -> None:
    """All but the last step, in which the inputs of the oracle go on and those of a prediction are held."""
    assert_close(found[:, :-1], truth[:, :-1], position=position, rest=rest)
    assert_close(found[:, -1:], truth[:, -1:], position=position, rest=0.02)


def assert_close(found: Array, truth: Array, *, position: float, rest: float) -> None:
    assert np.abs(found[..., 0:3] - truth[..., 0:3]).max() < position
    assert np.abs(found[..., 3:6] - truth[..., 3:6]).max() < rest
    assert angle(found[..., 6:10], truth[..., 6:10]) < rest
    assert np.abs(found[..., 10:13] - truth[..., 10:13]).max() < rest


def predicted(recording: Recording, vehicle: Vehicle = DRONE, **options: Any) -> Any:
    """By the model alone; what a prediction learns in flight is tested in `test_diagnosis_bias_correction.py`."""
    return predict(recorded(recording, vehicle), **{"horizon": 50, "plain": True, **options})


def test_a_body_without_thrust_falls_and_one_that_spins_about_an_axis_of_inertia_goes_on() -> None:
    drone = replace(DRONE, inertia_products=(0.0, 0.0, 0.0))
    spin = np.array([0, 0, 3.0])
    t = TIMES[:, None]
    states = np.zeros((TIMES.size, 13))
    states[:, 0:3] = [0, 0, 20] + t * [1.0, -2.0, 0.5] - 0.5 * G * t**2 * [0, 0, 1]
    states[:, 3:6] = [1.0, -2.0, 0.5] - G * t * [0, 0, 1]
    states[:, 6:10] = (Rotation.from_rotvec([0.4, 0.2, 0]) * Rotation.from_rotvec(t * spin)).as_quat()
    states[:, 10:13] = spin
    recording = recording_of(TIMES, states, rotor_speed=(TIMES, np.full((TIMES.size, 4), 1e-3)))
    found = predicted(recording, drone)
    assert found.prediction.shape == (TIMES.size - 50, 50, 13)
    truth = along(states, found.start_index, 50)
    assert_close(found.prediction, truth, position=1e-10, rest=1e-10)
    assert np.allclose(found.time, along(TIMES[:, None], found.start_index, 50)[..., 0])


def test_a_tilted_drone_at_constant_thrust_follows_a_parabola() -> None:
    start = np.array([0, 0, 5, 0, 0, 0, *Rotation.from_euler("y", 0.3).as_quat(), 0, 0, 0.0])
    drone = replace(DRONE, inertia_products=(0.0, 0.0, 0.0))
    each = 0.12
    t = TIMES[:, None]
    pull = np.array([np.sin(0.3), 0, np.cos(0.3)]) * 4 * each / drone.mass - [0, 0, G]
    states = np.tile(start, (TIMES.size, 1))
    states[:, 0:3] += 0.5 * pull * t**2
    states[:, 3:6] = pull * t
    flat = np.full((TIMES.size, 4), np.sqrt(each / 4e-8))
    found = predicted(recording_of(TIMES, states, rotor_speed=(TIMES, flat)), drone)
    assert_close(found.prediction, along(states, found.start_index, 50), position=1e-9, rest=1e-9)


@pytest.mark.parametrize("seed", [1, 2])
def test_predictions_agree_with_an_independent_solver(seed: int) -> None:
    """Products of inertia, wandering thrusts; half a second ahead, 10 ms samples."""
    recording, states = flight(smooth_thrust(seed))
    found = predicted(recording)
    assert_near(found.prediction, along(states, found.start_index, 50), position=5e-5, rest=2e-4)


def test_effects_act_and_a_wrong_model_does_not_agree() -> None:
    drag = np.array([0.02, 0.03, 0.01])
    recording, states = flight(smooth_thrust(4), force=lambda v, turn: -turn @ (drag * (turn.T @ v)))
    dragged = replace(DRONE, effects={"linear_drag": {"x": 0.02, "y": 0.03, "z": 0.01}})
    found = predicted(recording, dragged)
    truth = along(states, found.start_index, 50)
    assert_near(found.prediction, truth, position=5e-5, rest=2e-4)
    assert np.abs(predicted(recording).prediction - truth).max() > 0.01


def test_steps_that_are_not_the_recordings() -> None:
    recording, states = flight(smooth_thrust(5), times=np.arange(0.0, 1.2, 0.001))
    found = predicted(recording, horizon=20, step=0.0125, every=40)
    assert np.allclose(np.diff(found.time, axis=1), 0.0125)
    assert (found.start_index % 40 == 0).all()
    truth = np.stack([[states[i + round(12.5 * h)] for h in (2, 4, 20)] for i in found.start_index])
    assert_near(found.prediction[:, [1, 3, 19]], truth, position=5e-5, rest=2e-4)


# -- the lag of the rotors ---------------------------------------------------------------------------------------------


def test_a_step_of_the_command_answers_with_the_rotors_lag() -> None:
    """Closed form: thrust f0 + (f1 - f0)(1 - exp(-t/tau)), its mean and its mean derivative."""
    tau, f0, f1 = 0.05, 0.08, 0.12
    stamps = np.array([-1.0, 0.0, 1e-9, 2.0])
    thrust = np.repeat([[f0], [f0], [f1], [f1]], 4, axis=1)
    drone = replace(DRONE, motor_time_constant=tau)
    course = ThrustCourse(inputs_of(stamps, thrust), vehicle=drone, effects={})
    begin, end = np.array([0.0, 0.02, 0.1]), np.array([0.02, 0.1, 0.35])
    mean, rate = course.over(begin, end, last=np.full(3, 3))

    def lagged(t: Array) -> Array:
        return f0 + (f1 - f0) * (1 - np.exp(-t / tau))

    area = f1 * (end - begin) + (f1 - f0) * tau * (np.exp(-end / tau) - np.exp(-begin / tau))
    assert np.allclose(mean, (area / (end - begin))[:, None], atol=1e-9)
    assert np.allclose(rate, ((lagged(end) - lagged(begin)) / (end - begin))[:, None], atol=1e-6)


def inputs_of(stamps: Array, thrust: Array, *, measured: bool = False) -> RotorInput:
    nothing = np.full(stamps.size, np.nan)
    return RotorInput(stamps, thrust, nothing, stamps - stamps[0], measured=measured)


@settings(max_examples=12)
@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.004, 0.05, 0.3]), st.sampled_from([0.0, 0.013]))
def test_lagged_thrust_agrees_with_a_solver(seed: int, tau: float, delay: float) -> None:
    rng = np.random.default_rng(seed)
    stamps = np.cumsum(rng.uniform(0.002, 0.03, 40))
    thrust = rng.uniform(0.0, 0.2, (40, 4))
    drone = replace(DRONE, motor_time_constant=tau)
    effects = {"input_delay": {"delay": delay}} if delay else {}
    course = ThrustCourse(inputs_of(stamps, thrust, measured=tau == 0.0), vehicle=drone, effects=effects)
    last = int(rng.integers(5, 39))
    begin = float(rng.uniform(stamps[2], stamps[last]))
    end = begin + float(rng.uniform(0.001, 0.2))
    mean, rate = course.over(np.array([begin]), np.array([end]), last=np.array([last]))

    def command(t: float) -> Array:  # a line between stamps; what comes after `last` is not known
        return np.array([np.interp(min(t, stamps[last]), stamps, thrust[:, c]) for c in range(4)])

    fine = np.unique(np.concatenate([stamps + delay, np.linspace(begin, end, 400)]))
    fine = fine[(fine >= stamps[0] + delay) & (fine <= end)]
    if tau == 0.0:
        level = np.array([command(t - delay) for t in fine])
    else:
        solved = solve_ivp(
            lambda t, y: (command(t - delay) - y) / tau, (fine[0], fine[-1]), thrust[0], t_eval=fine,
            rtol=1e-8, atol=1e-10, max_step=0.002,
        )  # fmt: skip
        level = solved.y.T
    inside = fine >= begin
    area = np.trapezoid(level[inside], fine[inside], axis=0)
    assert np.allclose(mean[0], area / (end - begin), atol=3e-5)
    assert np.allclose(rate[0], (level[-1] - level[inside][0]) / (end - begin), atol=3e-5 / (end - begin))


def test_measured_speeds_give_the_thrust_that_the_diagnosis_sees() -> None:
    """Where nothing is held back, both ways from speeds to mean thrust are one."""
    rng = np.random.default_rng(3)
    stamps = np.arange(0.0, 2.0, 0.01)
    inputs = replace(inputs_of(stamps, rng.uniform(0.05, 0.15, (stamps.size, 4)), measured=True), aged=False)
    effects = {"input_delay": {"delay": 0.007}, "rotor_sensor": {"rotor": 3, "scale": 1.1}}
    nodes = np.arange(0.5, 1.5, 0.013)
    mean, _ = rotor_thrust(inputs, nodes, vehicle=DRONE, effects=effects)
    course = ThrustCourse(inputs, vehicle=DRONE, effects=effects)
    ours, _ = course.over(nodes[:-1], nodes[1:], last=np.full(nodes.size - 1, stamps.size - 1))
    assert np.allclose(ours, mean[1:], atol=1e-12)


# -- sensors -----------------------------------------------------------------------------------------------------------


def shown(name: str, truth: Array, times: Array, fine: Array, fine_states: Array) -> tuple[dict[str, Any], Array]:
    """An effect on sensors, and the states as those would show them, from its definition."""
    seen = truth.copy()
    if name == "attitude_misalignment":
        turn = Rotation.from_euler("ZYX", [0.02, -0.05, 0.04])  # yaw, pitch, roll
        seen[:, 6:10] = (Rotation.from_quat(truth[:, 6:10]) * turn).as_quat()
        return {"roll": 0.04, "pitch": -0.05, "yaw": 0.02}, seen
    if name == "velocity_scale":
        seen[:, 3:6] *= [0.9, 1.1, 1.05]
        return {"x": 0.9, "y": 1.1, "z": 1.05}, seen
    if name == "gyro_bias":
        seen[:, 10:13] += [0.1, -0.2, 0.05]
        return {"x": 0.1, "y": -0.2, "z": 0.05}, seen
    late = np.searchsorted(fine, times - 0.02 - 1e-9)
    seen[:, 0:10] = fine_states[np.maximum(late, 0), 0:10]  # the gyro is not late
    return {"delay": 0.02, "streams": ["state"]}, seen


@pytest.mark.parametrize("name", ["attitude_misalignment", "velocity_scale", "gyro_bias", "measurement_delay"])
def test_a_prediction_is_of_what_the_sensors_would_show(name: str) -> None:
    thrust = smooth_thrust(7)
    fine = np.arange(0.0, 1.2, 0.001)
    states = fly(thrust, fine)
    truth = states[::10]
    values, seen = shown(name, truth, TIMES, fine, states)
    recording = recording_of(TIMES, seen, rotor_speed=(fine, speeds(thrust, fine)))
    found = predicted(recording, replace(DRONE, effects={name: values}))
    rows = found.start_index >= 5  # before, nothing was late yet
    expected = along(seen, found.start_index[rows], 50)
    assert_near(found.prediction[rows], expected, position=3e-4, rest=2e-3)
    plain = predicted(recording).prediction[rows]
    assert np.abs(plain - expected).max() > 0.01


def test_a_prediction_is_of_what_an_onboard_filter_makes_of_a_late_gyro() -> None:
    """The filter runs at 1 kHz and is drawn back to the true attitude; the prediction knows nothing but its shape."""
    late, back = 6, 0.04  # ms, s
    thrust = smooth_thrust(7)
    fine = np.arange(0.0, 1.2, 0.001)
    states = fly(thrust, fine)
    rate = states[np.maximum(np.arange(fine.size) - late, 0), 10:13]
    true, held = Rotation.from_quat(states[:, 6:10]), Rotation.from_quat(states[0, 6:10])
    made = []
    for i in range(fine.size):
        made.append(held.as_quat())
        off = (true[i].inv() * held).as_rotvec()
        held = held * Rotation.from_rotvec(0.001 * (rate[i] - off / back))
    seen = states.copy()
    seen[:, 6:10], seen[:, 10:13] = made, rate
    seen = seen[::10]
    recording = recording_of(TIMES, seen, rotor_speed=(fine, speeds(thrust, fine)))
    drone = replace(DRONE, effects={"measurement_delay": {"delay": 1e-3 * late, "streams": ["gyro"]}})
    errors = {}
    for claimed in ("onboard", "apart"):
        found = predicted(replace(recording, metadata={"claims": {"attitude": claimed}}), drone)
        rows = found.start_index >= 30  # before, the filter still forgets how it began
        wanted = along(seen, found.start_index[rows], 49)
        errors[claimed] = angle(found.prediction[rows][:, :-1, 6:10], wanted[..., 6:10])
    assert errors["onboard"] < 0.15 * errors["apart"]


# -- causality ---------------------------------------------------------------------------------------------------------

COMMANDED = replace(DRONE, thrust_curve=(0.0, 0.02, 0.005), rotor_constant=None, motor_time_constant=0.04)


def any_states(seed: int) -> Array:
    """What was flown does not matter here."""
    states = np.random.default_rng(seed).normal(size=(TIMES.size, 13)).cumsum(0) * 0.02 + START
    states[:, 6:10] /= np.linalg.norm(states[:, 6:10], axis=1, keepdims=True)
    return states


def commanded(seed: int) -> tuple[Recording, Vehicle]:
    rng = np.random.default_rng(seed)
    states = any_states(seed)
    stamps = np.arange(0.0, 1.2, 0.01) + 0.003
    duty, volts = rng.uniform(0.6, 0.8, (stamps.size, 4)), np.full((stamps.size, 1), 3.9)
    return recording_of(TIMES, states, motor_command=(stamps, duty), voltage=(stamps, volts)), COMMANDED


@settings(max_examples=10)
@given(st.integers(0, 100), st.integers(5, 80), st.integers(1, 30), st.booleans())
def test_nothing_later_than_a_start_or_its_inputs_is_used(seed: int, i: int, count: int, measured: bool) -> None:
    if measured:
        rng = np.random.default_rng(seed)
        recording = recording_of(TIMES, any_states(seed), rotor_speed=(TIMES, rng.uniform(1500, 1700, (TIMES.size, 4))))
        vehicle, signal = DRONE, "rotor_speed"
    else:
        (recording, vehicle), signal = commanded(seed), "motor_command"

    def from_start(changed_recording: Recording) -> Array:
        found = predicted(changed_recording, vehicle, horizon=count, plain=False)  # forces are learned from 0.3 s on
        result: Array = found.prediction[found.start_index == i]
        assert len(result) == 1
        return result

    before = from_start(recording)
    broken = recording
    for name in ("position", "velocity", "attitude", "body_rate"):
        value = recording.signals[name].value.copy()
        value[i + 1 :] = np.roll(value[i + 1 :], 1, axis=1) + 0.3
        broken = changed(broken, name, value=value)
    for name in {signal, "voltage"} & set(recording.signals):
        array = recording.signals[name]
        value = array.value.copy()
        value[array.time > TIMES[i] + (count - 1) * 0.01 + 1e-9] *= 0.9  # after the beginning of the last step
        broken = changed(broken, name, value=value)
    assert np.array_equal(before, from_start(broken))
    if count > 3:  # and what is given is used
        array = recording.signals[signal]
        value = array.value.copy()
        value[array.time > TIMES[i]] *= 0.9
        assert not np.array_equal(before, from_start(changed(recording, signal, value=value)))


def test_the_lag_at_a_start_comes_from_the_inputs_before_it() -> None:
    recording, vehicle = commanded(3)
    array = recording.signals["motor_command"]
    value = array.value.copy()
    value[array.time < 0.5] *= 0.8
    other = predicted(changed(recording, "motor_command", value=value), vehicle, horizon=5)
    one = predicted(recording, vehicle, horizon=5)
    assert np.abs(one.prediction[52] - other.prediction[52]).max() > 1e-3  # 20 ms later, a lag of 40 ms
    assert np.abs(one.prediction[110] - other.prediction[110]).max() < 1e-6


# -- what a recording may lack -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("missing", ["velocity", "body_rate"])
def test_a_recording_without_a_whole_state_is_refused(missing: str) -> None:
    recording, _ = flight(smooth_thrust(1))
    signals = {k: v for k, v in recording.signals.items() if k != missing}
    with pytest.raises(DataError, match=f"made.csv: the recording has no {missing}"):
        recorded(replace(recording, signals=signals), DRONE)


def test_a_horizon_longer_than_the_recording_is_refused() -> None:
    recording, _ = flight(smooth_thrust(1))
    with pytest.raises(DataError, match="no state can be predicted from"):
        predicted(recording, horizon=500)


def test_starts_before_a_gap_of_the_inputs_are_left_out() -> None:
    recording, _ = flight(smooth_thrust(1))
    array = recording.signals["rotor_speed"]
    keep = (array.time < 0.4) | (array.time > 0.6)
    signals = dict(recording.signals)
    signals["rotor_speed"] = replace(
        array, time=array.time[keep], value=array.value[keep], order=array.order[keep],
        host_time=array.host_time[keep], marked=array.marked[keep],
    )  # fmt: skip
    found = predicted(replace(recording, signals=signals), horizon=10)
    reached = (found.start_time + 0.1 > 0.4) & (found.start_time < 0.599)
    assert not reached.any()
    assert found.start_time.max() > 0.7
    assert (found.start_time < 0.3).any()


def test_a_missing_rate_is_the_newest_known_and_its_age_is_told() -> None:
    recording, _ = flight(smooth_thrust(1))
    value = recording.signals["body_rate"].value.copy()
    value[10:13] = np.nan
    value[40:50] = np.nan
    found = predicted(changed(recording, "body_rate", value=value), horizon=5)
    age = dict(zip(found.start_index.tolist(), found.start_age.tolist(), strict=True))
    assert age[9] == 0.0
    assert age[12] == pytest.approx(0.03)
    assert 47 not in age
    assert 50 in age


def test_the_step_of_integration_is_fine_enough_for_10_ms() -> None:
    recording, _ = flight(smooth_thrust(9))
    found = recorded(recording, DRONE)
    rows = np.arange(0, 60, 5)
    grid = found.time[rows[:, None] + np.arange(51)]
    simulator = Simulator(found.inputs)
    coarse, fine = (simulator.run(found.state[rows], grid, substep=h) for h in (5e-3, 2.5e-4))
    assert np.abs(coarse - fine)[..., :3].max() < 5e-5


# -- the command, and the benchmark's protocol -------------------------------------------------------------------------


def tool_of(shared_recordings: Path) -> Any:
    path = shared_recordings.parent / "tools" / "nanodrone_eval.py"
    if not path.is_file():
        pytest.skip("needs nanodrone_eval.py in ../shared")
    spec = importlib.util.spec_from_file_location("nanodrone_eval", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_protocol_of_the_nano_drone_benchmark(shared_recordings: Path, tmp_path: Path) -> None:
    """Shape and rows are those the benchmark's own tool scores, and its scores are those of the library."""
    from crazyem.diagnosis.prediction.horizon import lengths

    tool = tool_of(shared_recordings)
    name = "square_run4"
    folder = shared_recordings / "nanodrone" / "processed"
    drone = replace(load_vehicle("cf21bl"), mass=0.045, inertia=(2.3951e-5, 2.3951e-5, 3.2347e-5))
    vehicle = tmp_path / "nano.toml"
    vehicle.write_text(drone.to_toml())
    out = tmp_path / "out.npz"
    file = str(folder / f"{name}.csv.gz")
    assert main(["predict", file, "--vehicle", str(vehicle), "--horizon", "50", "-o", str(out)]) == 0
    with np.load(out, allow_pickle=False) as arrays:
        prediction, index = arrays["prediction"], arrays["start_index"]
        assert float(arrays["step"]) == pytest.approx(0.01)
    states, _ = tool.load_run(name, str(folder))
    assert prediction.shape == (len(states) - 50, 50, 13)
    assert (index == np.arange(len(states) - 50)).all()
    scores = tool.metrics([states], [prediction], "clean")
    truth = along(states, index, 50)
    columns = {"pos": slice(0, 3), "vel": slice(3, 6), "rot": slice(6, 10), "omega": slice(10, 13)}
    for key, part in columns.items():
        ours = lengths(prediction[..., part], truth[..., part], attitude=key == "rot").mean(0)
        assert np.allclose(ours, scores[key], atol=1e-9)
    assert scores["pos"].sum() < 15.0
    assert scores["pos"][0] < 0.003


def test_raw_runs_and_other_sets_are_predicted_too(shared_recordings: Path) -> None:
    raw = open_recording(shared_recordings / "nanodrone" / "raw" / "square_run4.csv.gz")
    found = predict(recorded(raw, load_vehicle("cf21bl")), horizon=50, every=20)
    assert np.isfinite(found.prediction).all()
    assert found.airborne.mean() > 0.5
    bench = open_recording(shared_recordings / "nanobench" / "B2_circle_slow_rep1.csv.gz")
    assert np.isfinite(predict(recorded(bench, load_vehicle("cf2")), horizon=50, every=20).prediction).all()
    flown = open_recording(shared_recordings / "real_firmware" / "lee_34g_mass_pushed_midflight.csv.gz")
    heavy = replace(load_vehicle("cf2"), mass=0.034, motor_time_constant=0.03)
    shown_ = recorded(flown, heavy)
    found = predict(shown_, horizon=10, every=10)
    flying = found.airborne & (found.start_time > shown_.inputs.took_off + 1.0) & (found.start_time < 29.0)
    truth = np.stack([shown_.state[i + 10] for i in np.searchsorted(shown_.time, found.start_time[flying])])
    error = np.linalg.norm(found.prediction[flying, 9, 0:3] - truth[:, 0:3], axis=1)
    assert np.median(error) < 0.003  # the right mass and lag; its noise, and the estimate's corrections


def test_the_command_says_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flights = tmp_path / "flight.csv"
    flights.write_text("nothing\n")
    assert main(["predict", str(flights), "--horizon", "5", "-o", str(flights), "--force"]) == 2
    assert "never written in place" in capsys.readouterr().err
    assert main(["predict", str(flights), "--horizon", "0", "-o", "x.npz"]) == 2
    assert main(["predict", str(tmp_path / "none.csv"), "--horizon", "5", "-o", str(tmp_path / "x.npz")]) == 2
    assert not (tmp_path / "x.npz").exists()
