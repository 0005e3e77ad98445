"""INDI's effectiveness, Mellinger's massThrust and the filter's drag through the guard; the order of writes is safe."""

import math
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import test_guard
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import butter, tf2ss

from crazyem.control.command_units import LOOP, effectiveness_torque, lag_share, rotor_reaction_factor
from crazyem.estimation.result import Estimate
from crazyem.estimation.verdict import NOT_CONVERGED
from crazyem.live.controllers import (
    INDI,
    LEE,
    MELLINGER,
    Slot,
    for_vehicle,
    with_drag,
    writes_back,
    writes_for,
)
from crazyem.live.guard import Guard, Limits
from crazyem.live.push import nominal_estimates, push_target
from crazyem.vehicle import load_vehicle

CF2, BRUSHLESS = load_vehicle("cf2"), load_vehicle("cf21bl")
TRUTH = {"mass": 0.029, "Ixx": 1.9e-5, "Iyy": 1.8e-5, "Izz": 3.3e-5, "motor_time_constant": 0.055}
NAMES = ("Ixx", "Iyy", "Izz")


estimate = partial(test_guard.estimate, truth=TRUTH, drag_x=0.05, drag_y=0.05)


def bound_to(controller, vehicle=CF2):
    target = for_vehicle(controller, vehicle)
    assert not isinstance(target, str)
    return target


def guard_of(controller, vehicle=CF2, **originals):
    told = {"ctrlMel.mass": vehicle.mass, "ctrlMel.massThrust": 132000.0, "ctrlINDI.g2": 4e-5}
    told |= {f"ctrlINDI.g1_{a}": t / j for a, t, j in zip("pqr", effectiveness_torque(vehicle), vehicle.inertia)}
    told |= {f"ctrlINDI.act_dyn_{a}": 0.03149 for a in "pqr"} | {f"kalman.dragB_{a}": 0.0 for a in "xy"}
    told |= dict.fromkeys(LEE.parameters, 0.001) | {"ctrlLee.mass": vehicle.mass} | originals
    told |= {f"ctrlLee.J_{a}": j for a, j in zip("xyz", vehicle.inertia)}
    return Guard(controller, nominal=nominal_estimates(vehicle, controller), originals=told)


def decided(guard, seconds=8.0, make=estimate, judged=True):
    return test_guard.run(guard, seconds, make=make, judged=judged)


@pytest.mark.parametrize("scale", [0.5, 1.5])
def test_effectiveness_arrives_in_a_second_and_a_half(scale) -> None:
    torque = effectiveness_torque(CF2)
    wrong = {f"ctrlINDI.g1_{a}": scale * t / TRUTH[n] for a, t, n in zip("pqr", torque, NAMES)}
    decisions = decided(guard_of(bound_to(INDI), **wrong), 1.5, judged=False)
    held = {name: value for d in decisions for name, value in d.writes}
    for a, t, n in zip("pqr", torque, NAMES):
        assert held[f"ctrlINDI.g1_{a}"] == pytest.approx(t / TRUTH[n], rel=0.01)
        assert held[f"ctrlINDI.act_dyn_{a}"] == pytest.approx(lag_share(0.055), rel=1e-6)
    assert decisions[0].time < Limits().agreement_time  # a belief that is refuted waits less


@pytest.mark.parametrize("scale", [0.5, 0.9])
def test_an_axis_waits_for_no_other_and_the_lag_for_roll_and_pitch(scale: float) -> None:
    wrong = {f"ctrlINDI.g1_{a}": scale * t / TRUTH[n] for a, t, n in zip("pqr", effectiveness_torque(CF2), NAMES)}

    def late(t: float) -> Estimate:
        return Estimate(t, {**estimate(t).parameters, "Iyy": estimate(t, relative_sd=0.003 if t > 2.0 else 0.2)["Iyy"]})

    first, *others = decided(guard_of(bound_to(INDI), **wrong), 4.0, make=late)
    assert {n for n, _ in first.writes} == {"ctrlINDI.g1_p", "ctrlINDI.g1_r"}
    assert others[0].time > 2.0
    rest = {n for n, _ in others[0].writes}
    assert {f"ctrlINDI.{n}" for n in ("g1_q", "act_dyn_p", "act_dyn_q", "act_dyn_r")} <= rest
    alone = guard_of(bound_to(INDI), **wrong)
    alone.limits = replace(alone.limits, parameters=("Ixx",))  # a policy that writes nothing else
    assert {n for d in decided(alone, 4.0, make=late) for n, _ in d.writes} == {"ctrlINDI.g1_p"}


