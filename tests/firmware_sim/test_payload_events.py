"""Payloads that come and go in flight: mass, centre of mass and inertia step, momentum does not."""

from pathlib import Path

import numpy as np
import pytest
from flights import write
from scipy.spatial.transform import Rotation

from firmware_sim.commander import setpoint as sp
from firmware_sim.errors import ScenarioError
from firmware_sim.flight import Flight
from firmware_sim.plant import layout as at
from firmware_sim.plant.payload_events import change_body
from firmware_sim.scenario import load_scenario, parse_scenario

SCENARIOS = Path(__file__).parents[2] / "firmware_sim" / "scenarios"
BARE = {"mass": 0.03, "inertia": [2e-5, 1.5e-5, 3e-5, 1e-6, -5e-7, 8e-7]}
POINT = {"action": "attach", "time": 1.0, "mass": 0.006, "position": [0.02, -0.01, -0.03]}


def scenario(*events, **more):
    return parse_scenario({"vehicle": BARE, "payload": {"events": list(events)}, **more}, "s.toml")


def moving():
    """A state in wild motion."""
    x = np.zeros(at.STATE_SIZE)
    x[at.POS : at.POS + 3], x[at.VEL : at.VEL + 3] = (1.0, 2.0, 3.0), (0.4, -0.3, 0.2)
    x[at.QUAT : at.QUAT + 4] = np.roll(Rotation.from_euler("xyz", [0.3, -0.5, 1.1]).as_quat(), 1)
    x[at.OMEGA : at.OMEGA + 3] = (1.5, -2.0, 1.0)
    return x


def turn(x):
    return Rotation.from_quat(np.roll(x[at.QUAT : at.QUAT + 4], -1)).as_matrix()


def origin(truth, x):
    """Position and velocity of the middle of the rotors."""
    R, c, w = turn(x), truth[at.COM : at.COM + 3], x[at.OMEGA : at.OMEGA + 3]
    return x[at.POS : at.POS + 3] - R @ c, x[at.VEL : at.VEL + 3] - R @ np.cross(w, c)


def momenta(truth, x):
    """Linear, and angular about the world's origin."""
    R, J = turn(x), truth[at.INERTIA : at.INERTIA + 9].reshape(3, 3)
    linear = truth[at.MASS] * x[at.VEL : at.VEL + 3]
    return linear, np.cross(x[at.POS : at.POS + 3], linear) + R @ J @ x[at.OMEGA : at.OMEGA + 3]


def changed(flying, x, n):
    """Truth and state after the n-th event."""
    truth, x = flying.truth(n - 1), x.copy()
    change_body(truth, x, flying.truth(n), flying.payload[n - 1])
    return truth, x


def test_what_is_attached_is_the_payload_of_the_effects():
    there = parse_scenario(
        {"vehicle": BARE, "effects": {"payload": {"mass": 0.006, "x": 0.02, "y": -0.01, "z": -0.03}}}, "s.toml"
    ).truth()
    flying = scenario(POINT, {"action": "release", "time": 2.0})
    body = [*range(19), at.STANDING_MASS, at.COM, at.COM + 1, at.COM + 2, 40, 41, 42]
    assert flying.truth(1)[body].tolist() == there[body].tolist()
    assert flying.truth(2)[body].tolist() == flying.truth(0)[body].tolist()
    truth, _ = changed(flying, moving(), 1)
    assert truth.tolist() == flying.truth(1).tolist()


def test_nothing_is_kicked_by_a_payload_that_moves_along_or_leaves():
    flying = scenario(POINT, {"action": "release", "time": 2.0})
    x = moving()
    for n in (1, 2):
        before = origin(flying.truth(n - 1), x)
        truth, y = changed(flying, x, n)
        for a, b in zip(before, origin(truth, y)):
            assert a == pytest.approx(b, abs=1e-12)
        assert y[at.OMEGA : at.OMEGA + 3] == pytest.approx(x[at.OMEGA : at.OMEGA + 3], abs=1e-12)
        x = y


@pytest.mark.parametrize("velocity", [[0.0, 0.0, 0.0], [1.0, -2.0, 0.5]])
def test_momentum_is_conserved_by_a_payload_that_is_caught(velocity):
    flying, x = scenario({**POINT, "velocity": velocity}), moving()
    truth = flying.truth()
    place = origin(truth, x)[0] + turn(x) @ POINT["position"]
    linear, angular = momenta(truth, x)
    push = POINT["mass"] * np.array(velocity)
    truth, y = changed(flying, x, 1)
    after = momenta(truth, y)
    assert after[0] == pytest.approx(linear + push, abs=1e-15)
    assert after[1] == pytest.approx(angular + np.cross(place, push), abs=1e-15)
    assert origin(truth, y)[0] == pytest.approx(origin(flying.truth(), x)[0], abs=1e-12)


