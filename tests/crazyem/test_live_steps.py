"""Changes of mass in flight: told, pushed soon and within bounds, and blamed on nothing that was written."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hovering import INERTIA, hover
from test_guard import NOMINAL, ORIGINALS, estimate
from test_live_post_write_monitor import LIMITS, WRITE, fly, written

from crazyem.cli import main
from crazyem.estimation.online import OnlineEstimator
from crazyem.estimation.result import Step
from crazyem.estimation.steps import StepAwareEstimator, largest_jump
from crazyem.live.controllers import LEE
from crazyem.live.guard import Guard
from crazyem.live.history import History
from crazyem.live.pipeline import Pipeline, steps_of
from crazyem.live.scheduler import UpdateThrottle
from crazyem.live.summary import build_summary, text_summary
from crazyem.recordings import open_recording
from crazyem.vehicle import Vehicle

VEHICLE = Vehicle("hovering", 0.029, INERTIA, motor_time_constant=0.05)
NOTICED = Step(10.0, 10.2, 0.029)
REAL = Step(10.0, 10.2, 0.029, 0.0355, True)
GUST = Step(10.0, 10.2, 0.029, 0.029, False)

# --- the guard ------------------------------------------------------------------------------------------------------


def settled(*steps):
    """A guard at 10.2 s that has seen 3 s of the nominal mass and has nothing to write, and then hears of steps."""
    guard = Guard(LEE, nominal=NOMINAL, originals=ORIGINALS)
    for k in range(76):
        t = 7.2 + 0.04 * k
        guard.consider(estimate(t, **NOMINAL), t, airborne=True)
    for step in steps:
        guard.on_mass_step(step)
    return guard


def writes(guard, start, seconds, mass):
    """(time, mass) of every write of a mass when estimates say `mass` from `start` on."""
    out = []
    for k in range(round(seconds / 0.04)):
        t = start + 0.04 * k
        d = guard.consider(estimate(t, **{**NOMINAL, "mass": mass}), t, airborne=True)
        out += [(t, value) for name, value in d.writes if name == "ctrlLee.mass"]
    return out


def test_a_real_step_is_written_at_once_and_whole():
    guard = settled(NOTICED)
    assert writes(guard, 10.2, 0.4, 0.0355) == []
    guard.on_mass_step(REAL)
    written_ = writes(guard, 10.6, 1.0, 0.0355)
    assert written_[0] == (pytest.approx(10.6), pytest.approx(0.0355))  # 22 %, where a write may move by 15 %
    assert len(written_) == 1


def test_without_a_step_the_same_takes_longer():
    written_ = writes(settled(), 10.2, 2.0, 0.0355)
    assert written_[0] == (pytest.approx(10.72, abs=0.05), pytest.approx(0.029 * 1.15))
    assert written_[1][1] == pytest.approx(0.0355)


def test_a_gust_is_waited_for_and_changes_nothing():
    guard = settled(NOTICED)
    d = guard.consider(estimate(10.4, **{**NOMINAL, "mass": 0.033}), 10.4, airborne=True)
    assert "may have changed" in d.why
    guard.on_mass_step(GUST)
    assert writes(guard, 11.2, 0.4, 0.029) == []


@pytest.mark.parametrize("mass", [0.075, 0.012])
def test_a_step_stays_within_the_bounds(mass):
    assert writes(settled(NOTICED, Step(10.0, 10.2, 0.029, mass, True)), 10.6, 2.0, mass) == []


def test_thrust_that_jumps_in_the_log_alone_ends_the_pushing():
    guard = settled(NOTICED, Step(10.0, 10.2, 0.029, 0.046, False, True))
    assert writes(guard, 10.6, 5.0, 0.046) == []
    assert "jumped" in guard.stopped


def test_a_large_change_waits_until_what_went_before_was_judged():
    guard = settled()
    first = writes(guard, 10.2, 4.0, 0.0464)  # 60 % more than the controller believes
    assert first[-1][1] == pytest.approx(0.029 * 1.35)
    waiting = guard.consider(estimate(14.3, **{**NOMINAL, "mass": 0.0464}), 14.3, airborne=True)
    assert "was judged" in waiting.why
    guard.trust()
    assert writes(guard, 14.4, 2.0, 0.0464)[-1][1] == pytest.approx(0.0464)
    unjudged = settled()
    unjudged.capped = False  # where nobody judges
    assert writes(unjudged, 10.2, 4.0, 0.0464)[-1][1] == pytest.approx(0.0464)


def thrust(values):
    """Stamps and wrenches of commands every 10 ms."""
    out = np.zeros((len(values), 4))
    out[:, 0] = values
    return 0.01 * np.arange(len(values)), out


def test_jumps_of_thrust_that_last_are_told_from_spikes_ramps_and_noise():
    steady = 0.3 * np.exp(0.005 * np.random.default_rng(1).standard_normal(60))
    jump, spike = steady.copy(), steady.copy()
    jump[30:] *= 1.5
    spike[30] *= 1.5
    ramp = steady * np.exp(np.clip(np.arange(60) - 20, 0, 20) / 20 * np.log(1.5))  # a controller that answers
    assert largest_jump(*thrust(jump), since=0.1) == pytest.approx(np.log(1.5), abs=0.02)
    assert largest_jump(*thrust(1 / jump), since=0.1) == pytest.approx(-np.log(1.5), abs=0.02)
    for values in (steady, spike, ramp):
        assert abs(largest_jump(*thrust(values), since=0.1)) < 0.05
    assert abs(largest_jump(*thrust(jump), since=0.35)) < 0.05  # it was before
    assert largest_jump(*thrust([]), since=0.0) == 0.0


@pytest.mark.parametrize(("relative_sd", "movement"), [(0.02, 0.0), (0.003, 0.02)], ids=["wide", "moving"])
def test_a_step_lifts_no_other_limit(relative_sd, movement):
    guard = settled(NOTICED, REAL)
    for k in range(50):
        t, mass = 10.6 + 0.04 * k, 0.0355 * (1.0 + movement * (-1) ** k)
        found = estimate(t, relative_sd=relative_sd, **{**NOMINAL, "mass": mass})
        assert not guard.consider(found, t, airborne=True).writes
    # what was not written in time is written by the usual rules
    late = writes(guard, 10.2 + 5.1, 2.0, 0.0355)
    assert late[0][1] == pytest.approx(0.029 * 1.15)


# --- the watch ------------------------------------------------------------------------------------------------------


def falls(t):
    """m from the setpoint of a drone that got 20 % heavier at 6 s, and lighter in its controller's belief at 6.8 s."""
    if t < 6.0:
        return 0.05
    return 0.05 + 0.28 * min((t - 6.0) / 0.5, 1.0) * math.exp(-2.0 * max(t - 6.8, 0.0))


