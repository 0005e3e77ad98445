"""The detector on a synthetic flight: faults that come from the log itself, so that nothing simulates them for it.

A rotor that lost a tenth of its thrust is one whose command says 1/0.9 of what acts; the flight itself goes on.
"""

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import synthetic

from crazyem.estimation.online import OnlineEstimator
from crazyem.estimation.verdict import ROTATION_UNEXPLAINED
from crazyem.live.flight_monitor import FlightMonitor
from crazyem.live.policy import FaultRules
from crazyem.monitoring import detector
from crazyem.monitoring.columns import Columns, RowMaker, mixing
from crazyem.monitoring.detector import Detector
from crazyem.monitoring.fault import Fault
from crazyem.monitoring.hypotheses import hypotheses_for
from crazyem.physics.effects.onboard_estimate import LATERAL_SECONDS
from crazyem.physics.rotors import wrench
from crazyem.signals.sample import Sample
from crazyem.vehicle import load_vehicle

ONSET, SECONDS = 14.0, 16.5  # s
VEHICLE = replace(load_vehicle("cf2"), thrust_curve=())  # thrust and torque are logged


@pytest.fixture(scope="module")
def flight() -> list[Sample]:
    return synthetic.samples(synthetic.fly(seed=3, duration=SECONDS))


def monitored(samples: Iterable[Sample]) -> tuple[list[Fault], FlightMonitor]:
    reports: list[Fault] = []
    monitor = FlightMonitor(VEHICLE, FaultRules(), on_fault=reports.append)
    estimator = OnlineEstimator(VEHICLE, window=400)
    assert monitor.watch(estimator)
    for sample in samples:
        monitor.take(sample, airborne=estimator.airborne)
        estimator.feed(sample)
    return reports, monitor


def changed(
    flight: list[Sample], signal: str, change: Callable[[tuple[float, ...]], tuple[float, ...]]
) -> Iterable[Sample]:
    for sample in flight:
        hit = sample.signal == signal and sample.time >= ONSET
        yield replace(sample, value=change(sample.value)) if hit else sample


def command_of_more(rotor: int, loss: float) -> Callable[[tuple[float, ...]], tuple[float, ...]]:
    """The command that asks for what this rotor gives, had it lost a share of its thrust."""
    matrix = mixing(VEHICLE)

    def change(command: tuple[float, ...]) -> tuple[float, ...]:
        thrusts = np.linalg.solve(matrix, np.array(command))
        thrusts[rotor - 1] /= 1.0 - loss
        return tuple((matrix @ thrusts).tolist())

    return change


@pytest.mark.slow
def test_a_flight_without_a_fault_gives_no_report(flight: list[Sample]) -> None:
    reports, monitor = monitored(flight)
    assert reports == []
    assert monitor.stops(SECONDS) == monitor.suspended == ""
    assert monitor.tested == pytest.approx(SECONDS - detector.LEARNING, abs=1.0)


def test_a_rotor_that_loses_a_tenth_is_named_with_its_size(flight: list[Sample]) -> None:
    reports, monitor = monitored(changed(flight, "wrench_command", command_of_more(3, 0.1)))
    first, settled = reports[:2]
    assert (first.effect, first.rotor) == ("rotor_fault", 3)
    assert first.detected - ONSET < 0.5
    assert abs(first.onset - ONSET) < 0.2
    assert first.probability > 0.9
    assert (settled.effect, settled.rotor, settled.settled) == ("rotor_fault", 3, True)
    assert settled.sizes["loss"].value == pytest.approx(0.1, abs=0.03)
    assert monitor.stops(settled.detected).startswith("the model of the flight does not hold")
    assert len(monitor.faults) == len(reports) - 1
    assert settled.to_json()["rotor"] == 3


