"""What is never exactly known: priors that depend on the flight and on the model, and what intervals have added."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from closed_loop import DRONE, fly

from crazyem.diagnosis.fitting import nuisances as always
from crazyem.diagnosis.fitting.candidates import TRIM, Candidate, candidates_for
from crazyem.diagnosis.fitting.fit import Data, DivergedError
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import (
    COARSE_REASON,
    _reset_conditional,
    is_nonphysical,
    nuisances,
    refine_base,
    refine_with_memory,
    systematic_sd,
    without_unobservable,
)
from crazyem.diagnosis.flights.flight import _blocks, flight_of
from crazyem.diagnosis.naming.detection_limits import exceeds_limit
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.prior import AT_ONCE_SD, Conditions
from crazyem.physics.effects.timing import LAG_SD

POINT = Point(DRONE, {}, start_noise())


class Made(SimpleNamespace):
    """Stands for a flight."""

    __hash__ = object.__hash__


def flown(*, speed: float, measured: bool = False) -> SimpleNamespace:
    """Flights that swing at these rms speeds [m/s] along x, y, z: 1, 2 and 4 times `speed`."""
    y = np.zeros((400, 13))
    y[:, 3:6] = np.sqrt(2) * speed * np.array([1, 2, 4]) * np.sin(np.arange(400) * np.pi / 20)[:, None]
    time = 0.01 * np.arange(400)
    inputs = SimpleNamespace(measured=measured, time=time, thrust=np.full((400, 4), 0.07))
    signals = frozenset({"position", "velocity", "attitude", "body_rate"})
    flight = Made(
        name="flight", y=y, time=time, inputs=inputs, signals=signals, coarse=False, levelled=False, fused=False,
        differs=False,
    )  # fmt: skip
    return SimpleNamespace(flights=[flight], signals=signals, constrained=frozenset())


def sd_of(data: SimpleNamespace, point: Point, effect: str) -> np.ndarray:
    found = [p for c, p in nuisances(data, point, ()) if c.effect == effect]  # type: ignore[arg-type]
    return np.array(found[0]) ** -0.5 if found else np.zeros(0)


def test_velocities_are_as_wrong_as_an_onboard_estimate_jitters():
    assert sd_of(flown(speed=0.1), POINT, "velocity_scale")[0] == pytest.approx(2e-3 + 3e-3 / 0.1)
    still = sd_of(flown(speed=0.0), POINT, "velocity_scale")
    assert np.all(np.isfinite(still))
    assert np.all(still > 0.2)


def test_a_biased_gyro_tilts_the_attitude_that_a_filter_makes_of_it():
    assert sd_of(flown(speed=0.1), POINT, "attitude_misalignment").size == 0
    biased = POINT.with_effects({"gyro_bias": {"x": 0.03, "y": -0.04, "z": 0.0}})
    assert sd_of(flown(speed=0.1), biased, "attitude_misalignment") == pytest.approx(np.full(3, 0.05 * 0.05))
    unbiased = POINT.with_effects({"gyro_bias": dict.fromkeys("xyz", 0.0)})
    assert sd_of(flown(speed=0.1), unbiased, "attitude_misalignment").size == 0


def test_speeds_logged_too_seldom_look_like_a_damping_and_commands_have_their_own_way():
    """Without speeds, what commands miss is a torque with memory."""
    assert sd_of(flown(speed=0.1, measured=True), POINT, "rate_damping") == pytest.approx(np.full(3, 6e-6))
    assert sd_of(flown(speed=0.1), POINT, "rate_damping").size == 0


def test_beside_heavy_rotors_the_yaw_inertia_is_hardly_known():
    heavy = POINT.with_effects({"rotor_inertia": {"inertia": 2e-8}})
    light, free = (sd_of(flown(speed=0.1), p, "inertia") / DRONE.inertia for p in (POINT, heavy))
    assert light == pytest.approx([0.01, 0.01, 0.02])
    assert free == pytest.approx([0.01, 0.01, AT_ONCE_SD])
    assert sd_of(flown(speed=0.1, measured=True), heavy, "inertia")[2] == pytest.approx(0.02 * DRONE.inertia[2])


def test_beside_heavy_rotors_a_damping_of_yaw_is_free_as_well_and_goes_with_them():
    """What sampled commands leave of their torque is a damping about z, of drones that have none."""
    heavy = POINT.with_effects({"rotor_inertia": {"inertia": 2e-8}})
    wanted = [6e-6, 6e-6, 1e-4]
    assert sd_of(flown(speed=0.1), heavy, "rate_damping") == pytest.approx(wanted)
    assert sd_of(flown(speed=0.1, measured=True), heavy, "rate_damping") == pytest.approx(np.full(3, 6e-6))
    left = POINT.with_effects({"rate_damping": {"x": 0.0, "y": 0.0, "z": 1e-4}})  # by a rotor inertia that is gone
    assert "rate_damping" not in _reset_conditional(left, (), []).effects
    assert _reset_conditional(left, [Candidate("rate_damping", (), ("x", "y", "z"))], []).effects == left.effects


def test_intervals_hold_what_no_scatter_shows():
    heavy = POINT.with_effects({"rotor_inertia": {"inertia": 2e-8}})
    never = systematic_sd(flown(speed=0.7), heavy)  # type: ignore[arg-type]
    # an attitude 1 ms late, at 3.1 rad/s: force over velocity = mass * rate^2 * delay
    assert never["linear_drag", "y"] == pytest.approx(DRONE.mass * 3.1**2 * 1e-3, rel=0.3)
    dragged = POINT.with_effects({"linear_drag": {"x": 0.03}})  # of rotors whose mean speed differs by 5 %
    fast = systematic_sd(flown(speed=0.7), dragged)  # type: ignore[arg-type]
    assert fast["linear_drag", "x"] == pytest.approx(np.hypot(0.05 * 0.03, never["linear_drag", "x"]))
    assert fast["linear_drag", "y"] == never["linear_drag", "y"]
    assert never["rotor_inertia", "inertia"] == pytest.approx(AT_ONCE_SD * 2e-8)
    assert never["input_delay", "delay"] > 0  # and of what is always free
    assert ("thrust_scale", "scale") not in never


def test_no_drone_is_as_heavy_to_turn_as_if_its_mass_were_far_out():
    """27 g, a tenth of a metre out at most: 1.2e-3 kg m^2 about z was said of real flights, 40 times what it can be."""
    mass, reach = DRONE.mass, 2 * np.hypot(*DRONE.arm)
    inertia = Candidate("inertia", (), ("xx", "yy", "zz"))
    for share, unlike in ((0.9, False), (1.1, True)):
        found = dict(zip(("xx", "yy", "zz"), (2e-5, 2e-5, share * mass * reach**2), strict=True))
        assert is_nonphysical(POINT.with_effects({"inertia": found}), [inertia]) == unlike
        assert not is_nonphysical(POINT.with_effects({"inertia": found}), [])  # free, and no finding


def test_torques_too_weak_for_a_body_are_inertias_too_large_for_one():
    weakest = max(DRONE.inertia) / (DRONE.mass * (2 * np.hypot(*DRONE.arm)) ** 2)
    weak = Candidate("torque_scale", (), ("scale",))
    for scale, unlike in ((1.1 * weakest, False), (0.9 * weakest, True)):
        point = POINT.with_effects({"torque_scale": {"scale": scale}})
        assert is_nonphysical(point, [weak]) == unlike
        assert not is_nonphysical(point, [])


def test_no_drone_turns_as_in_honey():
    """5.6e-4 N m s was said of real flights of a drone of 27 g, whose rates would fall by 1/e within 30 ms."""
    damping = Candidate("rate_damping", (), ("x", "y", "z"))
    for most, unlike in ((5e-5, False), (5.6e-4, True)):
        point = POINT.with_effects({"rate_damping": {"x": 0.0, "y": most, "z": 0.0}})
        assert is_nonphysical(point, [damping]) == unlike
        assert not is_nonphysical(point, [])


def data_of(flights):
    return SimpleNamespace(flights=flights, coarse=Data.coarse.fget(SimpleNamespace(flights=flights)))


def test_of_flights_whose_commands_do_not_turn_the_drone_nothing_fast_is_asked():
    flights = [SimpleNamespace(coarse=c, levelled=False) for c in (True, True)]
    sideways = ("payload", "center_of_mass", "rotor_fault")  # told from a thrust scale by their torque alone
    fast = [n for n, effect in CATALOGUE.items() if effect.needs_torques]
    candidates = [Candidate(n, (), ()) for n in (*fast, *sideways, "linear_drag", "wind", "thrust_scale")]
    kept, reasons = without_unobservable(data_of(flights), POINT, candidates, {})
    slow = ["thrust_curve", "motor_lag", "input_delay"]  # shown by forces
    assert [c.effect for c in kept] == [*slow, "linear_drag", "wind", "thrust_scale"]
    assert reasons == dict.fromkeys((*(n for n in fast if n not in slow), *sideways), COARSE_REASON)
    flights[1].coarse = False
    assert without_unobservable(data_of(flights), POINT, candidates, {})[0] == candidates


def test_a_draft_of_a_room_is_a_finding_only_of_a_drone_whose_trim_does_not_change():
    of_one_drone = replace(DRONE, effects={TRIM: {"x": 0.0, "y": 0.0, "z": 0.0}})
    half = {"wind": {"x": 0.5, "y": 0.0, "z": 0.0}}
    found = [
        exceeds_limit(Point(v, half, start_noise()), Candidate("wind", (), ("x", "y", "z")))
        for v in (DRONE, of_one_drone)
    ]
    assert found == [True, False]


def test_short_flights_have_shorter_blocks_so_that_there_are_forty():
    for seconds, blocks in ((5.0, 10), (10.0, 20), (19.0, 38), (30.0, 40), (60.0, 60)):
        block = _blocks(np.arange(0.0, seconds - 1e-6, 0.01) + 3.0)
        assert block[0] == 0
        assert abs(int(block[-1]) + 1 - blocks) <= 1
        assert set(np.diff(block)) == {0, 1}


@pytest.mark.parametrize("effect", ["wind", "suspended_load"])
def test_without_position_and_velocity_neither_wind_nor_what_swings_can_be_seen(effect):
    asked = (frozenset({"attitude", "body_rate", "specific_force"}), frozenset({"attitude", "body_rate", "velocity"}))
    found = [candidates_for(POINT, signals, measured_speeds=False) for signals in asked]
    assert [any(c.effect == effect for c in kept) for kept, _ in found] == [False, True]
    assert "velocity" in found[0][1][effect]


def test_a_second_look_at_the_memory_of_torques_never_makes_a_fit_worse():
    """Begun with white torques where they sway for half a second, and once more where that is known."""
    data = Data([flight_of(fly(seconds=8.0, sway=3.0, seed=2), DRONE)])
    begun = data.fit_noise(Point(DRONE, {}, start_noise()))
    once, anew = (refine(data.twin(), begun, ()) for refine in (refine_base, refine_with_memory))
    assert not once.point.noise.disturbance.any()
    assert anew.point.noise.disturbance[3:].any()
    assert anew.loglik > once.loglik + 10.0
    again = refine_with_memory(data.twin(), anew.point, ())
    assert again.loglik > anew.loglik - 0.1


def test_what_is_free_no_longer_does_not_stay_where_it_was_left():
    """Beside a lag that was found the torque scale is held at what the file says, for a free one goes along with it;
    held where it stood before, it would make all that is balanced by torques wrong by as much, and nobody be told."""
    data = Data([flight_of(fly(seconds=8.0, seed=3), DRONE)])
    lag = Candidate("motor_lag", (), ("time_constant",))
    neutral = Point(DRONE, {}, start_noise()).with_effects({"motor_lag": lag.neutral(POINT)})
    data.settle(neutral)
    begun = data.fit_noise(neutral)
    left = begun.with_effects({"torque_scale": {"scale": 0.925}})
    fits = [refine_base(data.twin(), point, [lag], noise=False) for point in (begun, left)]
    assert fits[1].point.effects == fits[0].point.effects
    assert fits[1].loglik == pytest.approx(fits[0].loglik, abs=1e-6)
    free = refine_base(data.twin(), left, (), noise=False).point.effects  # without a lag that was found it is free
    assert free["torque_scale"]["scale"] not in (1.0, 0.925)
    filed = replace(DRONE, effects={"torque_scale": {"scale": 1.1}})
    assert refine_base(data.twin(), replace(left, vehicle=filed), [lag], rounds=1).point.effects["torque_scale"] == {
        "scale": 1.1
    }


def test_a_second_look_that_diverges_takes_nothing_away(monkeypatch):
    looks = [SimpleNamespace(point=POINT, loglik=3.0), DivergedError("no number")]

    def refined(*_: object, **__: object) -> SimpleNamespace:
        look = looks.pop(0)
        if isinstance(look, DivergedError):
            raise look
        return look

    settled = []
    monkeypatch.setattr(always, "refine_base", refined)
    monkeypatch.setattr(always, "with_torque_memory_refit", lambda data, point: point)
    found = refine_with_memory(SimpleNamespace(settle=settled.append), POINT, ())
    assert found.loglik == 3.0
    assert settled == [POINT]
    assert looks == []


@pytest.mark.parametrize("share", [0.0, 0.1, 0.4])
def test_the_lag_is_as_uncertain_as_commands_between_the_logged_ones_make_the_torque(share):
    """Oracle: the lag as a filter, at the frequency of one over the lag, by a difference."""
    lag = 0.05
    sd = CATALOGUE["motor_lag"].prior.usual_in(Conditions(lag=lag, unlogged_share=share))["time_constant"]
    assert sd >= LAG_SD
    step = 1e-4 * lag
    torque = [1.0 / np.hypot(1.0, (lag + s * step) / lag) for s in (-1, 1)]
    by_lag = (torque[0] - torque[1]) / (np.mean(torque) * 2 * step)
    assert by_lag * np.sqrt(sd**2 - LAG_SD**2) == pytest.approx(share, rel=1e-5)


def test_a_file_of_one_drone_has_no_other_prior_of_the_lag():
    conditions = Conditions(signals=frozenset({"body_rate"}), unlogged_share=0.2)
    prior = CATALOGUE["motor_lag"].prior
    assert prior.usual_in(conditions) == prior.usual_in(replace(conditions, file_effects=frozenset({"trim"})))
