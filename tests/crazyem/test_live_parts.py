"""Parts of the live loop: firmware clock, tracking errors, summary, and a simulator that will not start."""

import json
import math
import random
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from crazyem.control.trajectories import hover
from crazyem.errors import CrazyemError, FileFormatError, UsageError
from crazyem.estimation.result import PARAMETER_UNITS, Estimate, ParameterEstimate
from crazyem.live.clock import FirmwareClock
from crazyem.live.history import MOST_ESTIMATES, SETTLE_SECONDS, History, Push, Track
from crazyem.live.plot import figure_of
from crazyem.live.simulator import Simulator
from crazyem.live.stream import SetpointStream
from crazyem.live.summary import build_summary, check_writable, live_line, text_summary, write_json
from crazyem.notebook import saved
from crazyem.signals.sample import Sample
from crazyem.vehicle import load_vehicle


@pytest.mark.parametrize("speed", [0.5, 1.0, 10.0])
def test_clock_follows_the_firmware_through_delays(speed):
    rng = random.Random(1)
    clock = FirmwareClock()
    offset = 123.4
    for i in range(800):
        host = 0.01 * i
        clock.observe(offset + speed * host, host + (0.001 if rng.random() < 0.7 else rng.uniform(0.001, 0.02)))
    now = clock.now(8.0)
    assert clock.rate == pytest.approx(speed, rel=0.01)
    assert now == pytest.approx(offset + speed * (8.0 - 0.001), abs=0.012 * speed)


def test_clock_never_runs_backwards_and_stops_when_the_drone_does():
    clock = FirmwareClock()
    for i in range(100):
        clock.observe(0.01 * i, 0.01 * i)
    times = [clock.now(h) for h in (1.0, 0.5, 1.2, 5.0, 500.0)]
    assert times == sorted(times)
    assert times[-1] < 2.5


def test_no_trajectory_ends_by_a_prediction_of_the_clock():
    """A drone forty times as fast as real time, of which nothing comes for 0.4 s."""
    clock = FirmwareClock()
    for i in range(100):
        clock.observe(0.4 * i, 0.01 * i)
    assert clock.now(1.39) > clock.newest + 10.0
    link = SimpleNamespace(send_full_state=lambda *reference: None)
    stream = SetpointStream(link, hover(position=(0.0, 0.0, 1.0), yaw=0.0, duration=9.0), clock)
    stream.start()
    stream.stop()
    assert stream.failure is None
    assert stream.elapsed == 0.0
    clock.observe(clock.newest + 2.0, 1.4)
    assert stream.elapsed == pytest.approx(2.0)


def estimate(time=1.0):
    parameters = {n: ParameterEstimate(1.0, 0.1, (0.8, 1.2), u, True) for n, u in PARAMETER_UNITS.items()}
    return Estimate(time, parameters, samples=10, updates=3, converged=True)


def flown(push_at=5.0, *, marks=True):
    history = History()
    for i in range(2000):
        t = 0.01 * i
        history.take(Sample("setpoint_position", t - 0.004, (0.0, 0.0, 1.0 + 0.1 * t)))
        z = 1.0 + 0.1 * t - (0.3 if t < push_at else 0.3 * math.exp(-2 * (t - push_at)))
        history.take(Sample("position", t, (0.0, 0.02, z)))
    if marks:
        history.marks.update(trajectory_start=1.0, trajectory_end=19.0)
    history.pushes.append(Push(push_at, "ctrlLee.mass", 0.033, True))
    return history


def test_tracking_before_and_after_the_push():
    rms, height = flown().before_and_after()
    assert height["before_push"] == pytest.approx(-0.3, abs=1e-3)
    assert abs(height["after_push"]) < 1e-3
    assert rms["before_push"] == pytest.approx(math.hypot(0.3, 0.02), rel=1e-2)
    assert rms["after_push"] == pytest.approx(0.02, rel=1e-2)


def test_tracking_is_unknown_without_marks_and_without_enough_flight_after():
    assert set(flown(marks=False).before_and_after()[0].values()) == {None}
    assert flown(push_at=19.0 - SETTLE_SECONDS / 2).before_and_after()[0]["after_push"] is None


def test_unverified_pushes_do_not_count():
    history = flown()
    history.pushes = [Push(5.0, "ctrlLee.mass", 0.033, False)]
    assert history.before_and_after()[0]["after_push"] is None