def told(watch, *, mass_written):
    """The flight from WRITE on, with the step told as the pipeline tells it; the verdict."""
    verdict = fly(watch, WRITE, 1.2, error=falls)
    assert verdict[0] == ""
    watch.on_mass_step(began=6.0, now=6.2, real=None)
    assert fly(watch, 6.2, 0.4, error=falls)[0] == ""
    watch.on_mass_step(began=6.0, now=6.6, real=True)
    assert fly(watch, 6.6, 0.2, error=falls)[0] == ""
    if mass_written:
        watch.on_write(6.8, 6.83)
        return fly(watch, 6.8, 8.0, error=falls)
    return fly(watch, 6.8, 8.0, error=lambda t: falls(min(t, 6.8)))


@pytest.mark.parametrize("mass_written", [True, False])
def test_a_write_before_a_step_is_not_blamed_for_it(mass_written):
    verdict, why, _ = told(written(), mass_written=mass_written)
    assert verdict == "good", why


def test_not_told_it_is():
    """The test above tests something."""
    watch = written()
    assert fly(watch, WRITE, 4.0, error=falls)[0] == "worse"


def test_a_wrong_mass_after_a_step_is_noticed_when_the_drone_should_be_back():
    watch = written()
    watch.forget()
    assert fly(watch, WRITE, 1.2, error=falls)[0] == ""
    watch.on_mass_step(began=6.0, now=6.2, real=None)
    watch.on_mass_step(began=6.0, now=6.6, real=True)
    watch.on_write(6.6, 6.63)
    verdict, why, t = fly(watch, 6.6, 8.0, error=0.30)
    assert verdict == "worse"
    assert "0.050 m before" in why  # against the flight before the step
    assert 9.0 < t < 12.0


@pytest.mark.parametrize(
    ("what", "seconds"),
    [({"tremble": 12.0}, 1.0), ({"error": 1.2}, 1.0), ({"error": 0.4}, 8.0)],
    ids=["oscillation", "great distance", "an estimator that stalls in the step"],
)
def test_what_alarms_while_a_step_is_undecided(what, seconds):
    watch = written()
    assert fly(watch, WRITE, 1.0)[0] == ""
    watch.on_mass_step(began=6.0, now=6.1, real=None)
    assert fly(watch, 6.1, seconds, **what)[0] == "worse"


def test_after_a_gust_it_is_judged_again():
    watch = written()
    assert fly(watch, WRITE, 1.0)[0] == ""
    watch.on_mass_step(began=6.0, now=6.1, real=None)
    assert fly(watch, 6.1, 1.0, error=0.35)[0] == ""
    watch.on_mass_step(began=6.0, now=7.1, real=False)
    verdict, _, t = fly(watch, 7.1, 8.0, error=lambda t: 0.35 if t < 7.5 else 0.05)
    assert verdict == "good"
    assert t == pytest.approx(7.1 + 1.0 + LIMITS.after, abs=0.1)