def test_pitch_is_corrected_while_roll_waits_at_its_cap_for_a_verdict() -> None:
    """The belief about roll is half of the truth: the cap without a verdict is 1.5 times the belief."""
    torque = dict(zip(NAMES, effectiveness_torque(CF2)))
    believed = {"Ixx": 0.5 * TRUTH["Ixx"], "Iyy": 0.9 * TRUTH["Iyy"]}
    g1 = {"ctrlINDI.g1_p": torque["Ixx"] / believed["Ixx"], "ctrlINDI.g1_q": torque["Iyy"] / believed["Iyy"]}

    def moves(t: float) -> Estimate:
        return estimate(t, Iyy=TRUTH["Iyy"] * (1.0 if t > 1.5 else 0.97))

    decisions = decided(guard_of(bound_to(INDI), **g1), 4.0, make=moves, judged=False)
    held = {name: value for d in decisions for name, value in d.writes}
    assert held["ctrlINDI.g1_p"] == pytest.approx(torque["Ixx"] / (1.5 * believed["Ixx"]), rel=1e-6)
    assert held["ctrlINDI.g1_q"] == pytest.approx(torque["Iyy"] / TRUTH["Iyy"], rel=0.01)


@pytest.mark.parametrize(("converged", "written"), [(7 / 8, True), (1 / 3, False)])
def test_an_estimate_that_has_not_converged_neither_agrees_nor_disagrees(converged: float, written: bool) -> None:
    """Written if more than half of the estimates have converged."""
    counts = iter(range(1000))

    def made(t: float) -> Estimate:
        found = estimate(t)
        n = next(counts)
        if math.floor(converged * (n + 1)) > math.floor(converged * n):
            return found
        late = {n: replace(p, identifiable=False, reason=NOT_CONVERGED) for n, p in found.parameters.items()}
        return Estimate(t, late)

    assert bool(decided(guard_of(bound_to(INDI)), 3.0, make=made)) == written


def test_a_wrong_inertia_moves_g1_no_further_than_its_bounds() -> None:
    """An estimate that says four times the inertia, however sure, is refused; 1.9 times is written."""
    g = guard_of(bound_to(INDI))
    assert {n for d in decided(g, make=lambda t: estimate(t, Ixx=6.6e-5)) for n, _ in d.writes}.isdisjoint(
        {"ctrlINDI.g1_p"}
    )
    before = guard_of(bound_to(INDI)).originals["ctrlINDI.g1_p"]
    g = guard_of(bound_to(INDI))
    first = decided(g, 4.0, make=lambda t: estimate(t, Ixx=1.9 * CF2.inertia[0]), judged=False)
    lowest = min(v for d in first for n, v in d.writes if n == "ctrlINDI.g1_p")
    assert lowest == pytest.approx(before / 1.5, rel=1e-6)  # and no further before a verdict


def test_mellinger_gets_the_thrust_scale_of_the_vehicle_and_keeps_its_mass() -> None:
    target = bound_to(MELLINGER, BRUSHLESS)
    decisions = decided(guard_of(target, BRUSHLESS), make=lambda t: estimate(t, mass=BRUSHLESS.mass))
    held = {name: value for d in decisions for name, value in d.writes}
    assert held == {"ctrlMel.massThrust": pytest.approx(65535 / 0.8, rel=1e-6)}
    steps = [132000.0, *(v for d in decisions for _, v in d.writes)]
    assert all(b >= 0.85 * a - 1e-6 for a, b in pairwise(steps))


def test_mass_thrust_waits_for_a_mass_that_is_seen() -> None:
    def blind(t, sd=0.01):
        e = estimate(t, mass=BRUSHLESS.mass)
        mass = replace(e["mass"], sd=sd, identifiable=False, reason="not converged yet")
        return Estimate(t, {**e.parameters, "mass": mass})

    assert decided(guard_of(bound_to(MELLINGER, BRUSHLESS), BRUSHLESS), make=blind) == []
    narrow = decided(guard_of(bound_to(MELLINGER, BRUSHLESS), BRUSHLESS), make=lambda t: blind(t, sd=1e-4))
    assert {n for d in narrow for n, _ in d.writes} == {"ctrlMel.massThrust"}


