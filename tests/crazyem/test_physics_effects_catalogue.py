"""The catalogue: names and parameters as agreed, neutral changes nothing, one file adds an effect, nothing blows up."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from effects_cases import CF2, ROTORS, still, wild
from hypothesis import assume, given
from hypothesis import strategies as st

from crazyem.errors import FileFormatError
from crazyem.physics.effects.catalogue import CATALOGUE, check_effects, discover
from crazyem.physics.effects.effect import Effect, Effects, Parameter, Wrench
from crazyem.physics.motion import RotorInput, body_of, measured, motion, rotor_thrust, vehicle_values
from crazyem.vehicle import parse_vehicle

AGREED = {  # issue 5: names are an interface
    "payload": "mass x y z", "thrust_scale": "scale", "rotor_fault": "rotor scale onset_time",
    "center_of_mass": "x y z", "linear_drag": "x y z", "quadratic_drag": "x y z",
    "velocity_moment": "roll_per_vy pitch_per_vx", "rate_damping": "x y z", "motor_lag": "time_constant",
    "input_delay": "delay", "measurement_delay": "delay streams", "battery_sag": "gain_per_volt gain_per_second",
    "thrust_curve": "slope_error", "ground_effect": "strength height", "wind": "x y z",
    "gusts": "standard_deviation correlation_time", "attitude_misalignment": "roll pitch yaw",
    "accelerometer_misalignment": "roll pitch yaw", "gyro_bias": "x y z", "velocity_scale": "x y z",
    "rotor_inertia": "inertia", "inertia": "xx yy zz", "inertia_products": "xy xz yz", "torque_scale": "scale",
    "suspended_load": "mass length", "rotor_sensor": "rotor scale",
    "trim": "x y z",  # not of the issue: what real drones need
    "sampled_commands": "tilt turn",  # nor this
    "onboard_filter": "rate_lag velocity_lag attitude_lag lateral_time_constant",  # nor this: what every log needs
    "force_by_place": "x y z xx xy xz yx yy yz zx zy zz",  # nor this: a rival of named ones, never named itself
}  # fmt: skip

SIGNALS = {
    "voltage", "rotor_speed", "motor_command", "specific_force", "position", "attitude", "body_rate", "velocity",
}  # fmt: skip


def flown_inputs(*, measured_speeds: bool, n: int = 60) -> RotorInput:
    time = 0.01 * np.arange(n)
    thrust = 0.07 + 0.01 * np.sin(np.multiply.outer(time, [5.0, 7.0, 9.0, 11.0]))
    return RotorInput(time, thrust, np.linspace(4.1, 3.6, n), time + 3, measured=measured_speeds)


def test_names_and_parameters_are_those_agreed() -> None:
    assert {name: " ".join(p.name for p in effect.parameters) for name, effect in CATALOGUE.items()} == AGREED


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_effect_says_what_it_needs_and_what_would_tell_it_apart(name: str) -> None:
    effect = CATALOGUE[name]
    assert effect.name == name
    assert effect.separates[0].islower()
    assert not effect.separates.endswith(".")
    for holder in (effect, *effect.parameters):
        assert {*holder.needs, *holder.without} <= SIGNALS
    own = vehicle_values(ROTORS).get(name, {})
    for p in effect.parameters:
        neutral = effect.complete({}, own)[p.name]
        if p.chosen:
            assert neutral in p.chosen
        elif neutral is not None:
            assert p.low <= neutral <= p.high
            assert 0 < p.scale <= (p.high - p.low) / 10


@pytest.mark.parametrize("name", CATALOGUE)
def test_neutral_changes_nothing(name: str) -> None:
    situation = wild(50, seed=1)
    effects: Effects = {name: {}}
    for vehicle in (ROTORS, CF2):
        plain, with_it = (motion(situation, vehicle=vehicle, effects=e) for e in ({}, effects))
        np.testing.assert_array_equal(with_it.specific_force, plain.specific_force)
        np.testing.assert_array_equal(with_it.angular_acceleration, plain.angular_acceleration)
    shown = measured(situation, vehicle=ROTORS, effects=effects)
    assert not shown.state.any()
    assert not shown.specific_force.any()
    nodes = 0.01 * np.arange(5, 50)
    for measured_speeds in (False, True):
        inputs = flown_inputs(measured_speeds=measured_speeds)
        before, after = (rotor_thrust(inputs, nodes, vehicle=ROTORS, effects=e) for e in ({}, effects))
        np.testing.assert_array_equal(after[0], before[0])
        np.testing.assert_array_equal(after[1], before[1])


def changeable(path, effects):
    """What effects can change, each in one row: motion; what sensors show; thrust by commands and by speeds."""
    moved, shown = (f(path, vehicle=ROTORS, effects=effects) for f in (motion, measured))
    thrust = [
        rotor_thrust(flown_inputs(measured_speeds=speeds), 0.01 * np.arange(5, 50), vehicle=ROTORS, effects=effects)[0]
        for speeds in (False, True)
    ]
    arrays = (moved.specific_force, moved.angular_acceleration), (shown.state, shown.specific_force), thrust
    return [np.concatenate([a.ravel() for a in part]) for part in arrays]


@pytest.mark.parametrize("name", [n for n in CATALOGUE if n != "gusts"])
def test_away_from_neutral_it_changes_something(name):
    """Each effect, a few scales away, is seen by exactly the function that it is for."""
    effect = CATALOGUE[name]
    values = dict(effect.complete({}, vehicle_values(ROTORS).get(name, {})))
    for p in effect.parameters:
        if not p.chosen and values[p.name] is not None:
            values[p.name] += 3 * p.scale
    path = still(60, velocity=np.c_[np.sin(0.1 * np.arange(60)), np.cos(0.1 * np.arange(60)), np.ones(60)],
                 body_rate=[0.1, 0.2, 0.3], specific_force=[1.0, 2.0, 9.0], thrust=[0.08, 0.07, 0.07, 0.07],
                 thrust_rate=[0.1, 0, 0, 0])  # fmt: skip
    largest = [np.abs(a - b).max() for a, b in zip(changeable(path, {}), changeable(path, {name: values}))]
    assert (largest[0] > 1e-6) == any((effect.rotors, effect.turning, effect.body, effect.external, effect.tied))
    assert (largest[1] > 0) == (effect.measured is not None)
    assert (largest[2] > 1e-9) == any((effect.commanded, effect.speed, effect.timing))


def everything(name, values):
    """All that an effect can change on a short flight near the floor, in one row."""
    t = 0.01 * np.arange(60)
    path = still(60, velocity=np.c_[np.sin(5 * t), np.cos(3 * t), np.sin(4 * t)], position=np.c_[t, 1 - t, 1 + t],
                 body_rate=np.c_[t, np.sin(9 * t), 1 - t],
                 specific_force=[1.0, 2.0, 9.0], thrust=[0.08, 0.07, 0.07, 0.07], thrust_rate=[0.1, 0, 0, 0],
                 angular_acceleration=np.c_[np.cos(t), 9 * np.cos(9 * t), t], height=np.full(60, 0.1),
                 fused=True)  # fmt: skip
    return np.concatenate(changeable(path, {name: values}))


@pytest.mark.parametrize("name", [n for n in CATALOGUE if n != "gusts"])
def test_where_a_fit_begins_every_parameter_matters(name: str) -> None:
    effect = CATALOGUE[name]
    base = effect.complete({}, vehicle_values(ROTORS).get(name, {}))
    base |= effect.nudge
    known = [p.name for p in effect.parameters]
    assert {*effect.nudge, *effect.beginnings, *(n for group in effect.alternatives for n in group)} <= set(known)
    assert effect.amplitude in ("", *known)
    for begin in [{}, *({p: value} for p, values in effect.beginnings.items() for value in values)]:
        here = everything(name, {**base, **begin})
        for p in effect.parameters:
            if not p.chosen and p.neutral is not None:
                there = everything(name, {**base, **begin, p.name: {**base, **begin}[p.name] + p.scale})
                assert np.abs(there - here).max() > 1e-9, (p.name, begin)


def numbers(parameter: Parameter) -> st.SearchStrategy:
    if parameter.chosen:
        return st.sampled_from(parameter.chosen)
    if parameter.neutral is None:
        return st.none() | st.floats(parameter.low, parameter.high)
    return st.floats(parameter.low, parameter.high) | st.sampled_from([parameter.low, parameter.high])


def admitted(name: str) -> st.SearchStrategy:
    values = st.fixed_dictionaries({p.name: numbers(p) for p in CATALOGUE[name].parameters})
    return st.fixed_dictionaries({name: values})


anything = st.sampled_from(sorted(CATALOGUE)).flatmap(admitted)


@given(one=anything, other=anything, seed=st.integers(0, 5), voltage=st.booleans())
def test_whatever_is_admitted_is_finite(one: Effects, other: Effects, seed: int, voltage: bool) -> None:
    effects = {**one, **other}
    check_effects(effects, where="test")
    assume(np.linalg.eigvalsh(body_of(CF2, effects).inertia)[0] > 0)  # others are refused with their file (folding.py)
    situation = wild(30, seed=seed, speed=5.0, vehicle=CF2 if seed % 2 else ROTORS)
    moved = motion(situation, vehicle=CF2, effects=effects)
    shown = measured(situation, vehicle=CF2, effects=effects)
    inputs = flown_inputs(measured_speeds=bool(seed % 3))
    if not voltage:
        inputs.voltage[:] = np.nan
    mean, rate = rotor_thrust(inputs, 0.01 * np.arange(5, 50), vehicle=ROTORS, effects=effects)
    for array in (moved.specific_force, moved.angular_acceleration, shown.state, shown.specific_force, mean, rate):
        assert np.isfinite(array).all()


@given(lag=st.floats(0.02, 0.08), delay=st.floats(0.0, 0.01), stop=st.integers(1, 3))
def test_rows_at_which_a_stretch_begins_go_by_lag_and_delay_without_jumps(lag: float, delay: float, stop: int) -> None:
    """They hold the lagged command there, whichever command before is the first that counts."""
    time = 0.01 * np.arange(200)
    thrust = np.repeat(np.where(time < 0.3 * stop, 0.0, 0.07), 4).reshape(-1, 4)  # the rotors stood still, then hover
    inputs = RotorInput(time, thrust, np.full(time.size, 4.0), time, measured=False)
    nodes = 1.0 + 0.01 * np.arange(30)

    def thrusts(change: float) -> tuple[np.ndarray, np.ndarray]:
        effects: Effects = {"motor_lag": {"time_constant": lag * (1 + change)}, "input_delay": {"delay": delay}}
        return rotor_thrust(inputs, nodes, vehicle=ROTORS, effects=effects, breaks=[15])

    (here, rate), (there, other) = thrusts(0.0), thrusts(1e-4)
    assert np.abs(there - here).max() < 1e-5
    assert np.abs(other - rate).max() < 1e-3
    assert not rate[[0, 15]].any()
    since = 1.0 - delay - 0.3 * stop  # s, and up to a sample more: a command may act from the middle between stamps
    low, high = (0.07 * (1 - math.exp(-s / lag)) for s in (since, since + 0.01))
    forgotten = 0.07 * math.exp(-10.0)  # what was commanded ten lags ago
    assert low - forgotten <= here[0, 0] <= high + forgotten
    assert here[15] == pytest.approx(rotor_thrust(inputs, nodes, vehicle=ROTORS, effects={
        "motor_lag": {"time_constant": lag}, "input_delay": {"delay": delay}})[0][14:16].mean(0), rel=0.05)  # fmt: skip


# --- one file ---------------------------------------------------------------------------------------------------------

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "effects.md"
ONE_FILE = PAGE.read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]  # the example that readers see


def test_an_effect_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tail_rope_of_a_test.py").write_text(ONE_FILE)
    monkeypatch.syspath_prepend(tmp_path)
    found = discover([str(tmp_path)])
    sys.modules.pop("tail_rope_of_a_test")
    assert list(found) == ["tail_rope"]
    monkeypatch.setitem(CATALOGUE, "tail_rope", found["tail_rope"])
    check_effects({"tail_rope": {"force": 0.01}}, where="test")
    moved = motion(still(), vehicle=CF2, effects={"tail_rope": {"force": 0.01}})
    np.testing.assert_allclose(moved.specific_force[0], [-0.01 / 0.029, 0, 4 * 0.07 / 0.029])
    text = CF2.to_toml() + "\n[effects.tail_rope]\nforce = 0.01\n"  # and a vehicle file takes it
    assert motion(still(), vehicle=CF2, effects=parse_vehicle(text).effects).specific_force[0, 0] < 0


def test_two_effects_of_one_name_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("rope_one", "rope_two"):
        (tmp_path / f"{name}.py").write_text(ONE_FILE)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match="two effects are called tail_rope"):
        discover([str(tmp_path)])
    for name in ("rope_one", "rope_two"):
        sys.modules.pop(name, None)


def test_effects_act_in_their_order_and_not_in_that_of_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    one: Effects = {"payload": {"mass": 0.005, "x": 0.02}, "center_of_mass": {"x": 0.01}}
    other: Effects = dict(reversed(one.items()))
    first, second = (motion(still(), vehicle=CF2, effects=e) for e in (one, other))
    np.testing.assert_array_equal(first.angular_acceleration, second.angular_acceleration)
    assert [e.order for e in CATALOGUE.values()] == sorted(e.order for e in CATALOGUE.values())
    nothing = Effect("late_comer", (), external=lambda s, b: Wrench(np.ones((s.size, 3)), np.zeros((s.size, 3))))
    monkeypatch.setitem(CATALOGUE, "late_comer", nothing)
    assert motion(still(), vehicle=CF2, effects={"late_comer": {}}).specific_force[0, 0] == pytest.approx(1 / 0.029)


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ({"paylod": {}}, "a.toml: unknown effect 'paylod' (known: inertia, "),
        ({"payload": {"weight": 1}}, "a.toml: effect 'payload' has no parameter 'weight' (known: mass, x, y, z)"),
        ({"payload": {"mass": -1}}, "parameter 'mass' of effect 'payload' must be a number in [0, 1], got -1"),
        ({"payload": {"mass": True}}, "must be a number in [0, 1], got True"),
        ({"payload": {"mass": math.nan}}, "must be a number in [0, 1], got nan"),
        ({"payload": {"mass": "heavy"}}, "must be a number in [0, 1], got 'heavy'"),
        ({"rotor_fault": {"rotor": 5}}, "must be one of [1, 2, 3, 4], got 5"),
        ({"rotor_fault": {"rotor": True}}, "must be one of [1, 2, 3, 4], got True"),
        ({"rotor_fault": {"rotor": [1]}}, "must be one of [1, 2, 3, 4], got [1]"),
        ({"measurement_delay": {"streams": ["sonar"]}}, "must be a list of some of ['state', 'pose', "),
        ({"measurement_delay": {"streams": [["state"]]}}, "must be a list of some of ['state', 'pose', "),
        ({"measurement_delay": {"streams": "state"}}, "must be a list of some of ['state', 'pose', "),
        ({"measurement_delay": {"streams": []}}, "must be a list of some of ['state', 'pose', "),
    ],
)
def test_what_the_catalogue_does_not_know_is_refused_in_a_sentence(effects: Effects, message: str) -> None:
    with pytest.raises(FileFormatError) as caught:
        check_effects(effects, where="a.toml")
    assert message in str(caught.value)


def test_what_a_vehicle_file_can_say_is_admitted() -> None:
    text = CF2.to_toml() + (
        '\n[effects.measurement_delay]\ndelay = 0.01\nstreams = ["pose", "gyro"]\n'
        "[effects.rotor_fault]\nrotor = 2\nscale = 0.9\n"
    )
    vehicle = parse_vehicle(text)
    check_effects(vehicle.effects, where="a.toml")
    shown = measured(still(5, body_rate=[1.0, 0, 0]), vehicle=vehicle, effects=vehicle.effects)
    assert shown.state.shape == (5, 12)
    assert parse_vehicle(vehicle.to_toml()) == vehicle