def test_summary_round_trips_and_knows_no_nan(tmp_path, capsys):
    summary = build_summary(
        log="a.mcap", vehicle="cf2", estimate=estimate(), history=flown(), update_seconds=[0.001, 0.002, 0.003],
        received=100, lost=1, extra={"seed": 3, "odd": math.nan},
    )  # fmt: skip
    write_json(summary, str(tmp_path / "s.json"))
    back = json.loads((tmp_path / "s.json").read_text())
    assert back["update_ms"]["median"] == pytest.approx(2.0)
    assert back["samples"] == {"received": 100, "lost": 1}
    assert back["pushes"] == [{"time": 5.0, "parameter": "ctrlLee.mass", "value": 0.033, "verified": True}]
    assert back["odd"] is None
    write_json(summary, "-")
    assert json.loads(capsys.readouterr().out) == back
    assert "not confirmed" in text_summary(summary, estimate())


def test_places_that_cannot_be_written(tmp_path):
    for bad in (tmp_path, tmp_path / "no" / "x.json"):
        with pytest.raises(UsageError, match="cannot write"):
            check_writable(str(bad))
    check_writable("-")
    check_writable(None)


def test_live_line_marks_what_is_not_identified():
    e = estimate()
    assert "no estimate yet" in live_line("hover", 1.0, None, lost=0, pushes=0)
    line = live_line("hover", 1.0, e, lost=2, pushes=3)
    assert "lost 2" in line
    assert "?" not in line


def test_plot_is_written_even_with_next_to_nothing(tmp_path):
    history = History()
    history.estimates.append(estimate())
    figure = figure_of(history, load_vehicle("cf2"), title="t")
    saved(figure, tmp_path / "p.png")
    assert (tmp_path / "p.png").stat().st_size > 1000
    with pytest.raises(UsageError, match="cannot write"):
        saved(figure, tmp_path / "no" / "p.png")


def test_a_long_flight_keeps_the_newest_estimates_and_fewer_of_the_old_ones():
    history, count, one = History(), 3 * MOST_ESTIMATES, estimate()
    for k in range(count):
        history.keep(replace(one, time=float(k)))
    times = [e.time for e in history.estimates]
    assert len(times) <= MOST_ESTIMATES
    assert times == sorted(times)
    assert times[0] == 0.0
    assert times[-MOST_ESTIMATES // 2 :] == list(range(count - MOST_ESTIMATES // 2, count))


def command(script):
    return [sys.executable, "-c", script]


def test_simulator_that_refuses_its_scenario_speaks_for_itself(tmp_path):
    script = "import sys; print('firmware_sim: s.toml: unknown key mas', file=sys.stderr); sys.exit(2)"
    with pytest.raises(FileFormatError, match=r"s\.toml: unknown key mas"):
        Simulator(scenario=tmp_path / "s.toml", command=command(script)).start()


@pytest.mark.parametrize(
    ("script", "says"),
    [("import sys; sys.exit(3)", "did not start: exit code 3"), ("import time; time.sleep(60)", "not get ready")],
)
def test_simulator_that_dies_or_hangs(script, says):
    with pytest.raises(CrazyemError, match=says):
        Simulator(command=command(script), timeout=0.5 if "sleep" in script else 60.0).start()


def test_simulator_address_is_taken_from_its_ready_line():
    script = "import time; print('firmware_sim: udp://127.0.0.1:4711 platform cf2', flush=True); time.sleep(60)"
    with Simulator(command=command(script)) as simulator:
        assert simulator.uri == "udp://127.0.0.1:4711"


def test_clock_absorbs_a_stall_without_freezing_or_jumping():
    """The firmware loses 0.5 s while the host's clock goes on, as a simulator does that was denied the processor."""
    clock = FirmwareClock()
    host, firmware, answers = 0.0, 0.0, []
    for i in range(2000):
        host += 0.01
        if not 800 <= i < 850:
            firmware += 0.01
            clock.observe(firmware, host)
        answers.append((host, clock.now(host)))
    rates = np.diff([a for _, a in answers[300:]]) / 0.01
    assert rates.min() > 0.7
    assert rates.max() < 1.3
    assert answers[-1][1] == pytest.approx(firmware, abs=0.02)


@pytest.mark.parametrize("count", [0, 7, 8, 9, 40, 1000])
def test_a_track_is_thinned_evenly_and_never_grows_beyond_its_rows(count):
    track = Track(rows=8)
    for k in range(count):
        track.add(0.01 * k, (k, 2 * k, 3 * k))
        assert len(track.array()) < 8
    times = track.array()[:, 0]
    every = next((2**j for j in range(20) if count <= 8 * 2**j - 2**j), 1)  # the least that leaves fewer than 8 rows
    assert times == pytest.approx(0.01 * np.arange(0, count, every))
    np.testing.assert_array_equal(track.array()[:, 2], 2 * track.array()[:, 1])
