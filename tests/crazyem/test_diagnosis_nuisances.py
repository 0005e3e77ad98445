"""What is never exactly known: priors by the flight, its sampling and the model, and what intervals have added."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from closed_loop import DRONE, fly
from diagnosis_parts import LAG, data_of, start_point
from hypothesis import given
from hypothesis import strategies as st

from crazyem.diagnosis.fitting import nuisances as always
from crazyem.diagnosis.fitting.candidates import Candidate, candidates_for
from crazyem.diagnosis.fitting.fit import Data, DivergedError
from crazyem.diagnosis.fitting.nuisances import (
    COARSE_REASON,
    _reset_conditional,
    nuisances,
    refine_base,
    refine_with_memory,
    systematic_sd,
    without_unobservable,
)
from crazyem.diagnosis.fitting.sampling import unlogged_share
from crazyem.diagnosis.flights.flight import _blocks, thinned
from crazyem.diagnosis.settings import RECORDINGS
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.prior import AT_ONCE_SD, Conditions
from crazyem.physics.effects.timing import LAG_SD

POINT = start_point()


class Made(SimpleNamespace):
    """Stands for a flight."""

    __hash__ = object.__hash__


def made(thrust, period=0.01, *, speed=None, measured=False, levelled=False):
    """A flight as data: commands of (n, 4) thrusts [N] every `period` s; rms speeds [m/s] along x, y, z of 1, 2 and 4
    times `speed`, or no velocities."""
    n = len(thrust)
    y, time = np.zeros((n, 13)), period * np.arange(n)
    y[:, 3:6] = np.sqrt(2) * (speed or 0.0) * np.array([1, 2, 4]) * np.sin(np.arange(n) * np.pi / 20)[:, None]
    inputs = SimpleNamespace(measured=measured, time=time, thrust=thrust)
    signals = frozenset({"position", "attitude", "body_rate"} | ({"velocity"} if speed is not None else set()))
    flight = Made(
        name="flight", y=y, time=time, inputs=inputs, signals=signals, coarse=False, levelled=levelled, fused=False,
        differs=False,
    )  # fmt: skip
    return SimpleNamespace(flights=[flight], signals=signals, constrained=frozenset())


def flown(*, speed, measured=False):
    return made(np.full((400, 4), 0.07), speed=speed, measured=measured)


def sds(data, point=POINT):
    """Standard deviations of the priors of what is always free, by effect."""
    return {c.effect: np.array(precision) ** -0.5 for c, precision in nuisances(data, point, ())}


def test_velocities_are_as_wrong_as_an_onboard_estimate_jitters():
    assert sds(flown(speed=0.1))["velocity_scale"][0] == pytest.approx(2e-3 + 3e-3 / 0.1)
    still = sds(flown(speed=0.0))["velocity_scale"]
    assert np.all(np.isfinite(still))
    assert np.all(still > 0.2)
    assert not {"velocity_scale", "center_of_mass"} & sds(made(np.full((400, 4), 0.07))).keys()  # without velocities


def test_a_biased_gyro_tilts_the_attitude_that_a_filter_makes_of_it():
    unbiased, biased = (
        POINT.with_effects({"gyro_bias": {"x": x, "y": y, "z": 0.0}}) for x, y in ((0.0, 0.0), (0.03, -0.04))
    )
    assert not any("attitude_misalignment" in sds(flown(speed=0.1), point) for point in (POINT, unbiased))
    assert sds(flown(speed=0.1), biased)["attitude_misalignment"] == pytest.approx(np.full(3, 0.05 * 0.05))


def test_speeds_logged_too_seldom_look_like_a_damping_and_commands_have_their_own_way():
    """Without speeds, what commands miss is a torque with memory."""
    assert sds(flown(speed=0.1, measured=True))["rate_damping"] == pytest.approx(np.full(3, 6e-6))
    assert "rate_damping" not in sds(flown(speed=0.1))


HEAVY = POINT.with_effects({"rotor_inertia": {"inertia": 2e-8}})


def test_beside_heavy_rotors_the_yaw_inertia_is_hardly_known():
    light, free = (sds(flown(speed=0.1), p)["inertia"] / DRONE.inertia for p in (POINT, HEAVY))
    assert light == pytest.approx([0.01, 0.01, 0.02])
    assert free == pytest.approx([0.01, 0.01, AT_ONCE_SD])
    assert sds(flown(speed=0.1, measured=True), HEAVY)["inertia"][2] == pytest.approx(0.02 * DRONE.inertia[2])


def test_beside_heavy_rotors_a_damping_of_yaw_is_free_as_well_and_goes_with_them():
    """What sampled commands leave of their torque is a damping about z, of drones that have none."""
    for measured, about_z in ((False, 1e-4), (True, 6e-6)):
        found = sds(flown(speed=0.1, measured=measured), HEAVY)["rate_damping"]
        assert found == pytest.approx([6e-6, 6e-6, about_z])
    left = POINT.with_effects({"rate_damping": {"x": 0.0, "y": 0.0, "z": 1e-4}})  # by a rotor inertia that is gone
    assert "rate_damping" not in _reset_conditional(left, (), []).effects
    assert _reset_conditional(left, [Candidate("rate_damping", (), ("x", "y", "z"))], []).effects == left.effects


def test_intervals_hold_what_no_scatter_shows():
    never = systematic_sd(flown(speed=0.7), HEAVY)
    # an attitude 1 ms late, at 3.1 rad/s: force over velocity = mass * rate^2 * delay
    assert never["linear_drag", "y"] == pytest.approx(DRONE.mass * 3.1**2 * 1e-3, rel=0.3)
    dragged = POINT.with_effects({"linear_drag": {"x": 0.03}})  # of rotors whose mean speed differs by 5 %
    fast = systematic_sd(flown(speed=0.7), dragged)
    assert fast["linear_drag", "x"] == pytest.approx(np.hypot(0.05 * 0.03, never["linear_drag", "x"]))
    assert fast["linear_drag", "y"] == never["linear_drag", "y"]
    assert never["rotor_inertia", "inertia"] == pytest.approx(AT_ONCE_SD * 2e-8)
    assert never["input_delay", "delay"] > 0  # and of what is always free
    assert ("thrust_scale", "scale") not in never


def test_of_flights_whose_commands_do_not_turn_the_drone_nothing_fast_is_asked():
    flights = [SimpleNamespace(coarse=True, levelled=False) for _ in range(2)]
    sideways = ("payload", "center_of_mass", "rotor_fault")  # told from a thrust scale by their torque alone
    fast = [n for n, effect in CATALOGUE.items() if effect.needs_torques]
    candidates = [Candidate(n, (), ()) for n in (*fast, *sideways, "linear_drag", "wind", "thrust_scale")]
    kept, reasons = without_unobservable(Data(flights), POINT, candidates, {})
    slow = ["thrust_curve", "motor_lag", "input_delay"]  # shown by forces
    assert [c.effect for c in kept] == [*slow, "linear_drag", "wind", "thrust_scale"]
    assert reasons == dict.fromkeys((*(n for n in fast if n not in slow), *sideways), COARSE_REASON)
    flights[1].coarse = False
    assert without_unobservable(Data(flights), POINT, candidates, {})[0] == candidates


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
    data = data_of(fly(seconds=8.0, sway=3.0, seed=2))
    begun = data.fit_noise(start_point())
    once, anew = (refine(data.twin(), begun, ()) for refine in (refine_base, refine_with_memory))
    assert not once.point.noise.disturbance.any()
    assert anew.point.noise.disturbance[3:].any()
    assert anew.loglik > once.loglik + 10.0
    again = refine_with_memory(data.twin(), anew.point, ())
    assert again.loglik > anew.loglik - 0.1


def test_what_is_free_no_longer_does_not_stay_where_it_was_left():
    """Beside a lag that was found the torque scale is held at what the file says, for a free one goes along with it;
    held where it stood before, it would make all that is balanced by torques wrong by as much, and nobody be told."""
    data = data_of(fly(seconds=8.0, seed=3))
    lag = LAG
    neutral = start_point().with_effects({"motor_lag": lag.neutral(POINT)})
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


# -- streams faster than their filters, and commands between the logged ones -------------------------------------------


@pytest.mark.parametrize(("period", "every"), [(0.002, 5), (0.004, 2), (0.005, 2), (0.008, 1), (0.01, 1), (0.02, 1)])
@pytest.mark.parametrize("begin", [0.0, 3.7, 1.7e6])
def test_of_a_fast_stream_every_so_many_samples_count(period, every, begin):
    """Evenly spaced, exactly; with stamps that jitter by a tenth of a period, within one sample."""
    jitter, number = np.random.default_rng(0).uniform(-0.1, 0.1, 600), np.arange(600.0)[:, None]
    for by, away in ((0.0, 0.0), (1.0, float(every > 1))):
        time = begin + period * (np.arange(600) + by * jitter)
        kept, value = thinned(time, number)
        assert kept.size == pytest.approx(600 / every, rel=0.02)
        assert np.abs(np.diff(value[1:-1, 0]) - every).max() <= away
        assert np.array_equal(kept, time[value[:, 0].astype(int)])  # values stay with their stamps


@given(st.integers(0, 2**31), st.sampled_from([0.002, 0.004, 0.005]))
def test_where_samples_are_lost_no_interval_stays_empty_that_holds_one(seed, period):
    time = (period * np.arange(500))[np.random.default_rng(seed).random(500) > 0.05]
    kept, _ = thinned(time, time[:, None])
    alone = np.diff(time) > RECORDINGS.sample_period  # gaps of the stream itself
    assert np.diff(kept).max() <= 2 * RECORDINGS.sample_period + np.diff(time).max() * alone.any() + period
    assert set(kept) <= set(time)


WHITE = 0.07 + 0.001 * np.random.default_rng(1).standard_normal((6000, 4))


@pytest.mark.parametrize(("period", "missed"), [(0.002, 0.0), (0.004, 0.5), (0.01, 0.8), (0.02, 0.9)])
def test_of_white_commands_all_but_the_logged_ones_are_missed(period, missed):
    """Half of white power is above half of the Nyquist frequency: twice that, squared, is one."""
    assert unlogged_share(made(WHITE, period).flights, DRONE) == pytest.approx(missed, rel=0.15)


def test_smooth_commands_and_measured_speeds_miss_nothing():
    time = 0.01 * np.arange(3000)
    swing = 0.07 + 0.005 * np.sin(2 * np.pi * 3.0 * time)[:, None] * np.array([1.0, 1.0, -1.0, -1.0])
    assert unlogged_share(made(swing).flights, DRONE) < 1e-6
    assert unlogged_share(made(WHITE, measured=True).flights, DRONE) == 0.0


def test_what_was_not_logged_widens_the_priors_of_what_turns_the_drone():
    share, sd = unlogged_share(made(WHITE).flights, DRONE), sds(made(WHITE))
    assert sd["inertia"] / DRONE.inertia == pytest.approx(np.hypot([0.01, 0.01, 0.02], share))
    assert sd["rate_damping"] == pytest.approx(np.full(3, 3e-4 * share))
    assert sd["input_delay"] == pytest.approx(np.hypot(2e-3, 0.01 * share))
    whole = sds(made(WHITE, 0.002))
    assert whole["inertia"] / DRONE.inertia == pytest.approx([0.01, 0.01, 0.02])
    assert "rate_damping" not in whole


def test_commands_between_samples_are_free_where_the_log_is_slower_than_the_loop():
    assert sds(made(WHITE))["sampled_commands"] == pytest.approx([0.4, 0.4])
    assert "sampled_commands" not in {**sds(made(WHITE, 0.002)), **sds(made(WHITE, measured=True))}


def test_a_battery_without_a_voltage_may_sag_and_run_down():
    assert not {"thrust_curve", "battery_sag"} & sds(made(WHITE)).keys()
    sd = sds(made(WHITE, levelled=True))
    assert sd["thrust_curve"] == pytest.approx(0.15)
    assert sd["battery_sag"] == pytest.approx(1.5e-3)
