"""Several drones before they fly: swarm files, names, offsets from a trajectory, distances."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyem.commands import swarm as command
from crazyem.control.trajectories import Reference, Trajectory, figure8, hover
from crazyem.errors import FileFormatError, UsageError
from crazyem.live.swarm import CLOSEST_DISTANCE, Course, check_distances, members_of, read_swarm, with_offset


# files
def read(tmp_path, text):
    path = tmp_path / "swarm.toml"
    path.write_text(text)
    return read_swarm(path, vehicle="cf2", trajectory=("hover",))


def test_a_swarm_file_says_what_differs_from_the_command_line(tmp_path):
    (tmp_path / "mine.toml").write_text("")
    a, b, c = read(
        tmp_path,
        '[[drone]]\nname = "alpha"\nuri = "udp://h:1"\nvehicle = "mine.toml"\ntrajectory = "figure8"\n'
        'offset = [0.5, -1, 0]\n[[drone]]\nuri = "udp://h:2"\ntrajectory = ["waypoints", "p.csv"]\n'
        '[[drone]]\nuri = "udp://h:3"\nvehicle = "cf21bl"\n',
    )
    assert (a.name, a.uri, a.vehicle) == ("alpha", "udp://h:1", str(tmp_path / "mine.toml"))
    assert (a.trajectory, a.offset) == (("figure8",), (0.5, -1.0, 0.0))
    assert (b.name, b.vehicle, b.trajectory) == ("drone1", "cf2", ("waypoints", str(tmp_path / "p.csv")))
    assert (c.name, c.vehicle, c.trajectory, c.offset) == ("drone2", "cf21bl", ("hover",), (0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "at least one"),
        ("drone = 1", "at least one"),
        ("a = 1\n[[drone]]\nuri = 'u'", "a is not part"),
        ("[[drone]]", "drone 0: uri is missing"),
        ("[[drone]]\nuri = 3", "drone 0: uri must be a text"),
        ("[[drone]]\nuri = ''", "drone 0: uri must be a text"),
        ("[[drone]]\nuri = 'u'\nspeed = 1", "speed is not a key"),
        ("[[drone]]\nuri = 'u'\nname = '../../etc/x'", "name must be 1 to 40"),
        ("[[drone]]\nuri = 'u'\nname = '" + "x" * 41 + "'", "name must be 1 to 40"),
        ("[[drone]]\nuri = 'u'\noffset = [1, 2]", "offset must be 3 numbers"),
        ("[[drone]]\nuri = 'u'\noffset = [1, 2, nan]", "offset must lie between"),
        ("[[drone]]\nuri = 'u'\noffset = [1, 2, true]", "offset must lie between"),
        ("[[drone]]\nuri = 'u'\noffset = [1, 2, 21]", "offset must lie between"),
        ("[[drone]]\nuri = 'u'\ntrajectory = []", "trajectory must be"),
        ("[[drone]]\nuri = 'u'\ntrajectory = 4", "trajectory must be"),
        ("[[drone]]\nuri = 'u'\n" * 2, "two drones have the uri u"),
        ("[[drone]]\nuri = 'u'\nname = 'a'\n[[drone]]\nuri = 'v'\nname = 'a'", "two drones have the name a"),
        ("".join(f"[[drone]]\nuri = '{i}'\n" for i in range(101)), "at most 100"),
        ("[[drone", "not valid TOML"),
        ("x = " + "[" * 5000, "not valid TOML"),
    ],
)
def test_wrong_swarm_files_are_named_with_drone_and_key(tmp_path, text, says):
    with pytest.raises(FileFormatError, match=r"swarm\.toml") as caught:
        read(tmp_path, text)
    assert says in str(caught.value)


def test_drones_of_the_command_line_have_numbers_and_are_given_once():
    many = members_of(["udp://h:1", "udp://h:2"], vehicle="cf2", trajectory=["figure8"])
    assert [m.name for m in many] == ["drone0", "drone1"]
    with pytest.raises(UsageError, match="given twice"):
        members_of(["udp://h:1", "udp://h:1"], vehicle="cf2", trajectory=["hover"])
    with pytest.raises(UsageError, match="at most 100"):
        members_of([f"udp://h:{i}" for i in range(101)], vehicle="cf2", trajectory=["hover"])


@pytest.mark.parametrize(
    ("base", "expected"),
    [
        ("f.mcap", "f.a.mcap"), ("x/f.csv.gz", "x/f.a.csv.gz"), ("f", "f.a"), ("f.b.png", "f.b.a.png"),
        (".mcap", ".mcap.a"), (None, None),
    ],
)  # fmt: skip
def test_files_get_the_drones_name(base, expected):
    assert command.path_for(base, "a") == expected


# ways and distances
OFFSETS = st.tuples(*[st.floats(-5, 5, allow_nan=False).map(lambda v: round(v, 3))] * 3)


@given(OFFSETS)
def test_the_way_to_an_offset_is_smooth_and_joins_the_trajectory(offset):
    make = with_offset(lambda p, yaw: figure8(position=p, yaw=yaw, duration=6.0), offset)
    path = make((1.0, 2.0, 3.0), 0.3)
    extra = path.duration - figure8(position=(0.0, 0.0, 0.0), duration=6.0).duration
    assert path.at(0.0).position == pytest.approx((1.0, 2.0, 3.0))
    assert path.at(extra).position == pytest.approx([p + o for p, o in zip((1.0, 2.0, 3.0), offset)])
    h = 1e-4
    for t in np.linspace(0.05, path.duration - 0.05, 23):
        before, now, after = (path.at(t + d) for d in (-h, 0.0, h))
        slope = (np.array(after.position) - before.position) / (2 * h)
        assert np.allclose(slope, now.velocity, atol=2e-5)
        slope = (np.array(after.velocity) - before.velocity) / (2 * h)
        assert np.allclose(slope, now.acceleration, atol=2e-3)
        assert np.linalg.norm(now.acceleration) < 9.81
        assert now.yaw == 0.3


def test_no_offset_changes_nothing():
    def make(position, yaw):
        return hover(position=position, yaw=yaw)

    assert with_offset(make, (0.0, 0.0, 0.0)) is make


def course(x, y=0.0, path=None, begin=None):
    above = (x, y, 1.0)
    return Course((x, y, 0.0), begin or above, path or hover(position=above))


def test_drones_that_are_far_enough_apart_may_fly():
    check_distances({"a": course(0.0), "b": course(CLOSEST_DISTANCE + 0.01), "c": course(0.0, 1.0)})
    check_distances({"a": course(0.0)})
    check_distances({})


@pytest.mark.parametrize(
    ("courses", "says"),
    [
        ({"a": course(0.0), "b": course(0.2)}, "a and b stand 0.20 m apart"),
        ({"a": course(0.0), "b": course(math.nan)}, "a and b stand nan m apart"),
        ({"a": course(0.0), "b": course(1.0, begin=(0.0, 0.1, 1.0))}, "a and b begin 0.10 m apart"),
    ],
)
def test_drones_that_are_too_close_are_named(courses, says):
    with pytest.raises(UsageError, match="not flown") as caught:
        check_distances(courses)
    assert says in str(caught.value)


def test_paths_that_cross_at_the_same_time_are_refused_and_at_other_times_not():
    def line(sign, delay=0.0):
        return Trajectory("line", 10.0, lambda t: Reference((sign * (1.0 - 0.2 * max(t - delay, 0.0)), 0.0, 1.0)))

    with pytest.raises(UsageError, match=r"within 0\.0\d m of each other 5\.0 s"):
        check_distances({"a": course(1.0, path=line(1)), "b": course(-1.0, path=line(-1))})
    beside = Trajectory("line", 10.0, lambda t: Reference((-1.0 + 0.2 * t, 0.4, 1.0)))
    check_distances({"a": course(1.0, path=line(1)), "b": course(-1.0, 0.4, path=beside)})