@pytest.mark.slow
def test_nothing_is_reported_while_the_commands_do_not_explain_the_rotation(flight: list[Sample]) -> None:
    """Torques that are logged 60 times too large: the drone seems to have 60 times its inertia."""
    unlike = [
        replace(s, value=(s.value[0], *(60.0 * v for v in s.value[1:]))) if s.signal == "wrench_command" else s
        for s in flight
        if s.time < 10.0
    ]
    reports, monitor = monitored(unlike)
    assert reports == []
    assert monitor.suspended == ROTATION_UNEXPLAINED
    assert monitor.tested == 0.0
    after_a_fault, estimator = FlightMonitor(VEHICLE, FaultRules()), OnlineEstimator(VEHICLE, window=400)
    after_a_fault.faults = (Fault("impact", None, "the drone was hit", 0.0, 0.1, {}, 1.0, {}, True),)
    after_a_fault.watch(estimator)
    for sample in unlike:
        estimator.feed(sample)
    assert after_a_fault.suspended == ""  # the fault explains the estimates


@pytest.mark.slow
def test_a_sensor_that_is_biased_is_named(flight: list[Sample]) -> None:
    bias = changed(flight, "body_rate", lambda v: (v[0], v[1] + 0.1, v[2]))
    reports, _ = monitored(bias)
    assert reports[0].effect == "gyro_bias"
    assert reports[0].sizes["y"].value == pytest.approx(0.1, abs=0.04)


@pytest.mark.slow
@pytest.mark.parametrize("rows", range(4))
def test_a_sensor_that_jumps_between_two_judgements_is_named(flight: list[Sample], rows: int) -> None:
    jump = ONSET + 0.01 * rows
    moved = (
        replace(s, value=(s.value[0] + 0.1, *s.value[1:])) if s.signal == "position" and s.time >= jump else s
        for s in flight
    )
    reports, _ = monitored(moved)
    assert reports[0].effect == "position_offset"
    assert reports[0].onset == pytest.approx(jump, abs=0.015)


@pytest.mark.slow
@pytest.mark.parametrize("normal", [True, False])
def test_fixes_that_become_later_are_no_fault(
    flight: list[Sample], monkeypatch: pytest.MonkeyPatch, normal: bool
) -> None:
    """A flight at 1.8 m/s (another inertial frame of the same one) whose onboard filter follows fixes 20 ms ahead."""
    known = detector.hypotheses_for
    monkeypatch.setattr(
        detector, "hypotheses_for", lambda v: tuple(replace(h, normal=h.normal and normal) for h in known(v))
    )
    speed, error, time = np.array([1.5, 1.0, 0.0]), np.zeros((2, 3)), ONSET
    late: list[Sample] = []
    for sample in flight:
        while time < sample.time:  # Euler steps of p' = v - 2 (p - ahead) / T and v' = -2 (p - ahead) / T^2
            away = error[0] - 0.02 * speed
            error += 1e-3 * np.stack([error[1] - 2 / 0.15 * away, -2 / 0.15**2 * away])
            time += 1e-3
        added = {"position": speed * sample.time + error[0], "velocity": speed + error[1]}.get(sample.signal)
        value = sample.value if added is None else tuple((np.array(sample.value) + added).tolist())
        late.append(replace(sample, value=value))
    reports, monitor = monitored(late)
    assert [r.effect for r in reports[:1]] == ["pose_delay"] * (not normal)
    assert monitor.stops(SECONDS) == "" or not normal


@pytest.mark.slow
def test_a_change_of_a_size_that_is_normal_is_no_fault_however_certain(
    flight: list[Sample], monkeypatch: pytest.MonkeyPatch
) -> None:
    wander = list(changed(flight, "velocity", lambda v: (v[0] + 0.02, v[1], v[2])))
    assert monitored(wander)[0] == []
    monkeypatch.setattr(detector, "NORMAL_SHARE", 1e-6)  # against a size of zero
    assert monitored(wander)[0][0].effect == "velocity_offset"


@pytest.mark.slow
def test_a_signal_that_sticks_is_named_and_stops_pushing(flight: list[Sample]) -> None:
    kept: list[tuple[float, ...]] = []

    def stick(value: tuple[float, ...]) -> tuple[float, ...]:
        kept.append(value)
        return kept[0]

    reports, monitor = monitored(changed(flight, "velocity", stick))
    assert reports[-1].effect == "stuck velocity"  # explains all that follows
    assert monitor.stops(SECONDS)


