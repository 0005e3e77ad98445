"""What tells apart where the filter cannot: an accelerometer, commands beside rotor speeds, flights held out by place.

Recordings are made by hand or flown by `closed_loop.py`, which shares no line with the diagnosis.
"""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop import DRONE, Hidden, fly
from diagnosis_parts import LAG, LATE, data_of, nominal_of, start_point
from made_flight import array_of, changed
from scipy.special import expit, logit

from crazyem.diagnosis.diagnose import _corroborated
from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.fit import Data, Fitted, nominal, with_torque_memory
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.nuisances import refine_base
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.locating.place import depends_on_place
from crazyem.diagnosis.naming.answer import answer_of
from crazyem.diagnosis.naming.corroboration import _lag_of, false_speed, late_measurements
from crazyem.diagnosis.naming.trials import (
    Selection,
    Step,
    Trial,
    between,
    distinguishable,
    margin,
    presence,
    scatter,
)
from crazyem.diagnosis.naming.unexplained import Unexplained
from crazyem.diagnosis.settings import CONFIDENCE, SELECTION
from crazyem.recordings.recording import Recording


def point_of(data: Data) -> Point:
    return nominal(data, start_point())


@pytest.fixture(scope="module")
def recording() -> Recording:
    return fly(seconds=10.0)


@pytest.fixture(scope="module")
def sudden() -> Recording:
    return fly(seconds=10.0, hop=0.6)


def with_speeds(recording: Recording, factors: tuple[float, ...]) -> Recording:
    """Speeds that go with the square root of the command, times factors; healthy rotors differ by 0.1 %."""
    command = recording.signals["motor_command"]
    speed = 2000.0 * np.sqrt(np.maximum(command.value, 1e-3)) * factors * [1.001, 1.0, 0.999, 1.0]
    shown = array_of("rotor_speed", command.time, speed, place=90)
    return replace(recording, signals={**recording.signals, "rotor_speed": shown})


def test_commands_tell_a_sensor_that_counts_wrong_from_a_weak_rotor(recording: Recording) -> None:
    counts_wrong = with_speeds(recording, (1.0, 1.06, 1.0, 1.0))
    healthy = with_speeds(recording, (1.0, 1.0, 1.0, 1.0))
    lag = 1e-3  # the made speeds answer at once
    said, unsaid = false_speed([counts_wrong], 2, 1.06, lag), false_speed([healthy], 2, 1.06, lag)
    assert unsaid is not None
    assert said > 10.0
    assert unsaid < -10.0
    assert abs(said + unsaid) < 4.0  # the two hypotheses are each other's mirror
    assert false_speed([recording], 2, 1.06, lag) is None  # no speeds


@pytest.mark.parametrize("named", ["rotor_fault", "rotor_sensor"])
def test_what_commands_say_counts_for_a_sensor_that_counts_wrong(recording: Recording, named: str) -> None:
    """Also where a steady balance had taken it for a weak rotor: then that balance decides nothing any more."""
    data, scale = data_of(recording), 1.06
    start = point_of(data)
    candidate = Candidate(named, (("rotor", 2),), ("scale",))
    values = {"rotor": 2, "scale": scale if named == "rotor_sensor" else scale**-2}
    final = start.with_effects({named: values})
    fitted = Fitted(final, (candidate,), 0.0, data.gram(final, candidate.columns(final)), np.zeros(1))
    odds = None if named == "rotor_sensor" else 1.0
    taken = Trial(candidate, 20.0, 20.0, 1.0, 40.0, fitted, True, data.block_loglik(final), 40.0, log_odds=odds)
    taken = replace(taken, expected=20.0)
    load = replace(taken, candidate=Candidate("payload", (), ("mass",)), log_odds=None)
    selection = Selection(start, final, (Step((taken, load), taken, (load,)),), (candidate,), fitted)
    shown = with_speeds(recording, (1.0, scale, 1.0, 1.0))
    found, witnessed = _corroborated(data, None, selection, [shown])
    one = found.steps[0].taken
    assert (one.candidate.effect, one.log_odds) == ("rotor_sensor", None)
    expected = false_speed([shown], 2, scale, DRONE.motor_time_constant)
    assert expected is not None
    assert one.other_evidence == pytest.approx(expected)
    assert one.presence(1) == pytest.approx(
        min(CONFIDENCE.max_probability, expit(logit(presence(20.0, 20.0, 20.0)) + expected))
    )
    assert replace(one, other_evidence=0.5).presence(1) == pytest.approx(expit(logit(presence(20.0, 20.0, 20.0)) + 0.5))
    assert found.steps[0].alike == ()
    assert witnessed == {"rotor_fault", "rotor_sensor"}
    healthy, _ = _corroborated(data, None, selection, [with_speeds(recording, (1.0, 1.0, 1.0, 1.0))])
    assert healthy.steps[0].taken is not None
    assert healthy.steps[0].taken.other_evidence == 0.0


