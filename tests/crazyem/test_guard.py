"""The guard: what reaches a controller and what does not, and the write order; no drone needed."""

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.errors import UsageError
from crazyem.estimation.result import PARAMETER_UNITS, Estimate, ParameterEstimate
from crazyem.live.controllers import LEE, LQG, MELLINGER, controller_named, without_target
from crazyem.live.guard import Guard, Limits

NOMINAL = {"mass": 0.029, "Ixx": 1.66e-5, "Iyy": 1.67e-5, "Izz": 2.93e-5}
TRUTH = {"mass": 0.036, "Ixx": 2.0e-5, "Iyy": 2.1e-5, "Izz": 3.6e-5}
ORIGINALS = {
    "ctrlLee.mass": 0.029, "ctrlLee.J_x": 1.66e-5, "ctrlLee.J_y": 1.67e-5, "ctrlLee.J_z": 2.93e-5,
    "ctrlLee.KR_x": 0.007, "ctrlLee.KR_y": 0.007, "ctrlLee.KR_z": 0.008,
    "ctrlLee.Kw_x": 0.00115, "ctrlLee.Kw_y": 0.00115, "ctrlLee.Kw_z": 0.002,
    "ctrlLqg.mass": 0.029, "ctrlLqg.J_x": 1.66e-5, "ctrlLqg.J_y": 1.67e-5, "ctrlLqg.J_z": 2.93e-5,
    "ctrlMel.mass": 0.029,
}  # fmt: skip


def estimate(time=0.0, *, relative_sd=0.003, identifiable=True, reason="", truth=TRUTH, **values):
    parameters = {}
    for name, unit in {**PARAMETER_UNITS, **dict.fromkeys(values, "")}.items():
        v = values.get(name, truth.get(name, 0.05))
        sd = relative_sd * abs(v)
        parameters[name] = ParameterEstimate(v, sd, (v - 1.96 * sd, v + 1.96 * sd), unit, identifiable, reason)
    return Estimate(time, parameters)


def run(guard, seconds=10.0, *, dt=0.04, airborne=True, enabled=True, make=estimate, judged=False):
    """Decisions to write; `judged`: each was good."""
    out = []
    for i in range(int(seconds / dt)):
        d = guard.consider(make(i * dt), i * dt, airborne=airborne, enabled=enabled)
        if d.writes:
            out.append(d)
            if judged:
                guard.trust()
    return out


def guard(controller=LEE, **kw):
    return Guard(controller, nominal=NOMINAL, originals=ORIGINALS, **kw)


def test_good_estimates_arrive_slew_limited_and_scaled():
    g = guard()
    decisions = run(g)
    assert decisions[0].time >= Limits().agreement_time
    values = [dict(d.writes) for d in decisions]
    masses = [v["ctrlLee.mass"] for v in values if "ctrlLee.mass" in v]
    assert masses[0] == pytest.approx(0.029 * 1.15)
    assert masses[-1] == pytest.approx(0.036)
    last = {k: v for d in values for k, v in d.items()}
    assert last["ctrlLee.J_x"] == pytest.approx(2.0e-5)
    assert last["ctrlLee.KR_x"] == pytest.approx(0.007 * (2.0 + 2.1) / (1.66 + 1.67))
    assert last["ctrlLee.KR_x"] == last["ctrlLee.KR_y"]
    assert last["ctrlLee.Kw_z"] == pytest.approx(0.002 * 3.6 / 2.93)
    gaps = [b.time - a.time for a, b in itertools.pairwise(decisions)]
    assert min(gaps) >= Limits().interval
    assert len(decisions) <= 4  # then the deadband keeps quiet


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda t: estimate(t, identifiable=False, reason="no excitation"), "no excitation"),
        (lambda t: estimate(t, relative_sd=0.2), "uncertain"),
        (lambda t: estimate(t, mass=0.2, Ixx=1e-3, Iyy=1e-3, Izz=1e-3), "outside"),
        (lambda t: estimate(t, mass=math.nan, Ixx=math.nan, Iyy=math.nan, Izz=math.nan), "no valid value"),
        (lambda t: estimate(t, mass=-0.03, Ixx=-1e-5, Iyy=-1e-5, Izz=-1e-5), "no valid value"),
        (lambda t: estimate(t, **{k: v * (1 + 0.3 * math.sin(9 * t)) for k, v in TRUTH.items()}), "still move"),
    ],
)
def test_bad_estimates_write_nothing_and_say_why(make, says):
    g = guard()
    assert run(g, seconds=3, make=make) == []
    reasons = [str(g.consider(make(3 + 0.04 * i), 3 + 0.04 * i, airborne=True)) for i in range(10)]
    assert any(says in r for r in reasons)


def test_nothing_on_the_ground_or_outside_the_phase_or_after_a_stop():
    assert run(guard(), airborne=False) == []
    assert run(guard(), enabled=False) == []
    g = guard()
    g.stop("a write was not confirmed")
    assert run(g) == []
    assert g.consider(estimate(), 99.0, airborne=True).reason == "a write was not confirmed"


def test_contact_forgets_the_history():
    g = guard()
    for i in range(13):
        assert not g.consider(estimate(i * 0.04), i * 0.04, airborne=True, enabled=False).writes
    g.consider(estimate(0.53), 0.53, airborne=False)
    assert "early" in str(g.consider(estimate(0.6), 0.6, airborne=True))


def test_one_axis_waits_for_the_other_only_where_gains_are_shared():
    def lone(t):
        good, bad = estimate(t), estimate(t, relative_sd=0.3)
        return Estimate(t, {**good.parameters, "Iyy": bad["Iyy"]})

    written = {n for d in run(guard(), make=lone) for n, _ in d.writes}
    assert "ctrlLee.J_x" not in written
    assert {"ctrlLee.mass", "ctrlLee.J_z", "ctrlLee.KR_z"} <= written
    written = {n for d in run(guard(LQG), make=lone) for n, _ in d.writes}
    assert written == {"ctrlLqg.mass", "ctrlLqg.J_x", "ctrlLqg.J_z"}


def test_mellinger_takes_only_a_mass():
    assert {n for d in run(guard(MELLINGER)) for n, _ in d.writes} == {"ctrlMel.mass"}


@given(st.lists(st.tuples(st.floats(allow_nan=True, allow_infinity=True), st.floats(0, 1)), min_size=20, max_size=60))
def test_whatever_comes_in_writes_stay_in_bounds_and_within_slew(stream):
    g = guard(limits=Limits(agreement_time=0.1, interval=0.0))
    believed = 0.029
    for i, (value, sd) in enumerate(stream):
        e = estimate(i * 0.04, relative_sd=sd, mass=value)
        for name, v in g.consider(e, i * 0.04, airborne=True).writes:
            assert math.isfinite(v)
            if name == "ctrlLee.mass":
                assert 0.5 * 0.029 <= v <= 2.0 * 0.029
                assert abs(v / believed - 1) <= 0.15 + 1e-9
                believed = v


def test_names():
    assert controller_named("lqg") is LQG
    with pytest.raises(UsageError, match="unknown controller 'pid'"):
        controller_named("pid")
    for number, words in ((1, ("PID", "takes no mass", "only gains")), (4, ("compiled in",)), (9, ("number 9",))):
        assert all(text in without_target(number) for text in words)
