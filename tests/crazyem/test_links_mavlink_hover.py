"""Hover thrust under the guard: old value times mass ratio, bounds of both kinds, cells, dry runs; rules of watch."""

import argparse
import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_files import fails

from crazyem.commands import watch
from crazyem.errors import LinkError, UsageError
from crazyem.estimation.result import Estimate, ParameterEstimate
from crazyem.live.controllers import writes_back
from crazyem.live.guard import Guard
from crazyem.live.policy import WriteRules, load_policy
from crazyem.live.push import (
    HIGHEST_HOVER_THRUST,
    LOWEST_HOVER_THRUST,
    hover_afterwards,
    hover_rules,
    hover_target,
)
from crazyem.vehicle import load_vehicle

CF2 = load_vehicle("cf2")


class Drone:
    """What hover_target asks of a link."""

    uri = "mavlink:udpin:127.0.0.1:1"

    def __init__(self, hover=0.5, *, name="MPC_THR_HOVER", own="", cells=1, silent=False):
        self.hover_parameter, self.onboard_hover_estimator, self.cells = name, own, cells
        self._hover, self._silent = hover, silent

    def read_parameter(self, name):
        assert name == self.hover_parameter
        if self._silent:
            raise LinkError("the drone said nothing.")
        return self._hover


def estimate(mass, half=0.0001):
    known = ParameterEstimate(mass, half / 2, (mass - half, mass + half), "kg", True, "")
    others = {n: ParameterEstimate(1e-5, 1e-6, (0.0, 2e-5), "kg m^2", False, "unknown") for n in ("Ixx", "Iyy", "Izz")}
    return Estimate(0.0, {"mass": known, **others}, samples=800, updates=10, converged=True)


def guard_of(drone, vehicle=CF2):
    controller, _ = hover_target(drone, vehicle)
    rules = hover_rules(WriteRules(load_policy()), drone, controller)
    originals = {controller.mass: drone.read_parameter(controller.mass)}
    nominal = {"mass": vehicle.mass, "Ixx": 1e-5, "Iyy": 1e-5, "Izz": 1e-5}
    return Guard(controller, nominal=nominal, originals=originals, limits=rules.policy.limits)


def decide(guard, mass, until=2.0):
    decision = None
    for k in range(round(until / 0.1)):
        decision = guard.consider(estimate(mass), 0.1 * k, airborne=True)
        if decision.writes:
            return decision
    return decision


@given(ratio=st.floats(0.88, 1.12), hover=st.floats(0.2, 0.7))
def test_hover_thrust_is_the_old_one_times_the_ratio_of_masses(ratio, hover):
    guard = guard_of(Drone(hover))
    decision = decide(guard, ratio * CF2.mass)
    if abs(ratio - 1.0) < 0.0021:
        return
    assert [n for n, _ in decision.writes] == ["MPC_THR_HOVER"]
    assert decision.writes[0][1] == pytest.approx(hover * ratio, rel=1e-9)


def test_beyond_the_bounds_of_hover_thrust_nothing_is_written():
    high = decide(guard_of(Drone(0.75)), 1.1 * CF2.mass)
    assert not high.writes
    assert "outside" in high.why
    low = decide(guard_of(Drone(0.11)), 0.8 * CF2.mass)
    assert not low.writes


@given(hover=st.floats(0.0, 2.0), mass=st.floats(0.001, 0.2))
def test_whatever_is_believed_what_is_written_is_a_hover_thrust(hover, mass):
    drone = Drone(hover)
    if hover_target(drone, CF2)[0] is None:
        assert not LOWEST_HOVER_THRUST <= hover <= HIGHEST_HOVER_THRUST
        return
    guard = guard_of(drone)
    for _, value in decide(guard, mass).writes:
        assert LOWEST_HOVER_THRUST * (1 - 1e-9) <= value <= HIGHEST_HOVER_THRUST * (1 + 1e-9)
        assert abs(value / hover - 1.0) <= 0.15 + 1e-9


def test_a_revert_leads_back_to_the_old_hover_thrust():
    guard = guard_of(Drone(0.5))
    back = writes_back(guard.controller, {"MPC_THR_HOVER": 0.5}, now={"MPC_THR_HOVER": 0.55})
    assert back == (("MPC_THR_HOVER", 0.5),)


def test_heavy_drones_need_a_policy_of_their_own():
    """The shipped policy ends at 250 g; a guard must not widen that by itself."""
    heavy = dataclasses.replace(CF2, mass=1.5)
    decision = decide(guard_of(Drone(0.4), heavy), 1.6)
    assert not decision.writes


def test_what_cannot_be_pushed_is_told():
    for drone, words in (
        (Drone(name=""), "no hover thrust parameter"),
        (Drone(0.95), "outside 0.1 to 0.8"),
        (Drone(math.nan), "outside"),
        (Drone(silent=True), "said nothing"),
    ):
        controller, note = hover_target(drone, CF2)
        assert controller is None
        assert words in note
    _, note = hover_target(Drone(own="PX4 flies with its own estimate"), CF2)
    assert "may have no effect" in note


def test_the_same_correction_is_not_made_twice_without_a_word():
    controller, _ = hover_target(Drone(0.5), CF2)
    same = hover_afterwards(controller, now={"MPC_THR_HOVER": 0.5}, before={"MPC_THR_HOVER": 0.5})
    assert same == ""
    told = hover_afterwards(controller, now={"MPC_THR_HOVER": 0.6}, before={"MPC_THR_HOVER": 0.5})
    assert "0.6 now, right at 0.0348 kg" in told
    assert "not known" in hover_afterwards(controller, now={"MPC_THR_HOVER": math.nan}, before={"MPC_THR_HOVER": 0.5})


def test_the_battery_threshold_holds_for_every_cell():
    rules = WriteRules(load_policy())
    one = hover_rules(rules, Drone(cells=1), None).policy.health.battery
    assert hover_rules(rules, Drone(cells=4), None).policy.health.battery == pytest.approx(4 * one)
    assert hover_rules(rules, Drone(cells=0), None).policy.health.battery == one


# --- commands ---


def words(uri, **given):
    flags = dict.fromkeys(("push", "confirm", "dry_run", "no_push"), False)
    return argparse.Namespace(uri=uri, policy=None, **{**flags, **given})


def test_watch_runs_dry_unless_told_to_write():
    uri = "mavlink:udpin:127.0.0.1:14550"  # an address is no proof of a simulator
    assert watch.write_rules(words(uri)).mode == "dry run"
    assert watch.write_rules(words(uri, dry_run=True)).mode == "dry run"
    assert watch.write_rules(words(uri, push=True)).mode == "push"
    assert watch.write_rules(words(uri, confirm=True)).mode == "push after confirmation"
    assert watch.write_rules(words(uri, no_push=True)) is None
    assert watch.write_rules(words("udp://127.0.0.1:19850")) is None
    with pytest.raises(UsageError, match="MAVLink drones only"):
        watch.write_rules(words("udp://127.0.0.1:19850", push=True))


def test_a_wrong_policy_is_a_sentence(tmp_path, capsys):
    bad = tmp_path / "policy.toml"
    bad.write_text("nonsense = 1")
    assert "policy.toml" in fails(capsys, "watch", "mavlink:udpin:127.0.0.1:14550", "--policy", bad, code=3)