def felt(recording: Recording, late: float, shaken: float = 1.0) -> Recording:
    """With the thrust of the made drone itself, low-passed as its rotors are, `late` by so many s, as accelerometer;
    `shaken` times its noise."""
    command = recording.signals["motor_command"]
    volts = recording.signals["voltage"].value
    lag = DRONE.motor_time_constant
    f = (command.value * volts * 0.04).sum(1)
    thrust = f.copy()
    for k in range(1, len(f)):
        thrust[k] = f[k - 1] + (thrust[k - 1] - f[k - 1]) * np.exp(-0.01 / lag)
    noise = np.random.default_rng(1).normal(size=(len(f), 3)) * 0.02
    z = np.interp(command.time - 7.5e-3 - late, command.time, thrust) / DRONE.mass
    shown = array_of("specific_force", command.time, np.column_stack([0 * z, 0 * z, z]) + shaken * noise, place=91)
    return replace(recording, signals={**recording.signals, "specific_force": shown})


@pytest.mark.parametrize(("late", "sign"), [(0.0, 1.0), (0.020, -1.0)], ids=["punctual", "late"])
@pytest.mark.parametrize("start", ["sudden", "slow"])
def test_an_accelerometer_tells_late_forces_from_late_measurements(recording, sudden, late, sign, start):
    """Punctual forces speak for late measurements, late ones for late inputs. Without a sudden start, forces in the
    band tell the lag; slow ones, which the model may lack, do not."""
    shown = felt(sudden if start == "sudden" else recording, late)
    if start == "slow":
        force = shown.signals["specific_force"].value
        drift = np.linspace(0.0, 1.0, len(force))
        shown = changed(shown, "specific_force", value=force + np.outer(drift, [0.0, 0.0, 1.0]))
    data, point = nominal_of(shown)
    assert sign * late_measurements(data, point, 0.020) > (3.0 if start == "sudden" else SELECTION.separating)


def test_without_an_accelerometer_nothing_is_said_of_a_delay(recording):
    assert late_measurements(*nominal_of(recording), 0.010) is None


def test_noise_of_an_accelerometer_does_not_move_its_lag(sudden: Recording) -> None:
    said = []
    for shaken in (1.0, 10.0):
        data = data_of(felt(sudden, 0.020, shaken))
        lag = _lag_of(data.models[0], point_of(data))
        assert lag is not None
        said.append(lag)
    assert abs(said[1][0] - said[0][0]) < 3.0 * said[1][1] ** 0.5
    assert said[1][1] > said[0][1]


def test_a_witness_is_heard_on_the_flights_held_out_too(sudden: Recording) -> None:
    """The accelerometer of the flight that was fitted says nothing, that of the one kept apart tells late from
    punctual."""
    silent = felt(sudden, 0.0, shaken=1e4)
    data = data_of(silent)
    nominal = point_of(data)
    late = LATE
    final = nominal.with_effects({"input_delay": {"delay": 0.020}})
    fitted = Fitted(final, (late,), 0.0, data.gram(final, late.columns(final)), np.zeros(1))
    selection = Selection(nominal, final, (), (late,), fitted)
    assert _corroborated(data, None, selection, [silent])[1] == frozenset()
    for seconds, told in ((0.0, {"measurement_delay", "input_delay"}), (0.020, {"input_delay"})):
        apart = data_of(felt(sudden, seconds))
        assert _corroborated(data, apart, selection, [silent])[1] == told


def test_a_group_holds_the_name_that_is_told(recording: Recording) -> None:
    """Late inputs and late measurements are one model, fitted as the first; told as the second, so is its group."""
    data = data_of(recording)
    start = point_of(data)
    late = LATE
    fitted = refine_base(data, start.with_effects({"input_delay": {"delay": 0.01}}), [late], rounds=1, noise=False)
    own = data.block_loglik(fitted.point)
    taken = Trial(late, 50.0, 0.0, 1.0, 50.0, fitted, True, own, 50.0)
    lag = replace(taken, candidate=LAG)
    selection = Selection(start, fitted.point, (Step((taken, lag), taken, (lag,)),), (late,), fitted)
    for witnessed, name, group in (
        ({"measurement_delay", "input_delay"}, "measurement_delay", ("measurement_delay", "motor_lag")),
        ({"input_delay"}, "input_delay", ("input_delay", "motor_lag")),
        (set(), "input_delay", ("input_delay", "motor_lag", "measurement_delay")),
    ):
        told = answer_of(data, selection, Unexplained((), 50.0), corroborated=frozenset(witnessed), in_place={})
        assert [e.name for e in told.effects] == [name]
        assert told.groups == (group,)