def hover(flying, seconds, seed=1):
    """Heights [m] and true masses [kg] at 100 Hz of a flight that takes off to 0.5 m by a position setpoint."""
    drone, rows = Flight(flying, seed), []
    write(drone, "stabilizer.controller", 5.0)
    drone.setpoint[sp.MODE_X : sp.MODE_Z + 1] = sp.ABSOLUTE
    drone.setpoint[sp.X : sp.Z + 1] = (0.0, 0.0, 0.5)
    for k in range(round(1000 * seconds)):
        drone.step()
        if k % 10 == 0:
            rows.append((drone.truth_row()[3], drone._truth[at.MASS], drone.state[at.AIRBORNE]))
    return np.array(rows)


def test_times_count_from_boot_or_from_take_off_and_events_keep_their_order():
    attach = {**POINT, "after": "take-off", "time": 1.5, "mass": 0.004, "position": [0, 0, -0.02]}
    rows = hover(scenario(attach, {"action": "release", "time": 1.0}), 4.0)
    loaded = np.nonzero(rows[:, 1] > 0.031)[0]
    assert loaded.size == 0  # the release was due long before, so it followed at once
    rows = hover(scenario(attach, {"action": "release", "time": 3.0}), 4.0)
    loaded = np.nonzero(rows[:, 1] > 0.031)[0]
    assert rows[loaded[0], 2] == pytest.approx(1500, abs=10)
    assert loaded[-1] + 1 == 300
    assert rows[loaded, 1] == pytest.approx(0.034)
    assert rows[-1, 0] > 0.2


def test_a_load_that_hangs_still_lowers_the_drone_by_its_share():
    """Lee believes the bare mass: the height error is -g (m / believed - 1) / kp, whenever the load came."""
    belief = {"parameters": {"ctrlLee.mass": 0.03}, "vehicle": {**BARE, "motor_time_constant": 0.03}}
    rows = hover(scenario({**POINT, "mass": 0.003, "position": [0, 0, -0.01]}, **belief), 8.0)
    before = hover(scenario({**POINT, "time": 99.0}, **belief), 8.0)
    drop = before[-200:, 0].mean() - rows[-200:, 0].mean()
    assert drop == pytest.approx(9.81 * 0.1 / 7.0, rel=0.1)


@pytest.mark.parametrize("name", ["payload_attach", "payload_drop"])
def test_the_shipped_scenarios(name):
    flying = load_scenario(SCENARIOS / f"{name}.toml")
    masses = flying.truth(0)[at.MASS], flying.truth(1)[at.MASS]
    assert sorted(masses) == pytest.approx([0.029, 0.034])
    assert (masses[1] > masses[0]) == (name == "payload_attach")


@pytest.mark.parametrize(
    ("payload", "named"),
    [
        (3, "payload must be a section"),
        ({"mass": 1}, "events only"),
        ({"events": 3}, "events only"),
        ({"events": [3]}, r"payload.events\[0\].action"),
        ({"events": [{"action": "throw"}]}, r"payload.events\[0\].action"),
        ({"events": [{"action": "attach", "mass": 0.1}]}, r"payload.events\[0\].time is missing"),
        ({"events": [{"action": "attach", "time": 1.0}]}, r"payload.events\[0\].mass is missing"),
        ({"events": [{**POINT, "mass": -1}]}, "mass must lie"),
        ({"events": [{**POINT, "mass": True}]}, "mass must be a number"),
        ({"events": [{**POINT, "time": float("nan")}]}, "time must lie"),
        ({"events": [{**POINT, "position": 1.0}]}, "position must be a list"),
        ({"events": [{**POINT, "velocity": [1, 2]}]}, "velocity must be a list"),
        ({"events": [{**POINT, "after": "landing"}]}, "after must be one of"),
        ({"events": [{**POINT, "weight": 1}]}, "weight is not a key"),
        ({"events": [POINT, {"action": "release", "time": 1.0, "mass": 1}]}, r"events\[1\].mass is not a key"),
        ({"events": [{"action": "release", "time": 1.0}]}, r"events\[0\] releases a payload"),
        ({"events": [POINT] * 33}, "at most 32"),
    ],
)
def test_mistakes_are_named(payload, named):
    with pytest.raises(ScenarioError, match=named):
        parse_scenario({"payload": payload}, "s.toml")