def test_a_full_account_leaves_room_for_the_new_mass():
    watch = written()
    for k in range(LIMITS.unjudged - 1):
        watch.on_write(WRITE + 0.5 * k, WRITE + 0.5 * k)
    assert watch.full
    watch.on_mass_step(began=6.0, now=6.1, real=None)
    assert not watch.full


# --- the pipeline, and what is told ---------------------------------------------------------------------------------


def flown(masses, *, wrap=lambda e: e, seed=0):
    history, events = History(), []
    estimator = wrap(StepAwareEstimator(OnlineEstimator(VEHICLE)))
    pipeline = Pipeline(estimator, history=history, on_step=lambda s: events.append(s.real))
    for sample in hover(masses, seed=seed, duration=6.0):
        pipeline.sample(sample)
    return pipeline, history, events


@pytest.mark.parametrize("wrap", [lambda e: e, UpdateThrottle])
def test_a_step_is_told_when_noticed_and_when_decided(wrap):
    pipeline, history, events = flown([(0.0, 0.029), (4.0, 0.034)], wrap=wrap)
    assert events == [None, True]
    (step,) = history.steps
    estimate_ = pipeline.finish()
    summary = build_summary(
        log=None, vehicle="v", estimate=estimate_, history=history, update_seconds=(), received=0, lost=0
    )
    (entry,) = summary["steps"]
    assert entry["real"]
    assert entry["before_kg"] == pytest.approx(0.029, rel=0.02)
    assert entry["after_kg"] == pytest.approx(0.034, rel=0.02)
    line = f"mass changed at {step.time:.2f} s: {step.before:.4g} -> {step.after:.4g} kg"
    assert str(step) == line
    assert line in text_summary(summary, estimate_)


def test_the_same_samples_give_the_same_steps_and_estimates():
    (_, a, _), (_, b, _) = (flown([(0.0, 0.029), (4.0, 0.031)], seed=3) for _ in range(2))
    assert a.steps == b.steps
    assert len(a.steps) == 1
    assert a.estimates == b.estimates


def test_an_estimator_that_looks_for_none_has_none():
    assert steps_of(OnlineEstimator(VEHICLE)) == ()
    aware = StepAwareEstimator(OnlineEstimator(VEHICLE))
    aware.every = 9  # UpdateThrottle sets it
    assert aware.inner.every == 9


def test_the_end_of_a_flight_within_a_step_uses_the_whole_window():
    estimator = StepAwareEstimator(OnlineEstimator(VEHICLE))
    for sample in hover([(0.0, 0.029), (4.0, 0.034)], duration=4.4):
        estimator.feed(sample)
    assert estimator.deciding
    estimator.finish()
    assert estimator.steps[-1].real is False
    assert estimator.inner.window == estimator.window


# --- end to end -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_payload_hung_under_in_flight_is_found_told_pushed_and_replayed(tmp_path, capsys):
    scenario = Path(__file__).parents[2] / "firmware_sim" / "scenarios" / "payload_attach.toml"
    out, again, file = tmp_path / "f.json", tmp_path / "r.json", tmp_path / "f.mcap"
    # in real time, and long enough for a busy machine: the guard writes nothing on estimates that come late
    assert main(["fly", "--trajectory", "hover", "--duration", "20", "--scenario", str(scenario),
                 "--json", str(out), "--record", str(file)]) == 0  # fmt: skip
    said = capsys.readouterr()
    summary = json.loads(out.read_text())
    (step,) = [s for s in summary["steps"] if s["real"]]
    assert step["after_kg"] == pytest.approx(0.034, rel=0.02)
    assert step["found"] - step["time"] < 0.6
    masses = [(p["time"], p["value"]) for p in summary["pushes"] if p["parameter"] == "ctrlLee.mass"]
    first = next(t for t, m in masses if abs(m / 0.034 - 1) < 0.02)
    assert step["found"] < first
    assert summary["guard"]["in_drone"]["ctrlLee.mass"] == pytest.approx(0.034, rel=0.02)
    assert summary["guard"]["stopped"] == ""
    line = f"mass changed at {step['time']:.2f} s"
    assert line in said.err
    assert line in said.out
    recording = open_recording(file)
    assert any(str(e.data.get("message", "")).startswith(line) for e in recording.events if e.kind == "log")
    assert main(["replay", str(file), "--json", str(again)]) == 0
    replayed = json.loads(again.read_text())
    assert replayed["steps"] == summary["steps"]
    assert replayed["estimates"] == summary["estimates"]