@pytest.mark.parametrize(("speed", "stuck"), [(0.0, False), (0.5, True)])
def test_a_quiet_hover_is_no_stuck_position(speed: float, stuck: bool) -> None:
    """A climb in millimetres, then 5 s of the same position; the velocity says that the drone rests, or that not."""
    reports: list[Fault] = []
    monitor = FlightMonitor(VEHICLE, FaultRules(), on_fault=reports.append)
    for k in range(700):
        climbs, time = k < 200, 0.01 * k
        velocity = (0.0, 0.0, 0.3) if climbs else (speed, 0.001 * (k % 2), 0.0)
        for signal, value in (("position", (0.0, 0.0, round(3e-3 * min(k, 200), 3))), ("velocity", velocity)):
            monitor.take(Sample(signal, time, value), airborne=True)
    assert [f.effect for f in reports] == ["stuck position"] * stuck
    assert bool(monitor.stops(7.0)) is stuck


def test_the_columns_of_rotors_are_what_the_rotors_do() -> None:
    vehicle = load_vehicle("cf2")
    random = np.random.default_rng(1)
    thrusts = random.uniform(0.05, 0.1, (20, 4))
    np.testing.assert_allclose(
        thrusts @ mixing(vehicle).T,
        wrench(thrusts, arm=vehicle.arm, torque_per_thrust=vehicle.torque_per_thrust),
        atol=1e-15,
    )


def test_every_column_of_the_body_is_the_derivative_of_the_model(flight: list[Sample]) -> None:
    """By differences: the acceleration with the change, less that without, over the change."""
    vehicle = VEHICLE
    hypotheses = hypotheses_for(vehicle)
    columns = Columns.of(hypotheses)
    maker = RowMaker(columns, vehicle)
    rows: list[Any] = []
    estimator = OnlineEstimator(vehicle, window=100)
    estimator.on_filtered = lambda em, p, first, last, sd: rows.append((em, first, last, p))
    for sample in flight:
        estimator.feed(sample)
        if len(rows) > 30:
            break
    em, first, last, p = rows[-1]
    acting, _ = maker.rows(em.tape, p, first, last)
    mean = em.tape.mean[first:last]
    named = {(h.effect, h.rotor, c.label): acting[:, i] for h, lo in zip(hypotheses, columns.first)
             for i, c in enumerate(h.columns, lo)}  # fmt: skip
    thrusts = np.linalg.solve(mixing(vehicle), mean.T).T
    for rotor in range(1, 5):
        less = thrusts.copy()
        less[:, rotor - 1] *= 0.9
        change = (less - thrusts) @ mixing(vehicle).T / 0.1
        np.testing.assert_allclose(named["rotor_fault", rotor, "loss"][:, 2], change[:, 0] / p.theta[0], rtol=1e-9)
        np.testing.assert_allclose(
            named["rotor_fault", rotor, "loss"][:, 3:], change[:, 1:] @ p.inverse.T, rtol=1e-9, atol=1e-12
        )
    step = 1e-6
    heavier = (mean[:, 0] / (p.theta[0] + step) - mean[:, 0] / p.theta[0]) / step
    np.testing.assert_allclose(named["payload", None, "mass"][:, 2], heavier, rtol=1e-3)
    change, _ = maker.nuisances(em.tape, p, em.setup.unit, first, last)
    for column in range(4):  # mass and inertia, by their logarithms
        theta = p.theta.copy()
        theta[column] *= np.exp(1e-6)
        moved = maker.drifting(em.tape, replace(p, theta=theta), p, first, last)[:, 0] / 1e-6
        np.testing.assert_allclose(change[:, column], moved, rtol=1e-4, atol=1e-4)


