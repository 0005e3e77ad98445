"""Whole flights with effects: edges of the ranges break nothing, and the loops feel them."""

import numpy as np
import pytest
from flights import boot
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from firmware_sim.commander import setpoint as sp
from firmware_sim.errors import ScenarioError
from firmware_sim.flight import Flight
from firmware_sim.plant.effects.catalogue import EFFECTS, HIDDEN, STREAMS

QUIET = {"noise": {"thrust": 0.0, "torque": 0.0}, "estimator": {"position_noise": 0.0, "attitude_noise": 0.0}}


def fly(table: dict, seconds: float, controller: int = 5, seed: int = 0) -> tuple[np.ndarray, np.ndarray, Flight]:
    """Take off to 1 m and hold, every 10 ms: rows as truth_row has them, and the whole log."""
    flight = boot(table, seed, stabilizer__controller=controller)
    s = flight.setpoint
    s[sp.MODE_X : sp.MODE_Z + 1] = s[sp.MODE_YAW] = sp.ABSOLUTE
    truth, log = [], []
    for n in range(round(1000 * seconds)):
        s[sp.Z] = min(1.0, n / 1500)
        flight.step()
        if n % 10 == 9:
            truth.append(flight.truth_row())
            log.append([a[i] for a, i in flight.log.values()])
    return np.array(truth), np.array(log), flight


@st.composite
def single_effects(draw: st.DrawFn) -> dict:
    """A scenario with one effect, each parameter at an edge of its range, its default, or anywhere between."""
    section, catalogue = draw(st.sampled_from([("effects", EFFECTS), ("effects", EFFECTS), ("hidden", HIDDEN)]))
    effect = catalogue[draw(st.sampled_from(sorted(catalogue)))]
    values: dict = {}
    for p in effect.parameters:
        edges = [p.low, p.high] + ([] if p.default is None else [p.default])
        values[p.name] = draw(st.sampled_from(edges) | st.floats(p.low, p.high))
        if p.whole:
            values[p.name] = round(values[p.name])
    if effect.streams:
        values["streams"] = draw(st.lists(st.sampled_from(STREAMS), min_size=1, unique=True))
    return {"platform": draw(st.sampled_from(["cf2", "cf21bl"])), section: {effect.name: values}}


@settings(suppress_health_check=[HealthCheck.filter_too_much], phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(table=single_effects(), controller=st.sampled_from([1, 2, 5, 6]), seed=st.integers(0, 1000))
def test_no_effect_at_any_edge_gives_what_is_not_a_number(table: dict, controller: int, seed: int) -> None:
    try:
        truth, log, flight = fly(table, 5.0, controller, seed)
    except ScenarioError:
        return  # refused, for example an inertia that no body has
    assert np.all(np.isfinite(truth))
    assert np.all(np.isfinite(log))
    assert np.all(np.isfinite(flight.state))


def test_many_effects_at_once_are_finite() -> None:
    effects = {
        "payload": {"mass": 0.004, "x": 0.01, "z": -0.01},
        "suspended_load": {"mass": 0.004, "length": 0.3},
        "linear_drag": {"x": 0.01, "y": 0.01, "z": 0.01},
        "gusts": {"standard_deviation": 0.5, "correlation_time": 0.5},
        "rotor_inertia": {"inertia": 1e-8},
        "input_delay": {"delay": 0.004},
        "measurement_delay": {"delay": 0.003, "streams": list(STREAMS)},
        "battery_sag": {"gain_per_second": -0.002},
        "ground_effect": {"strength": 0.2, "height": 0.05},
        "attitude_misalignment": {"roll": 0.02},
        "rotor_fault": {"rotor": 1, "scale": 0.95, "onset_time": 3.0},
    }
    table = {"effects": effects, "vehicle": {"mass": 0.027}, "parameters": {"ctrlLee.mass": 0.035}}
    truth, log, _ = fly(table, 6.0)
    assert np.all(np.isfinite(truth))
    assert np.all(np.isfinite(log))
    assert abs(truth[-1, 3] - 1.0) < 0.3


def test_a_heavy_corner_is_held_up_by_the_rotors_beside_it() -> None:
    table = QUIET | {"effects": {"center_of_mass": {"x": 0.003, "y": -0.002}}}
    row = fly(table, 6.0)[0][-100:].mean(axis=0)
    force, torque = row[14], row[15:18]
    assert torque == pytest.approx([0, 0, 0], abs=2e-6)  # about the centre of mass: balanced
    pwm = row[18:22]
    assert pwm[0] == max(pwm)  # M1, front right
    assert pwm[2] == min(pwm)
    assert force == pytest.approx(0.029 * 9.81, rel=0.01)
