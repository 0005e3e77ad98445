"""What once went wrong and must not again: absurd samples, logs that begin anywhere, commands that nobody can know."""

import math
from dataclasses import replace

import numpy as np
import pytest
import synthetic

from crazyem.errors import FileFormatError
from crazyem.estimation.online import OnlineEstimator
from crazyem.signals.sample import Sample
from crazyem.vehicle import load_vehicle, parse_vehicle

LAGGED = replace(load_vehicle("cf2"), thrust_curve=(), rotor_constant=None, thrust_max=math.inf)
TRUTH = synthetic.Truth()


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