def test_an_onboard_filter_that_knows_no_drag_is_a_nuisance() -> None:
    """At constant velocity the error of v along body x and y is T v, that of p is T^2 v / 2, and along z there is none;
    rows one by one give the same as all at once."""
    rows, velocity = 400, np.array([1.0, -0.5, 0.3])
    xf = np.zeros((rows, 13))
    xf[:, 3:6] = velocity
    tape = SimpleNamespace(
        time=0.01 * np.arange(rows), xf=xf, xp=xf, middle=np.tile(np.eye(3), (rows, 1, 1)),
        thrust=np.zeros(rows), torque=np.zeros((rows, 3)), thrust_tau=np.zeros(rows), torque_tau=np.zeros((rows, 3)),
        thrust_delay=np.zeros(rows), torque_delay=np.zeros((rows, 3)),
    )  # fmt: skip
    p = SimpleNamespace(theta=np.ones(9), inertia=np.eye(3), inverse=np.eye(3))

    def error(batches: Sequence[int]) -> Any:
        maker = RowMaker(Columns.of(hypotheses_for(VEHICLE)), VEHICLE)
        found = [
            maker.nuisances(cast(Any, tape), cast(Any, p), np.ones(9), first, last)[1]
            for first, last in itertools.pairwise(batches)
        ]
        return np.concatenate(found)[:, 18]

    whole = error((1, rows))
    assert whole[-1, 3:6] == pytest.approx(LATERAL_SECONDS * velocity * [1.0, 1.0, 0.0])
    assert whole[-1, 0:3] == pytest.approx(0.5 * LATERAL_SECONDS**2 * velocity * [1.0, 1.0, 0.0])
    assert (np.diff(whole[:20, 3]) > 0.0).all()
    np.testing.assert_allclose(error((1, 2, 3, 50, 51, rows)), whole, rtol=1e-12)


@pytest.mark.parametrize("noise", [1.0, 30.0, 1000.0])
def test_weaker_data_leave_the_prior_as_it_is(noise: float) -> None:
    """By maximising over multiples of the most probable sizes."""
    random = np.random.default_rng(6)
    root, score, prior = random.standard_normal((3, 3)), 30.0 * random.standard_normal(3), np.diag([0.5, 2.0, 9.0])
    information = root @ root.T
    size = np.linalg.solve(information + prior, score)
    factors = np.linspace(0.0, 1.5, 300_001)
    unusual = size @ prior @ size
    ratio = (2 * factors * (score @ size) - factors**2 * (size @ information @ size)) / noise - factors**2 * unusual
    assert detector.weakened(score @ size, unusual, np.array(noise)) == pytest.approx(ratio.max(), rel=1e-6)


def test_a_reference_is_replaced_by_one_that_is_as_well_known() -> None:
    found = Detector(load_vehicle("cf2"))
    first, second, third = (cast(Any, SimpleNamespace(name=i)) for i in range(3))
    found._since = 0.0
    found._keep_reference(7.0, first, np.full(9, 0.01))  # while it learns: always
    found._keep_reference(10.0, second, np.full(9, 0.05))  # after a supposed step of mass: few rows
    assert found._reference[1] is first
    found._keep_reference(8.5, second, np.full(9, 0.01))  # too early
    assert found._reference[1] is first
    found._keep_reference(10.0, second, np.full(9, 0.01))
    assert found._reference[1] is second
    found._keep_reference(21.0, third, np.full(9, 0.05))  # worse, but the other one is old
    assert found._reference[1] is third


@pytest.mark.parametrize("per_hour", [0.01, 1.0])
def test_thresholds_follow_the_rate_of_false_alarms(per_hour: float) -> None:
    usual = Detector(load_vehicle("cf2"))
    other = Detector(load_vehicle("cf2"), false_alarms_per_hour=per_hour)
    assert ((other.threshold > usual.threshold) == (per_hour < 0.1)).all()


def test_what_wanders_without_a_change_is_no_degree_of_freedom() -> None:
    found = Detector(load_vehicle("cf2"))
    freedom = {h.name: int(d) for h, d in zip(found.hypotheses, found.freedom)}
    assert (freedom["velocity_scale"], freedom["gyro_scale"], freedom["wind"], freedom["rotor_fault 1"]) == (1, 1, 3, 1)
    wander = [not c.changes for h in found.hypotheses if h.name == "velocity_scale" for c in h.columns]
    assert wander == [False, True, True, True]
    assert (found._usual[found.columns.first[0]] > found._prior[found.columns.first[0]]).all()
