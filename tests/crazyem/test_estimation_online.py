"""The online estimator on synthetic flights: values, determinism, bad samples, streams out of step, input signals."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import synthetic

from crazyem.errors import DataError, FileFormatError, UsageError
from crazyem.estimation.em import WindowEM
from crazyem.estimation.online import OnlineEstimator
from crazyem.signals.sample import Sample
from crazyem.vehicle import load_vehicle, parse_vehicle

# commands with rotor lag, but as a wrench: the nominal constants of a Crazyflie, wrong for the drone that flies
LAGGED = replace(load_vehicle("cf2"), thrust_curve=(), rotor_constant=None, thrust_max=math.inf)
TRUTH = synthetic.Truth()
NAMES = ("mass", "Ixx", "Iyy", "Izz")
TRUE = {"mass": TRUTH.mass, **dict(zip(NAMES[1:], TRUTH.inertia)), "motor_time_constant": TRUTH.lag}


@pytest.fixture(scope="module")
def flight():
    return synthetic.fly(TRUTH, seed=11, duration=5.0)


def feed(estimator, samples):
    """All estimates on the way."""
    return [e for e in map(estimator.feed, samples) if e is not None]


def ended(samples, vehicle=LAGGED):
    """The estimator after these samples and its last estimate; few updates, since nobody reads those on the way."""
    estimator = OnlineEstimator(vehicle, every=25)
    feed(estimator, samples)
    return estimator, estimator.finish()


def same(a, b):
    """Bit for bit, NaN included."""
    return str(a.to_json()) == str(b.to_json()) and a.samples == b.samples and dict(a.noise) == dict(b.noise)


def within(estimate, name, true, sds=4.0):
    """The truth lies within so many standard deviations, which are themselves not ridiculous."""
    p = estimate[name]
    assert abs(p.value - true) < sds * p.sd, f"{name}: {p.value:.4g} +- {p.sd:.2g}, true {true:.4g}"
    assert p.ci95[0] < p.value < p.ci95[1]


@pytest.fixture(scope="module")
def plain(flight):
    """The flight estimated without anything special: estimator, estimates on the way, the final one."""
    estimator = OnlineEstimator(LAGGED)
    return estimator, feed(estimator, synthetic.samples(flight)), estimator.finish()


def begins(plain, estimates):
    """Whether these are, bit for bit, the first ones of the plain run."""
    return len(estimates) > 50 and all(same(a, b) for a, b in zip(plain[1], estimates))


def test_finds_the_drone_that_flies(flight, plain):
    estimator, estimates, final = plain
    for name, true in TRUE.items():
        within(final, name, true)
    for name in NAMES:
        assert final[name].identifiable, final[name].reason
    assert final["mass"].relative_sd < 0.005
    assert max(final[n].relative_sd for n in NAMES[1:]) < 0.15
    assert final.converged
    # what was said on the way was said in time order, with growing confidence
    assert all(a.time < b.time for a, b in pairwise(estimates))
    assert estimates[-1]["mass"].sd < estimates[10]["mass"].sd
    assert estimator.airborne
    assert final.samples == len(flight.time)
    assert len(estimator.update_seconds) in (len(estimates), len(estimates) + 1)  # one more when the end is flushed


def test_noise_scales_are_found_too(plain):
    noise = plain[-1].noise
    assert [noise[n] for n in ("position", "velocity", "attitude")] == pytest.approx(TRUTH.sensor[:3], rel=0.15)
    assert noise["thrust"] == pytest.approx(TRUTH.force_noise, rel=0.3)
    assert [noise["torque_x"], noise["torque_y"]] == pytest.approx([TRUTH.torque_noise] * 2, rel=0.5)


def shuffled(samples):
    keys = np.random.default_rng(0).uniform(size=len(samples))
    return [s for _, s in sorted(enumerate(samples), key=lambda e: (e[1].time, keys[e[0]]))]


def with_more(samples):
    unknown = {"specific_force": (0.0, 0.0, 9.81), "setpoint_position": (math.nan,) * 3}
    return [one for s in samples for one in (s, s, *(Sample(name, s.time, v) for name, v in unknown.items()))]


@pytest.mark.parametrize(
    "change",
    [list, shuffled, with_more],
    ids=["the same samples", "another order of one instant", "duplicates and signals that it does not know"],
)
def test_the_same_numbers_come_of(flight, plain, change):
    assert begins(plain, feed(OnlineEstimator(LAGGED), change(synthetic.samples(flight)[:1500])))


def test_late_samples_are_counted_and_not_used(flight, plain):
    samples = synthetic.samples(flight)[:1500]
    late = []
    for k, sample in enumerate(samples):
        late.append(sample)
        if k > 200 and k % 100 == 0:
            late.append(samples[k - 150])  # a packet of 300 ms ago, measurements or command
    one, two = plain[0], OnlineEstimator(LAGGED)
    estimates = feed(two, late)
    a, b = plain[1][len(estimates) - 1], estimates[-1]
    assert two.counters.late > 0
    assert one.counters.late == 0
    # nothing but the moment of an update may move
    for name in NAMES:
        assert b[name].value == pytest.approx(a[name].value, rel=0.1 * a[name].relative_sd + 1e-9)


def test_nan_is_missing_and_never_spreads(flight):
    rng = np.random.default_rng(1)
    samples = []
    for sample in synthetic.samples(flight):
        value = np.array(sample.value)
        if rng.uniform() < 0.2:
            value[rng.integers(len(value))] = rng.choice([np.nan, np.inf, -np.inf])
        samples.append(replace(sample, value=tuple(value)))
    estimator = OnlineEstimator(LAGGED)
    for estimate in feed(estimator, samples):
        assert all(np.isfinite(p.value) for p in estimate.parameters.values())
    final = estimator.finish()
    assert estimator.counters.missing > 100
    for name, true in TRUE.items():
        within(final, name, true)


def test_one_packet_in_five_lost(flight):
    """Measurements in two blocks, commands in a third, each with its own phase and its own losses."""
    rng = np.random.default_rng(2)
    blocks = (("position", "velocity", "attitude"), ("body_rate",))
    events = []
    for row in range(0, len(flight.fine_time) - 10, 10):
        for phase, names in zip((0, 4), blocks):
            if rng.uniform() > 0.2:
                t, y = flight.fine_time[row + phase], flight.fine_y[row + phase]
                events += [Sample(n, t, tuple(y[synthetic.COLUMNS[n]])) for n in names]
        if rng.uniform() > 0.2:
            t = flight.fine_time[row + 7]
            events.append(Sample("wrench_command", t, tuple(flight.fine_wrench[row + 7])))
    _, final = ended(events)
    for name, true in TRUE.items():
        within(final, name, true)
    assert final["mass"].identifiable


@pytest.mark.parametrize("lost", [[*synthetic.COLUMNS, "wrench_command"], ["wrench_command"]], ids=["all", "commands"])
def test_a_gap_is_a_break_and_not_a_step(flight, lost):
    """Commands that stop for a while are not held over."""
    samples = [s for s in synthetic.samples(flight) if s.signal not in lost or not 2.0 < s.time < 2.5]
    estimator, final = ended(samples)
    assert estimator.counters.breaks > 1
    for name, true in TRUE.items():
        within(final, name, true)


def test_a_jump_of_position_does_not_make_positions_worthless_for_ever():
    """A window that begins after the jump must not keep the position of the filter from before, and call that noise."""
    flight = synthetic.samples(synthetic.fly(TRUTH, seed=4, duration=12.0))
    noise = []
    for jump in (0.0, 0.3):
        estimator = OnlineEstimator(LAGGED, window=400)
        for s in flight:
            hit = s.signal == "position" and s.time >= 4.0
            estimator.feed(replace(s, value=(s.value[0] + jump, *s.value[1:])) if hit else s)
        noise.append(estimator.finish().noise["position"])
    assert noise[1] < 1.1 * noise[0]


def test_on_the_ground_nothing_is_identifiable_and_nothing_is_used():
    estimator = OnlineEstimator(LAGGED)
    rng = np.random.default_rng(0)
    for k in range(300):
        t = 0.01 * k
        estimator.feed(Sample("wrench_command", t, (0.0 if k < 100 else 0.2, 0.0, 0.0, 0.0)))  # spins up, does not lift
        estimator.feed(Sample("position", t, tuple(rng.normal(size=3) * 1e-3)))
        estimator.feed(Sample("velocity", t, tuple(rng.normal(size=3) * 1e-2)))
        estimator.feed(Sample("attitude", t, (0.0, 0.0, 0.0, 1.0)))
        estimator.feed(Sample("body_rate", t, tuple(rng.normal(size=3) * 1e-3)))
    final = estimator.finish()
    assert not estimator.airborne
    assert final.samples == 0
    assert estimator.counters.grounded > 290
    for name, p in final.parameters.items():
        assert not p.identifiable, name
        assert p.sd == math.inf or not p.identifiable
    assert "ground" in final["mass"].reason
    assert final["mass"].value == LAGGED.mass


def test_ground_before_and_after_a_flight_leaves_the_estimate_alone(flight, plain):
    """The flight begins and ends on the ground, in contact; contact says a = 0 whatever the thrust."""

    def on_ground(begin, end, thrust):
        out = []
        for t in np.arange(begin, end, 0.01):
            out.append(Sample("wrench_command", float(t), (thrust, 0.0, 0.0, 0.0)))
            still = {"position": (0, 0, -0.5), "velocity": (0, 0, 0), "attitude": (0, 0, 0, 1), "body_rate": (0, 0, 0)}
            out += [Sample(name, float(t), tuple(map(float, value))) for name, value in still.items()]
        return out

    end = float(flight.time[-1])
    samples = [*on_ground(-0.6, -0.3, 0.0), *on_ground(-0.3, -0.005, TRUTH.mass * 9.81), *synthetic.samples(flight),
               *on_ground(end + 0.01, end + 0.4, 0.3), *on_ground(end + 0.4, end + 0.6, 0.0)]  # fmt: skip
    (_, final), reference = ended(samples), plain[-1]
    assert final.samples == reference.samples
    for name in NAMES:
        assert abs(final[name].value - reference[name].value) < 0.5 * reference[name].sd


@pytest.mark.parametrize(("window", "every"), [(100, 7), (200, 10)])
def test_window_and_every_are_settable(flight, window, every):
    estimator = OnlineEstimator(LAGGED, window=window, every=every)
    estimates = feed(estimator, synthetic.samples(flight)[: 5 * 250])  # five signals
    assert len(estimates) == pytest.approx(250 / every, abs=2)
    assert max(e.samples for e in estimates) == window
    within(estimator.finish(), "mass", TRUTH.mass)


def test_updates_rarer_than_the_tape_is_long(flight):
    """Rows fall off the tape before an update is due; nothing is written beyond its end, and the last window counts.

    With frequent updates the tape is shifted many times over.
    """
    rare, often = (OnlineEstimator(LAGGED, window=60, every=every) for every in (20_000, 5))
    assert feed(rare, synthetic.samples(flight)) == []
    estimates = feed(often, synthetic.samples(flight))
    assert estimates[-1].samples == 60
    assert all(np.isfinite(e["mass"].value) for e in estimates)
    one, other = rare.finish(), often.finish()
    assert one.samples == 60
    assert one["mass"].value == pytest.approx(other["mass"].value, abs=0.5 * other["mass"].sd)


@pytest.mark.parametrize(("arguments", "word"), [
    ({"window": 3}, "window"), ({"every": 0}, "every 0"), ({"input_signal": "throttle"}, "throttle"),
])  # fmt: skip
def test_bad_settings_give_one_sentence(arguments, word):
    with pytest.raises(UsageError, match=word) as caught:
        OnlineEstimator(LAGGED, **arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["cf2", "zhao", "cf21bl"])
def test_nothing_to_estimate_from_is_said(name):
    with pytest.raises(DataError, match="nothing to estimate from") as caught:
        OnlineEstimator(load_vehicle(name)).finish()
    assert "\n" not in str(caught.value)


def test_motor_commands_wait_for_a_battery_voltage():
    estimator = OnlineEstimator(load_vehicle("cf2"))
    for k in range(10):
        estimator.feed(Sample("motor_command", 0.01 * k, (0.6,) * 4))
        estimator.feed(Sample("position", 0.01 * k, (0.0, 0.0, 1.0)))
    with pytest.raises(DataError, match="battery voltage"):
        estimator.finish()
    assert estimator.counters.unpowered == 10


def mixed(wrench, arm, torque_per_thrust):
    """Forces of the rotors for a wrench, as the firmware mixes them (n, 4) -> (n, 4)."""
    f, x, y, z = (wrench / [4, 4 * arm[1], 4 * arm[0], 4 * torque_per_thrust]).T
    return np.stack([f - x - y - z, f - x + y + z, f + x + y - z, f + x - y + z], 1)


def test_motor_commands_with_battery_voltage(flight, plain):
    """Duty solved from the thrust curve; the drone is what commands it."""
    vehicle = load_vehicle("cf2")
    volts = np.linspace(0.5, 4.2, 3000)
    curve = np.polynomial.polynomial.polyval(volts, vehicle.thrust_curve)
    each = mixed(flight.wrench, vehicle.arm, vehicle.torque_per_thrust)
    assert each.min() > 0.02
    duty = np.interp(each, curve, volts) / 3.9
    samples = []
    for k, t in enumerate(flight.time):
        samples += [Sample("voltage", t, (3.9,)), Sample("motor_command", t, tuple(duty[k]))]
        samples += [Sample(n, t, tuple(flight.y[k, c])) for n, c in synthetic.COLUMNS.items()]
    (_, ours), reference = ended(samples, vehicle), plain[-1]
    for name in NAMES:
        assert abs(ours[name].value - reference[name].value) < 0.3 * reference[name].sd


def test_rotor_speeds_include_the_lag(flight):
    vehicle = replace(load_vehicle("cf21bl"), mass=0.03)
    each = mixed(flight.fine_acting[::10], vehicle.arm, vehicle.torque_per_thrust)
    speed = np.sqrt(each / vehicle.rotor_constant)
    samples = []
    for k, t in enumerate(flight.time):
        samples.append(Sample("rotor_speed", t, tuple(speed[k])))
        samples += [Sample(n, t, tuple(flight.y[k, c])) for n, c in synthetic.COLUMNS.items()]
    _, final = ended(samples, vehicle)
    for name in NAMES:
        within(final, name, TRUE[name])
    assert not final["motor_time_constant"].identifiable
    assert "lag" in final["motor_time_constant"].reason


# The paper's drone: thrust and torque as inputs, no lag, logged at 200 Hz
ZHAO = synthetic.Truth(mass=0.18, inertia=(2.5e-4, 3.1e-4, 2.0e-4), lag=0.0, force_noise=5e-3, torque_noise=5e-5,
                       dither=3e-3)  # fmt: skip


def test_cold_start_on_the_drone_of_the_paper():
    """What a warm start gives, too."""
    flight = synthetic.fly(ZHAO, seed=4, duration=4.0, rate=100, sub=10, control_every=10)
    cold = OnlineEstimator(load_vehicle("zhao"), mass=0.001, inertia=(1e-4, 2e-4, 1e-4), every=25)
    warm = OnlineEstimator(load_vehicle("zhao"), every=25)
    for estimator in (cold, warm):
        feed(estimator, synthetic.samples(flight))
    final, other = cold.finish(), warm.finish()
    for name, true in zip(NAMES, (ZHAO.mass, *ZHAO.inertia)):
        within(final, name, true)
        assert final[name].value == pytest.approx(true, rel=0.1)
        assert final[name].identifiable
        assert abs(final[name].value - other[name].value) < 0.3 * other[name].sd
    assert final["motor_time_constant"].value == 0.0
    assert not final["motor_time_constant"].identifiable


def test_products_of_inertia_of_the_vehicle_file_are_used():
    """With the true products fixed the moments come out right; without them they are off by their coupling at most."""
    truth = replace(TRUTH, inertia=(2.0e-5, 2.1e-5, 3.6e-5, 2e-6, -1e-6, 1e-6))
    flight = synthetic.fly(truth, seed=6, duration=5.0)
    _, final = ended(synthetic.samples(flight), replace(LAGGED, inertia_products=truth.inertia[3:]))
    for name, true in zip(NAMES, (truth.mass, *truth.inertia[:3])):
        within(final, name, true)


def test_an_estimate_is_printed_and_serialised(plain):
    final = plain[1][20]
    text = str(final)
    for name in (*NAMES, "motor_time_constant"):
        assert name in text
        entry = final.to_json()[name]
        assert set(entry) == {"value", "sd", "ci95", "unit", "identifiable", "reason"}
        assert bool(entry["reason"]) != entry["identifiable"]


def test_what_has_not_converged_is_refined_after_one_two_four_updates(flight, monkeypatch):
    """An estimate that fails its score test is refined soon; one that always fails costs little."""
    estimator, full = OnlineEstimator(LAGGED), []
    converge = WindowEM.converge

    def never(em, first, last, **settings):
        full.append(estimator._updates)
        information = converge(em, first, last, **settings)
        return replace(information, decrement=1.0) if last > 260 else information

    monkeypatch.setattr(WindowEM, "converge", never)
    monkeypatch.setattr(OnlineEstimator, "_moved", lambda self, em: False)
    feed(estimator, synthetic.samples(flight))
    late = [n for n in full if n >= 72]  # the first beyond row 260; every 12th is full in any case
    assert late[:8] == [72, 73, 75, 79, 84, 96, 108, 120]


def test_one_of_many_makes_fewer_full_passes_and_says_nearly_the_same(flight):
    """Full passes when the estimate is out, and rarer: what they would change is less than what is not known."""
    samples = synthetic.samples(flight)
    alone, shared, again = (OnlineEstimator(LAGGED, window=250) for _ in range(3))
    for one in (shared, again):
        one.share_computer(100)
    estimates, others, repeated = feed(alone, samples), feed(shared, samples), feed(again, samples[:1500])
    young = 200 // 4  # updates of a young window are full for everyone
    assert shared.full_updates - young < 0.5 * (alone.full_updates - young)
    assert [e.time for e in estimates] == [e.time for e in others]
    assert all(same(a, b) for a, b in zip(others, repeated))
    pairs = list(zip(estimates[64:], others[64:], strict=True))  # the window is full
    for name in NAMES:
        apart = np.array([(a[name].value - b[name].value) / a[name].sd for a, b in pairs])
        assert np.sqrt(np.mean(apart**2)) < 0.4
        assert np.abs(apart).max() < 1.0
        assert all(0.5 < b[name].sd / a[name].sd < 2.0 for a, b in pairs)  # of the last full passes each
    # the last passes are made whatever was owed
    final, other = alone.finish(), shared.finish()
    for name in NAMES:
        assert other[name].value == pytest.approx(final[name].value, abs=0.05 * final[name].sd)


# -- absurd samples, logs that begin anywhere --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "line", ["mass = inf", "mass = 0.03\nrotor_constant = inf\narm = 0.03\ntorque_per_thrust = 0.007"]
)
def test_infinite_constants_are_malformed(line):
    with pytest.raises(FileFormatError):
        parse_vehicle(f'name = "a"\n{line}\ninertia = [1e-5, 1e-5, 1e-5]')


@pytest.mark.parametrize(
    ("signal", "value"),
    [("attitude", (0.0, 0.0, 0.0, 0.0)), ("body_rate", (1e30, 0.0, 0.0)), ("position", (1e200, 0.0, 0.0))],
)
def test_one_absurd_sample_does_not_end_the_flight(signal, value):
    estimator = OnlineEstimator(LAGGED, every=25)
    for s in synthetic.samples(synthetic.fly(seed=11, duration=2.0)):
        estimator.feed(replace(s, value=value) if s.signal == signal and abs(s.time - 1.5) < 1e-6 else s)
    final = estimator.finish()
    assert all(np.isfinite(p.value) for p in final.parameters.values())


@pytest.mark.slow
def test_a_log_that_begins_amid_a_manoeuvre_is_not_biased():
    z = []
    for seed in range(6):
        estimator = OnlineEstimator(LAGGED, every=40)
        for s in synthetic.samples(synthetic.fly(replace(TRUTH, fade=0.0, sensor=(1e-3, 1e-2, 1e-3, 2e-3)), seed=seed)):
            estimator.feed(s)
        final = estimator.finish()
        z.append([(final[n].value - t) / final[n].sd for n, t in zip(("Ixx", "Iyy", "Izz"), TRUTH.inertia)])
    assert np.all(np.abs(np.mean(z, 0)) < 1.2), np.mean(z, 0)  # sd of the mean 0.41


@pytest.mark.slow
def test_commands_stamped_between_the_measurements_under_noisy_control():
    hits = 0
    for seed in range(8):
        flight = synthetic.fly(TRUTH, seed=seed)
        estimator = OnlineEstimator(LAGGED, every=40)
        for row in range(0, len(flight.fine_time) - 10, 10):
            for n, c in synthetic.COLUMNS.items():
                estimator.feed(Sample(n, flight.fine_time[row], tuple(flight.fine_y[row][c])))
            estimator.feed(Sample("wrench_command", flight.fine_time[row + 2], tuple(flight.fine_wrench[row + 2])))
        p = estimator.finish()["Ixx"]
        hits += p.ci95[0] <= 2e-5 <= p.ci95[1]
    assert hits >= 6, hits  # 5 of 8 or fewer has probability 0.006 at 95 %