def test_drag_comes_from_nothing_in_steps_and_only_where_it_is_seen() -> None:
    g = guard_of(with_drag(LEE))
    values = [v for d in decided(g, make=lambda t: estimate(t, drag_x=0.41, drag_y=0.03, mass=0.029))
              for n, v in d.writes if n == "kalman.dragB_x"]  # fmt: skip
    assert values == pytest.approx([0.25, 0.41])
    unseen = replace(estimate(0.0)["drag_x"], identifiable=False, reason="speeds are too small")
    g = guard_of(with_drag(LEE))
    hidden = decided(g, make=lambda t: Estimate(t, {**estimate(t).parameters, "drag_x": unseen, "drag_y": unseen}))
    assert not any("drag" in n for d in hidden for n, _ in d.writes)


def test_an_estimate_without_drag_writes_none() -> None:
    g = guard_of(with_drag(LEE))
    plain = {n: p for n, p in estimate(0.0).parameters.items() if "drag" not in n}
    assert not any("drag" in n for d in decided(g, make=lambda t: Estimate(t, plain)) for n, _ in d.writes)
    assert "drag_x: not estimated" in str(g.consider(Estimate(9.0, plain), 9.0, airborne=True))


# The order


def decay(g1: float, share: float, lag: float) -> float:
    """1/s by which INDI's roll loop decays (negative: grows); g1: believed over true, share: act_dyn.

    Angle and rate loops of 5 and 24 1/s, 8 Hz filters, rotors with `lag` [s], gyro filter of 80 Hz, 500 Hz.
    """
    filters = [tf2ss(*butter(2, cutoff, fs=1 / LOOP)) for cutoff in (8.0, 8.0, 80.0)]
    (A, B, C, D), (_, _, _, _), (E, F, G, H) = filters
    follow = lag_share(lag)

    def step(x):
        rate_f, before, sent_f, act, motor, rate, angle, gyro = x[:2], x[2], x[3:5], x[5], x[6], x[7], x[8], x[9:11]
        seen = (G @ gyro)[0] + H[0, 0] * rate
        filtered = (C @ rate_f)[0] + D[0, 0] * seen
        u = (C @ sent_f)[0] + D[0, 0] * act
        u += (24.0 * (-5.0 * angle - seen) - (filtered - before) / LOOP) / g1
        moved = motor + follow * (u - motor)
        turned = rate + LOOP * (motor + moved) / 2
        return np.array([
            *(A @ rate_f + B[:, 0] * seen), filtered, *(A @ sent_f + B[:, 0] * act), act + share * (u - act), moved,
            turned, angle + LOOP * (rate + turned) / 2, *(E @ gyro + F[:, 0] * rate),
        ])  # fmt: skip

    matrix = np.array([step(e) for e in np.eye(11)]).T
    return -math.log(max(abs(np.linalg.eigvals(matrix)))) / LOOP


def test_the_loop_is_stable_within_the_caps_and_not_far_beyond() -> None:
    """What the policy's [effectiveness] rests on: g1 of 2/3 to 2 times the truth."""
    for lag in (0.035, 0.05, 0.065):
        assert min(decay(g1, lag_share(lag), lag) for g1 in np.linspace(1 / 1.5, 2.0, 8)) > 0.4
        assert decay(0.25, lag_share(lag), lag) < 0 < decay(0.45, lag_share(lag), lag)


ratios, lags = st.floats(0.5, 2.0), st.floats(0.03, 0.1)


@given(ratios, ratios, lags, lags)
def test_no_state_on_the_way_is_much_less_damped_than_both_ends(g1_from, g1_to, lag_from, lag_to) -> None:
    """Roll axis: believed g1 and lag to others, in the order of `writes_for`, with rotors of the final lag.

    By a quarter at most: a model that is three times too slow, and g1 that falls to half the truth.
    """
    target, true = bound_to(INDI), effectiveness_torque(CF2)[0] / 1.7e-5
    beliefs = {b.name: 1.7e-5 / g1_from for b in target.beliefs} | {"motor_time_constant": lag_from}
    changed = {"Ixx": 1.7e-5 / g1_to, "motor_time_constant": lag_to}
    state = {"ctrlINDI.g1_p": g1_from * true, "ctrlINDI.act_dyn_p": lag_share(lag_from)}
    states = [dict(state)]
    for name, value in writes_for(target, changed, beliefs=beliefs, originals={}):
        if name in state:
            state[name] = value
            states.append(dict(state))
    damped = [decay(s["ctrlINDI.g1_p"] / true, s["ctrlINDI.act_dyn_p"], lag_to) for s in states]
    end = min(damped[0], damped[-1])
    assert min(damped) >= end - 0.26 * abs(end) - 0.05