def test_blocks_know_their_recording() -> None:
    data = Data([flight_of(fly(seed=s, seconds=t), DRONE) for s, t in ((1, 6.0), (2, 12.0))])
    point = point_of(data)
    blocks, of = data.block_loglik(point), data.recordings_of_blocks()
    assert np.bincount(of, blocks) == pytest.approx([m.sweep(point).loglik for m in data.models], rel=1e-6)


def test_sampled_commands_are_torques_with_the_memory_of_the_lag() -> None:
    """A noisy gyro at 500 Hz makes commands of which the log at 100 Hz sees every fifth."""
    data = data_of(fly(rate_noise=0.15, shake=0.02, seconds=9.0))
    white = start_point()
    data.settle(white)
    white = data.fit_noise(white)
    remembered = with_torque_memory(data, white)
    assert remembered.noise.memory == DRONE.motor_time_constant
    assert np.all(remembered.noise.disturbance[3:] > 0.1)
    assert data.loglik(remembered) > data.loglik(white) + 3.0


def test_a_force_that_depends_on_place_holds_on_the_next_flight() -> None:
    pulled = [data_of(fly(Hidden(rope=0.02), seed=s, seconds=9.0)) for s in (1, 2)]
    free = [data_of(fly(seed=s, seconds=9.0)) for s in (1, 2)]
    found = depends_on_place(pulled[0], pulled[1], settled(pulled))
    assert (found.signal, found.axis, found.variable) == ("force", "x", "x")
    assert depends_on_place(free[0], free[1], settled(free)) is None


def settled(both: list[Data]) -> Point:
    point = point_of(both[0])
    both[1].settle(point)
    return point


def trial(blocks: np.ndarray, parameters: int = 1) -> Trial:
    names = ("x", "y", "z")[:parameters]
    return Trial(Candidate("linear_drag", (), names), 0.0, 0.0, 1.0, 0.0, blocks=blocks, value=float(blocks.sum()))


def test_what_two_explanations_share_does_not_blur_their_difference() -> None:
    rng = np.random.default_rng(0)
    shared = 100.0 * rng.normal(size=50)  # what both miss
    better = trial(shared + 0.3 + 0.1 * rng.normal(size=50))
    nats, sd = margin(better, trial(shared))
    assert nats == pytest.approx(15.0, abs=3.0)
    assert sd < 2.0
    assert distinguishable(better, trial(shared))
    assert not distinguishable(trial(shared), trial(shared))
    assert not distinguishable(trial(shared + 2.0 * rng.normal(size=50) + 0.1), trial(shared))
    assert margin(trial(shared, 3), trial(shared, 1))[0] == pytest.approx(-2.0)  # a parameter costs a nat


@pytest.mark.parametrize("recordings", [5, 9, 20])
def test_what_is_a_recordings_own_is_seen_between_recordings(recordings: int) -> None:
    """Each recording is off as a whole: by the blocks alone the error of the sum looks several times too small."""
    rng = np.random.default_rng(1)
    length = rng.integers(10, 40, recordings)
    of = np.repeat(np.arange(recordings), length)
    sums, told, blocks = [], [], []
    for _ in range(400):
        apart = rng.normal(size=recordings)[of] + rng.normal(size=of.size)
        sums.append(apart.sum())
        told.append(between(apart, of))
        blocks.append(scatter(apart))
    truth = float(np.sqrt(np.sum(length**2) + of.size))
    assert np.std(sums) == pytest.approx(truth, rel=0.1)
    assert np.sqrt(np.mean(np.square(told))) == pytest.approx(truth, rel=0.15)
    assert np.mean(blocks) < 0.6 * truth


def test_few_recordings_do_not_tell_how_they_differ() -> None:
    apart = np.repeat([5.0, -5.0, 0.0, 1.0], 10)
    assert between(apart, np.repeat(np.arange(4), 10)) == 0.0
    assert between(apart, np.zeros(0, int)) == 0.0
    of = np.repeat(np.arange(5), 8)
    one, other = trial(np.repeat([5.0, -2.0, 5.0, -2.0, 4.0], 8)), trial(np.zeros(40))
    assert distinguishable(one, other)
    assert not distinguishable(replace(one, recording=of), replace(other, recording=of))
