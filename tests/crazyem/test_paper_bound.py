"""The Cramer-Rao bound: against a slow plain filter, closed forms, and the scatter of the score over flights."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from made_paper import plain_motion

from crazyem.errors import UsageError
from crazyem.paper.bound import PARAMETERS, PROCESS_NOISES, SENSORS, START_SD, bound, observed
from crazyem.paper.flight import Flight, fly
from crazyem.paper.settings import Settings

GRAVITY = 9.81


@pytest.fixture(scope="module")
def flight() -> Flight:
    return fly(Settings(duration=8.0), 3)


# a slow plain form: matrices, numerical Jacobians, the disturbance as part of the state ---------------------------


def jacobian(function, at, step=1e-6):
    columns = [(function(at + step * d) - function(at - step * d)) / (2 * step) for d in np.eye(len(at))]
    return np.array(columns).T


def plain_innovations(y, wrench, x, dt, values):
    """Lists of innovation vectors and their covariance matrices."""
    mass, inertia, process, sd = values[0], values[1:4], values[4:8], values[8:13]
    r = np.diag(np.repeat(sd[:4], 3) ** 2)
    p = np.diag(START_SD**2)
    h_all = np.eye(12)
    out = []
    for k in range(len(y)):
        if k:
            noise, q = np.zeros(4), np.diag(process**2 / dt)
            u = wrench[k - 1]
            if not np.isnan(y[k, 12]):
                h = np.zeros((3, 4))
                h[2, 0] = 1 / mass
                s = h @ q @ h.T + sd[4] ** 2 * np.eye(3)
                e = y[k, 12:] - [0, 0, u[0] / mass]
                gain = q @ h.T @ np.linalg.inv(s)
                noise, q = gain @ e, q - gain @ h @ q
                out.append((e, s))
            phi = jacobian(lambda v, u=u, n=noise: plain_motion(v, u, n, dt, mass, inertia), x)
            g = jacobian(lambda n, u=u, v=x: plain_motion(v, u, n, dt, mass, inertia), noise)
            x = plain_motion(x, u, noise, dt, mass, inertia)
            p = phi @ p @ phi.T + g @ q @ g.T
        seen = ~np.isnan(y[k, :12])
        h = h_all[seen]
        s = h @ p @ h.T + r[np.ix_(seen, seen)]
        e = y[k, :12][seen] - x[seen]
        gain = p @ h.T @ np.linalg.inv(s)
        x, p = x + gain @ e, p - gain @ h @ p
        out.append((e, s))
    return out


def plain_information(flight, sensor, first, last, names):
    s = flight.settings
    y, wrench = observed(flight, sensor, first, last), flight.wrench[first:last]
    sds = [s.position_sd, s.velocity_sd, s.attitude_sd, s.body_rate_sd, s.acceleration_sd]
    truth = np.array([s.mass, *s.inertia, s.force_noise, *[s.torque_noise] * 3, *sds])
    everything = [*PARAMETERS, *PROCESS_NOISES, *SENSORS]
    step = 1e-4
    middle = plain_innovations(y, wrench, flight.truth[first].copy(), s.dt, truth)
    slopes = []
    for name in names:
        factor = np.exp(step * (np.array(everything) == name))
        up = plain_innovations(y, wrench, flight.truth[first].copy(), s.dt, truth * factor)
        down = plain_innovations(y, wrench, flight.truth[first].copy(), s.dt, truth / factor)
        slopes.append([((a - c) / (2 * step), (b - d) / (2 * step)) for (a, b), (c, d) in zip(up, down)])
    information = np.zeros((len(names), len(names)))
    score = np.zeros(len(names))
    for k, (e, cov) in enumerate(middle):
        inverse = np.linalg.inv(cov)
        for i in range(len(names)):
            de, ds = slopes[i][k]
            score[i] -= de @ inverse @ e + 0.5 * np.trace(inverse @ ds) - 0.5 * e @ inverse @ ds @ inverse @ e
            for j in range(len(names)):
                de2, ds2 = slopes[j][k]
                information[i, j] += de @ inverse @ de2 + 0.5 * np.trace(inverse @ ds @ inverse @ ds2)
    return information, score


@pytest.mark.parametrize("sensor", "ABC")
def test_bound_is_that_of_a_plain_filter(flight, sensor):
    first, last = 184, 194  # the middle of a turn, away from level
    found = bound(flight, sensor, first, last)
    information, score = plain_information(flight, sensor, first, last, found.names)
    scale = np.sqrt(np.outer(np.diag(information), np.diag(information)))
    assert np.max(np.abs(found.information - information) / scale) < 1e-4
    assert np.max(np.abs(found.score - score) / np.sqrt(np.diag(information))) < 1e-3


# closed forms -----------------------------------------------------------------------------------------------------


def hover(**changes) -> Flight:
    start = (0.0, 0.0, 1.0)
    return fly(Settings(start=start, waypoints=(start,), duration=4.0, **changes), 5)


@pytest.mark.parametrize("sensor", "ABC")
def test_mass_in_hover_is_known_to_the_impulse_of_the_noise_over_that_of_the_weight(sensor):
    flight = hover()
    s = flight.settings
    expected = s.force_noise / (s.mass * GRAVITY * np.sqrt(s.duration))
    assert bound(flight, sensor).sd[0] == pytest.approx(expected, rel=0.02)


def test_inertia_with_perfect_sensors_is_known_from_the_torque_and_from_the_size_of_the_scatter():
    exact = dict.fromkeys(["position_sd", "velocity_sd", "attitude_sd", "body_rate_sd"], 1e-5)
    flight = hover()
    seen = replace(flight.settings, **exact)
    flight.settings = seen  # the flight as it was, but read without noise
    flight.readings[:, :12] = flight.truth
    found = bound(flight, "B")
    steps = flight.size - 1
    power = np.sum(flight.wrench[:-1, 1:] ** 2, 0) * seen.dt / seen.torque_noise**2
    assert found.sd[1:] == pytest.approx(1 / np.sqrt(power), rel=0.02)
    assert found.under("known").sd[1:] == pytest.approx(1 / np.sqrt(power + 2 * steps), rel=0.02)


# the score ----------------------------------------------------------------------------------------------------------


# what is known helps -----------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 50), sensor=st.sampled_from("ABC"), first=st.integers(0, 700), length=st.integers(120, 800))
@hypothesis_settings(max_examples=8)
def test_more_data_and_more_knowledge_never_hurt(seed, sensor, first, length):
    flight = fly(Settings(duration=8.0), seed)
    found = bound(flight, sensor, first, first + length)
    assert np.all(np.linalg.eigvalsh(found.information) > 0)
    assert np.all(np.isfinite(found.sd))
    sds = [found.sd, found.under("single").sd, found.under("known").sd]
    for more, less in zip(sds[1:], sds):
        assert np.all(more <= less * (1 + 1e-6))
    # more rows: information is a sum over rows
    longer = bound(flight, sensor, first, first + length + 60)
    assert np.all(np.linalg.eigvalsh(longer.information - found.information) > -1e-6 * np.max(found.information))


def test_an_accelerometer_helps_the_mass_and_hardly_the_inertia(flight):
    with_it = bound(flight, "A", 0, 800).sd
    without = bound(flight, "A", 0, 800, accelerometer=False).sd
    assert 0.85 < with_it[0] / without[0] < 0.97
    assert with_it[1:] == pytest.approx(without[1:], rel=1e-2)


def test_missing_readings_cost_information_and_nothing_else(flight):
    whole = bound(flight, "C", 0, 400)
    holed = fly(Settings(duration=8.0), 3)
    holed.readings[100:105] = np.nan
    holed.readings[200, 0:2] = np.nan
    less = bound(holed, "C", 0, 400)
    assert np.all(np.isfinite(less.sd))
    assert np.all(less.sd > whole.sd * 0.999)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("D", 0, 100), "unknown sensor 'D'"),
        (("A", 100, 100), "rows 100 to 100"),
        (("A", -1, 100), "rows -1 to 100"),
        (("A", 0, 10**9), "not in a flight of"),
    ],
)
def test_what_does_not_exist_is_refused(flight, arguments, message):
    with pytest.raises(UsageError, match=message):
        bound(flight, *arguments)