@pytest.mark.parametrize("grows", [True, False])
def test_g2_never_lags_more_than_at_both_ends(grows) -> None:
    """g2/g1_r is the lag that g2 puts into yaw: rising, g1_r goes first; falling, g2 does."""
    heavy = replace(CF2, effects={"rotor_inertia": {"inertia": 1e-8}})
    target = bound_to(INDI, heavy)
    beliefs = {b.name: TRUTH.get(b.name, 0.05) for b in target.beliefs}
    new = TRUTH["Izz"] * (0.8 if grows else 1.25)
    names = [n for n, _ in writes_for(target, {"Izz": new}, beliefs=beliefs, originals={})]
    assert names == (["ctrlINDI.g1_r", "ctrlINDI.g2"] if grows else ["ctrlINDI.g2", "ctrlINDI.g1_r"])
    held = dict(writes_for(target, {"Izz": new}, beliefs=beliefs, originals={}))
    assert held["ctrlINDI.g2"] == pytest.approx(rotor_reaction_factor(heavy, 1e-8) / new)


@given(st.floats(0.6, 1.6), st.floats(0.6, 1.6))
def test_mellingers_thrust_on_the_way_is_no_further_off_than_either_way_allows(mass, scale) -> None:
    """Of the two orders the one whose halfway thrust, mass times massThrust, is nearer to the last."""
    target = bound_to(MELLINGER)
    beliefs = {"mass": 0.03, "mass_thrust": 1.3e5}
    changed = {"mass": 0.03 * mass, "mass_thrust": 1.3e5 * scale}
    first, _ = writes_for(target, changed, beliefs=beliefs, originals={})
    left = abs(math.log(scale if first[0] == "ctrlMel.mass" else mass))
    assert left <= min(abs(math.log(scale)), abs(math.log(mass))) + 1e-9


def test_the_way_back_is_ordered_as_well_and_writes_what_differs() -> None:
    target = bound_to(INDI)
    now = dict.fromkeys(target.parameters, 1.0) | {"ctrlINDI.act_dyn_p": 0.02}
    back = {"ctrlINDI.g1_p": 2.0, "ctrlINDI.g1_q": 0.5, "ctrlINDI.g1_r": 1.0, "ctrlINDI.act_dyn_p": 0.03}
    assert [n for n, _ in writes_back(target, back, now=now)] == [
        "ctrlINDI.g1_p",
        "ctrlINDI.g1_q",
        "ctrlINDI.act_dyn_p",
    ]


# Where they can go


class Drone:
    """A link as far as `push_target` asks."""

    def __init__(self, number, *parameters):
        self.number = number
        self.parameters = dict.fromkeys(("stabilizer.controller", *parameters), "float")

    def read_parameter(self, name, timeout=2.0):
        return float(self.number)


def test_the_target_is_that_of_the_controller_that_runs() -> None:
    drag = ("kalman.dragB_x", "kalman.dragB_y")
    indi = bound_to(INDI)
    target, _ = push_target(Drone(3, *indi.parameters, *drag), CF2)
    assert target is not None
    assert [b.name for b in target.beliefs] == [*NAMES, "motor_time_constant", "drag_x", "drag_y"]
    target, _ = push_target(Drone(2, "ctrlMel.mass", "ctrlMel.massThrust"), CF2)
    assert target is not None
    assert [b.name for b in target.beliefs] == ["mass", "mass_thrust"]  # a firmware without drag
    target, why = push_target(Drone(1, *drag), CF2)
    assert target is None
    assert "PID" in why
    assert "INDI control effectiveness" in why


def test_a_vehicle_that_does_not_say_enough_is_told_so() -> None:
    loose = replace(CF2, battery_compensated=False)
    target, why = push_target(Drone(3, *bound_to(INDI).parameters), loose)
    assert target is None
    assert "not compensated" in why
    target, why = push_target(Drone(3, *bound_to(INDI).parameters), replace(CF2, thrust_max=math.inf))
    assert target is None
    assert "no thrust_max" in why
    target, why = push_target(Drone(2, "ctrlMel.mass"), replace(CF2, thrust_max=math.inf))
    assert target is not None
    assert "massThrust is left alone" in why


@given(st.floats(1e-3, 1e3), st.sampled_from(["proportional", "reciprocal", "lag"]), st.floats(0.1, 10.0))
def test_a_slot_reads_what_it_writes(value, form, scale) -> None:
    slot = Slot("x", form, scale)
    value = 0.01 + 1e-4 * value if form == "lag" else value
    assert slot.estimate(slot.value(value)) == pytest.approx(value, rel=1e-6)
