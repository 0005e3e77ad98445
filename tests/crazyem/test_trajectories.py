"""Trajectories: derivatives against finite differences, rest at the ends, the excitation's spectrum, waypoint files."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.control.named_trajectories import waypoints
from crazyem.control.trajectories import EXCITE_X, EXCITE_Y, EXCITE_YAW, EXCITE_Z, excite, figure8, hover, smooth_step
from crazyem.errors import FileFormatError, UsageError

HOME = (0.2, -0.1, 1.0)


def way(tmp_path, text="x,y,z,yaw\n0.5,0,1,0\n0.5,0.8,1.3,1.0\n0,0,1,0.5\n", name="w.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


def make(name, tmp_path, duration):
    if name == "waypoints":
        return waypoints(path=way(tmp_path), position=HOME, yaw=0.3)
    kind = {"hover": hover, "figure8": figure8, "excite": excite}[name]
    return kind(position=HOME, yaw=0.3, duration=duration)


@pytest.mark.parametrize("name", ["hover", "figure8", "excite", "waypoints"])
def test_derivatives_match_finite_differences_and_ends_rest(name, tmp_path):
    trajectory = make(name, tmp_path, 12.0)
    h = 1e-5
    for t in np.linspace(0.01, trajectory.duration - 0.01, 97):
        lo, mid, hi = trajectory.at(t - h), trajectory.at(t), trajectory.at(t + h)
        for lower, upper in (("position", "velocity"), ("velocity", "acceleration"), ("acceleration", "jerk")):
            slope = (np.array(getattr(hi, lower)) - np.array(getattr(lo, lower))) / (2 * h)
            np.testing.assert_allclose(getattr(mid, upper), slope, atol=2e-3)
        assert mid.yaw_rate == pytest.approx((hi.yaw - lo.yaw) / (2 * h), abs=1e-5)
    for t in (-1.0, 0.0, trajectory.duration, trajectory.duration + 5):
        r = trajectory.at(t)
        np.testing.assert_allclose(r.velocity + r.acceleration + (r.yaw_rate,), 0, atol=1e-6)
    np.testing.assert_allclose(trajectory.at(0.0).position, HOME, atol=1e-9)


@given(st.floats(0, 1))
def test_smooth_step_is_symmetric_and_monotone(x):
    v, d, _, _ = smooth_step(x)
    assert 0 <= v <= 1 + 1e-12
    assert d >= 0
    assert v + smooth_step(1 - x)[0] == pytest.approx(1, abs=1e-9)


def test_excitation_has_the_asked_power_and_uncorrelated_axes():
    trajectory = excite(position=HOME, duration=30.0, lateral=0.45, vertical=0.5)
    t = np.arange(2.0, 28.0, 0.01)
    refs = [trajectory.at(x) for x in t]
    a = np.array([r.acceleration for r in refs])
    yaw = np.array([r.yaw for r in refs])
    np.testing.assert_allclose(a.std(axis=0), [0.45, 0.45, 0.5], rtol=0.07)
    assert 0.01 < yaw.std() < 0.1
    assert np.abs(a).max() < 3.0
    for start in range(0, len(t) - 800, 200):  # every estimator window of 8 s
        c = np.corrcoef(a[start : start + 800].T)
        assert np.abs(c - np.eye(3)).max() < 0.2
    assert np.abs(np.array([r.position for r in refs]) - HOME).max() < 0.12


def test_no_two_axes_share_a_line():
    lines = sorted(EXCITE_X + EXCITE_Y + EXCITE_Z + EXCITE_YAW)
    assert min(np.diff(lines)) > 0.05


@given(st.floats(-2, 2), st.floats(0.5, 40.0))
def test_they_stay_finite_and_end_where_they_began_for_any_duration(yaw, duration):
    for kind in (hover, excite, figure8):
        trajectory = kind(position=HOME, yaw=yaw, duration=duration)
        for t in np.linspace(-0.1, duration + 0.1, 7):
            r = trajectory.at(float(t))
            assert all(math.isfinite(v) for v in r.position + r.velocity + r.acceleration)
            assert np.linalg.norm(r.quaternion) == pytest.approx(1)
        np.testing.assert_allclose(trajectory.at(trajectory.duration).position, HOME, atol=1e-9)
        assert trajectory.at(trajectory.duration).yaw == pytest.approx(yaw, abs=1e-9)


@given(st.floats(0.5, 60.0), st.floats(1.0, 8.0), st.floats(0.2, 5.0))
def test_a_figure_8_is_whole_and_ends_at_rest_where_it_began(duration, period, ramp):
    trajectory = figure8(position=HOME, yaw=0.3, duration=duration, period=period, ramp=ramp)
    assert abs(trajectory.duration - duration) <= period / 2 + 1e-9 or trajectory.duration == period + min(ramp, period)
    end = trajectory.at(trajectory.duration)
    np.testing.assert_allclose(end.velocity + end.acceleration, 0, atol=1e-6)
    # whole figures: as much time on either side
    x = [trajectory.at(t).position[0] - HOME[0] for t in np.linspace(0.0, trajectory.duration, 4001)]
    assert sum(v > 1e-3 for v in x) == pytest.approx(sum(v < -1e-3 for v in x), rel=0.02)


def test_waypoints_pass_through_points_at_their_times(tmp_path):
    path = way(tmp_path, "x,y,z,time\n0.5,0,1,3\n0.5,0.8,1.3,6\n0,0,1,9.5\n")
    trajectory = waypoints(path=path, position=HOME)
    assert trajectory.duration == pytest.approx(9.5)
    np.testing.assert_allclose(trajectory.at(6.0).position, (0.5, 0.8, 1.3), atol=1e-9)


def test_waypoints_from_toml(tmp_path):
    text = "[[waypoints]]\nx = 1.0\ny = 0.0\nz = 1.0\nspeed = 0.4\n"
    trajectory = waypoints(path=way(tmp_path, text, "w.toml"), position=HOME)
    np.testing.assert_allclose(trajectory.at(trajectory.duration).position, (1, 0, 1), atol=1e-9)


@pytest.mark.parametrize(
    ("text", "name", "says"),
    [
        ("x,y\n1,2\n", "w.csv", "'z' is missing"),
        ("x,y,z\n1,2,up\n", "w.csv", "'z' is not a number"),
        ("x,y,z\n1,2,nan\n", "w.csv", "'z' is not a number"),
        ("x,y,z,roll\n1,2,1,0\n", "w.csv", "unknown column 'roll'"),
        ("x,y,z\n", "w.csv", "no waypoints"),
        ("x,y,z\n0,0,-1\n", "w.csv", "out of range"),
        ("x,y,z,time\n0,0,1,2\n1,0,1,1\n", "w.csv", "do not increase"),
        ("x,y,z,time\n9,0,1,0.5\n0,0,1,1\n", "w.csv", "m/s"),
        ("x,y,z,speed\n1,0,1,-1\n", "w.csv", "'speed' must be positive"),
        ("x = ", "w.toml", "not valid TOML"),
        ("x = 1", "w.toml", "waypoints"),
    ],
)
def test_bad_waypoint_files_are_named(tmp_path, text, name, says):
    path = way(tmp_path, text, name)
    with pytest.raises(FileFormatError, match=r"w\.(csv|toml)") as e:
        waypoints(path=path, position=HOME)
    assert says in str(e.value)


def test_missing_waypoint_file(tmp_path):
    with pytest.raises(UsageError, match="cannot read"):
        waypoints(path=tmp_path / "none.csv", position=HOME)
