"""Before against after a write: made flights of known errors, judged by figures that a slow plain version confirms."""

import math
import random
from dataclasses import replace

import pytest

from crazyem.control.indi import IndiResponse
from crazyem.live.policy import MonitorLimits
from crazyem.live.post_write_monitor import SERIES_LENGTH, PostWriteMonitor
from crazyem.signals.sample import Sample

LIMITS = MonitorLimits()
WRITE = 5.0  # s


def samples(t, *, error=0.05, tremble=0.1, wanted=(0.0, 0.0, 1.0), tilt=0.0):
    """What the blocks of one instant bring: a drone `error` m below its setpoint that trembles at 6 Hz."""
    yield Sample("setpoint_position", t - 0.002, wanted)
    yield Sample("attitude", t, (math.sin(tilt / 2), 0.0, 0.0, math.cos(tilt / 2)))
    yield Sample("body_rate", t, (math.sqrt(2) * tremble * math.sin(2 * math.pi * 6.0 * t), 0.0, 0.0))
    yield Sample("position", t, (wanted[0], wanted[1], wanted[2] - error))


def fly(watch, start, seconds, *, innovation=1.0, gap=(math.inf, math.inf), **what):
    """Feed 100 Hz from `start` on; the first verdict that is one, with its time."""
    for i in range(round(100 * seconds)):
        t = start + 0.01 * i
        if gap[0] <= t < gap[1]:
            continue
        for sample in samples(t, **{k: v(t) if callable(v) else v for k, v in what.items()}):
            watch.take(sample)
        if i % 4 == 0:
            watch.innovation(t, innovation**2)
            verdict, why = watch.judge(t)
            if verdict:
                return verdict, why, t
    return "", "", math.nan


def written(limits=LIMITS, **before):
    watch = PostWriteMonitor(limits)
    assert fly(watch, 0.0, WRITE, **before)[0] == ""  # nothing to judge
    watch.on_write(WRITE, WRITE + 0.03)
    return watch


def test_nothing_changed_is_good_after_its_time():
    watch = written()
    verdict, why, t = fly(watch, WRITE, 10.0)
    assert verdict == "good"
    assert t == pytest.approx(WRITE + 0.03 + LIMITS.settle + LIMITS.after, abs=0.05)
    assert "0.050 m" in why
    assert watch.judging
    watch.forget()
    assert not watch.judging
    assert fly(watch, t, 5.0, error=0.4)[0] == ""


@pytest.mark.parametrize(
    ("after", "says"),
    [
        ({"error": 0.2}, "m rms from the setpoint, 0.050 m before"),
        ({"error": 0.7}, "m from the setpoint"),
        ({"tremble": 2.0}, "rad/s, 0.09 before"),
        ({"tremble": 12.0}, "oscillate"),
        ({"innovation": 3.5}, "innovations of 3.5 standard deviations, 1.0 before"),
        ({"tilt": 1.4}, "leans 80 degrees"),
    ],
)
def test_worse_is_told_apart_and_named(after, says):
    verdict, why, _ = fly(written(), WRITE, 10.0, **after)
    assert verdict == "worse"
    assert says in why


def test_what_is_bad_enough_is_seen_before_it_has_settled():
    assert fly(written(), WRITE, 10.0, error=lambda t: 4.0 * (t - WRITE))[2] < WRITE + LIMITS.settle
    assert fly(written(), WRITE, 10.0, tilt=1.4)[2] < WRITE + 0.05


def circle(t):
    """A setpoint that begins to move by 2 m/s."""
    return (math.cos(2 * t), math.sin(2 * t), 1.0)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ({"error": 0.34}, {"error": lambda t: 0.34 * math.exp(WRITE - t)}),  # better
        ({}, {"error": 0.14}),  # within what is allowed over before
        ({}, {"tremble": 1.2}),  # an excitation that began: hover trembles by 0.1 rad/s, the shipped excitation by 0.7
        ({}, {"innovation": 2.9}),
        ({}, {"wanted": circle, "error": 0.3}),  # 2 m/s explain 0.2 m more
        ({}, {"wanted": circle, "innovation": 3.5}),  # drag, which the model leaves out
    ],
)
def test_better_and_a_little_more_are_not_worse(before, after):
    assert fly(written(**before), WRITE, 10.0, **after)[0] == "good"


def test_a_setpoint_that_begins_to_move_explains_no_more_than_some_lag():
    assert fly(written(), WRITE, 10.0, wanted=circle, error=0.5)[0] == "worse"


def test_a_high_pass_of_4_hz_tells_trembling_from_an_excitation():
    """With the limits for INDI trembling is worse, and an excitation is not."""
    limits = MonitorLimits(oscillation=0.5, high_pass=0.04, high_pass_order=2, oscillation_ratio=1.0)
    for hertz, size, verdict in ((2.0, 1.2, "good"), (3.0, 1.8, "good"), (9.0, 1.2, "worse")):
        watch = PostWriteMonitor(limits)
        for n in range(1200):
            t = 0.01 * n
            rate = size * math.sin(2 * math.pi * hertz * t) if t > WRITE else 0.0
            watch.take(Sample("body_rate", t, (rate, 0.0, 0.0)))
            if n == round(100 * WRITE):
                watch.on_write(t, t)
        assert watch.judge(12.0)[0] == verdict


@pytest.mark.parametrize(("aside", "below", "verdict"), [(0.0, 0.0, "good"), (0.0, 0.3, "good"), (0.3, 0.0, "worse")])
def test_indi_is_compared_with_its_expected_response(aside: float, below: float, verdict: str) -> None:
    """Places far ahead from WRITE on. The drone responds as it should, or does so aside or below."""
    response, watch = IndiResponse(), PostWriteMonitor(MonitorLimits(lead=0.0), IndiResponse())
    for n in range(1200):
        t = 0.01 * n
        off = 1.0 if t > WRITE else 0.0
        ahead = 0.5 * off * math.sin(6.0 * (t - WRITE))
        x, y, z = response.expected(t, (ahead, 0.0, 1.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
        watch.take(Sample("setpoint_position", t, (ahead, 0.0, 1.0)))
        watch.take(Sample("position", t, (x, y + off * aside, z - off * below)))
        watch.take(Sample("body_rate", t, (0.0, 0.0, 0.0)))
        if n == round(100 * WRITE):
            watch.on_write(t, t)
        elif t > WRITE + 2.0 and watch.judge(t)[0]:
            break
    assert watch.judge(t)[0] == verdict


def test_writes_that_follow_each_other_are_judged_against_the_time_before_the_first():
    watch = written()
    assert fly(watch, WRITE, 0.5, error=0.13)[0] == ""
    watch.on_write(WRITE + 0.5, WRITE + 0.53)
    assert fly(watch, WRITE + 0.5, 0.5, error=0.13)[0] == ""
    watch.on_write(WRITE + 1.0, WRITE + 1.03)
    verdict, why, _ = fly(watch, WRITE + 1.0, 5.0, error=0.2)
    assert verdict == "worse"
    assert "0.050 m before" in why
    assert watch.unjudged == 3
    for k in range(watch.limits.unjudged - 3):
        assert not watch.full
        watch.on_write(WRITE + 1.5 + 0.5 * k, WRITE + 1.53 + 0.5 * k)
    assert watch.full


def test_an_outage_after_a_write_is_no_proof_that_it_was_good():
    verdict, _, t = fly(written(), WRITE, 10.0, gap=(WRITE + 0.01, WRITE + 6.0))
    assert verdict == "good"
    assert t > WRITE + 6.0
    assert fly(written(), WRITE, 10.0, gap=(WRITE + 0.01, WRITE + 6.0), error=0.3)[0] == "worse"


def test_a_drone_that_does_not_follow_setpoints_is_judged_by_the_rest():
    assert fly(written(error=5.0), WRITE, 10.0, error=9.0)[0] == "good"
    assert fly(written(error=5.0), WRITE, 10.0, error=9.0, tremble=3.0)[0] == "worse"


def test_switched_off_it_says_nothing():
    assert fly(written(replace(LIMITS, enabled=False)), WRITE, 10.0, error=3.0)[0] == ""


def test_figures_against_a_plain_version():
    rng = random.Random(4)
    watch, rows = PostWriteMonitor(), []
    slow, last = None, None
    for i in range(500):
        t = 0.01 * i + rng.uniform(-0.002, 0.002)
        p, w = [rng.gauss(0, 0.1) for _ in range(3)], [rng.gauss(0, 1.0) for _ in range(3)]
        s = (0.3 * t, 0.0, 1.0)
        watch.take(Sample("setpoint_position", t, s))
        watch.take(Sample("position", t, tuple(p)))
        watch.take(Sample("body_rate", t, tuple(w)))
        if slow is None:
            slow = list(w)
        else:
            a = math.exp(-(t - last) / MonitorLimits().high_pass)
            slow = [a * x + (1 - a) * y for x, y in zip(slow, w)]
        last = t
        rows.append((t, math.dist(p, s), math.dist(w, slow)))
    f = watch.figures(1.0, 3.0)
    chosen = [r for r in rows if 1.0 <= r[0] <= 3.0]
    for value, column in ((f.tracking, 1), (f.oscillation, 2)):
        assert value == pytest.approx(math.sqrt(sum(r[column] ** 2 for r in chosen) / len(chosen)), rel=1e-9)
    assert f.speed == pytest.approx(0.3, rel=1e-6)
    assert math.isnan(f.innovation)


def test_memory_is_bounded_and_nonsense_is_left_out():
    watch = PostWriteMonitor()
    for i in range(3 * SERIES_LENGTH):
        watch.innovation(0.01 * i, math.nan if i % 2 else 4.0)
    assert len(watch._innovation._items) == SERIES_LENGTH
    assert watch.figures(0.0, 1e9).innovation == pytest.approx(2.0)
