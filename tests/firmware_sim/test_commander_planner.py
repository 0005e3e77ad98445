"""The planner of high-level commands, against closed forms."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import polynomial as npoly

from firmware_sim.commander import polynomials as poly
from firmware_sim.commander.planner import Planner, PlannerState

small = st.floats(-3.0, 3.0)
durations = st.floats(0.5, 8.0)


@given(durations, st.tuples(small, small, small), st.tuples(small, small, small))
def test_a_seventh_order_segment_meets_both_ends_without_jerk(duration, start, end):
    p = poly.seventh_order(duration, start, end)
    for t, wanted in ((0.0, start), (duration, end)):
        derivatives = [npoly.polyval(t, npoly.polyder(p, n)) for n in range(4)]
        np.testing.assert_allclose(derivatives[:3], wanted, atol=1e-8)
        assert abs(derivatives[3]) < 1e-6


@given(st.lists(small, min_size=8, max_size=8), st.floats(0.0, 2.0))
def test_derivatives_agree_with_numpy(coefficients, t):
    wanted = [npoly.polyval(t, npoly.polyder(coefficients, n)) for n in range(4)]
    np.testing.assert_allclose(poly.derivatives(tuple(coefficients), t), wanted, rtol=1e-9, atol=1e-7)


pieces = st.builds(
    lambda c, d: poly.Piece((tuple(c[0:8]), tuple(c[8:16]), tuple(c[16:24]), tuple(c[24:32])), d),
    st.lists(st.floats(-1.0, 1.0), min_size=32, max_size=32),
    st.floats(0.3, 2.0),
)


@given(pieces, st.floats(0.0, 1.0), st.floats(0.5, 3.0))
def test_reversing_and_stretching_keep_the_path(piece, fraction, scale):
    there = poly.evaluate(piece, fraction * piece.duration)
    back = poly.evaluate(poly.reversed_piece(piece), (1.0 - fraction) * piece.duration)
    np.testing.assert_allclose(back.position, there.position, atol=1e-6)
    np.testing.assert_allclose(back.velocity, -np.array(there.velocity), atol=1e-5)
    slow = poly.evaluate(poly.stretched(piece, scale), fraction * piece.duration * scale)
    np.testing.assert_allclose(slow.position, there.position, atol=1e-6)
    np.testing.assert_allclose(slow.velocity, np.array(there.velocity) / scale, atol=1e-6)


def test_body_rates_are_those_of_the_flat_attitude():
    """omega from finite differences of the rotation matrix that the acceleration and the yaw imply."""
    piece = poly.Piece(
        (
            (0.0, 0.3, 0.5, -0.4, 0.1, 0.0, 0.0, 0.0),
            (0.1, -0.2, 0.3, 0.3, 0.0, 0.05, 0.0, 0.0),
            (1.0, 0.0, 0.2, -0.1, 0.0, 0.0, 0.0, 0.0),
            (0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        ),
        1.0,
    )

    def rotation(t):
        e = poly.evaluate(piece, t)
        z = np.add(e.acceleration, (0.0, 0.0, 9.81))
        z /= np.linalg.norm(z)
        y = np.cross(z, [math.cos(e.yaw), math.sin(e.yaw), 0.0])
        y /= np.linalg.norm(y)
        return np.column_stack([np.cross(y, z), y, z])

    h = 1e-5
    spin = rotation(0.5).T @ (rotation(0.5 + h) - rotation(0.5 - h)) / (2.0 * h)
    omega = poly.evaluate(piece, 0.5).omega
    np.testing.assert_allclose(omega[:2], [spin[2, 1], spin[0, 2]], atol=1e-6)


def planner_at(position=(0.5, -0.5, 0.0), yaw=0.3):
    planner = Planner()
    planner.set_state(position, (0.0, 0.0, 0.0), yaw)
    return planner


def test_takeoff_land_and_motors_off_at_the_end():
    planner = planner_at()
    assert planner.goal(0.0) is None
    assert planner.finished(0.0)
    assert planner.takeoff(1.0, None, 2.0, 10.0) == 0
    assert planner.takeoff(1.0, None, 2.0, 10.0) == 1  # already flying
    middle = planner.goal(11.0)
    assert middle.position == pytest.approx((0.5, -0.5, 0.5))
    assert middle.yaw == pytest.approx(0.3)
    assert not planner.finished(11.9)
    assert planner.goal(15.0).position == pytest.approx((0.5, -0.5, 1.0))
    assert planner.goal(15.0).velocity == (0.0, 0.0, 0.0)
    assert planner.land(0.0, 0.0, 2.0, 15.0) == 0
    assert planner.land(0.0, 0.0, 2.0, 15.0) == 1
    assert planner.goal(16.0).position[2] == pytest.approx(0.5)
    planner.goal(17.0)
    assert planner.state == PlannerState.IDLE
    assert planner.goal(17.01) is None


def test_go_to_continues_the_motion_it_interrupts():
    planner = planner_at((0.0, 0.0, 1.0), 0.0)
    planner.go_to((2.0, 0.0, 1.0), 0.0, 2.0, 0.0)
    before = planner.goal(1.0)
    planner.go_to((0.0, 1.0, 0.0), 3.0, 2.0, 1.0, relative=True)
    after = planner.goal(1.0)
    assert after.position == pytest.approx(before.position)
    assert after.velocity == pytest.approx(before.velocity)
    assert after.acceleration == pytest.approx(before.acceleration)
    end = planner.goal(3.0)
    assert end.position == pytest.approx((before.position[0], 1.0, 1.0))
    assert end.yaw == pytest.approx(3.0)


def test_linear_go_to_keeps_its_velocity():
    planner = planner_at((0.0, 0.0, 1.0), 0.0)
    planner.go_to((2.0, -1.0, 1.0), 0.0, 4.0, 0.0, linear=True)
    for t in (0.0, 1.3, 3.9):
        assert planner.goal(t).velocity == pytest.approx((0.5, -0.25, 0.0))
        assert planner.goal(t).position == pytest.approx((0.5 * t, -0.25 * t, 1.0))


def test_yaw_turns_the_short_way():
    planner = planner_at((0.0, 0.0, 1.0), 3.0)
    planner.go_to((0.0, 0.0, 1.0), -3.0, 1.0, 0.0)
    assert planner.goal(0.5).yaw == pytest.approx(math.pi, abs=0.01)


@pytest.mark.parametrize("sideways", [False, True])
@pytest.mark.parametrize("clockwise", [False, True])
def test_a_small_spiral_is_an_arc_about_its_centre(sideways, clockwise):
    planner = planner_at((0.0, 0.0, 1.0), 0.0)
    planner.spiral(math.pi / 2, (1.0, 1.0), 0.5, 4.0, 0.0, sideways=sideways, clockwise=clockwise)
    side = 1.0 if clockwise else -1.0
    centre = np.array((side, 0.0) if sideways else (0.0, -side))
    for t in np.linspace(0.0, 4.0, 9):
        e = planner.goal(t)
        assert np.linalg.norm(np.array(e.position[:2]) - centre) == pytest.approx(1.0, abs=0.02)
        assert e.yaw == pytest.approx(-side * math.pi / 2 * t / 4.0, abs=0.02)
        assert e.position[2] == pytest.approx(1.0 + 0.125 * t, abs=0.01)
    ahead = planner.goal(0.0).velocity
    assert math.hypot(*ahead[:2]) == pytest.approx(math.pi / 8)
    if not sideways:
        assert ahead[0] == pytest.approx(math.pi / 8)  # the drone looks where it flies


def test_uploaded_trajectories_relative_turned_backwards_and_stretched():
    line = poly.Piece(((0.0, 1.0, *[0.0] * 6), (0.0,) * 8, (1.0, *[0.0] * 7), (0.0,) * 8), 2.0)
    corner = poly.Piece(((2.0, *[0.0] * 7), (0.0, 1.0, *[0.0] * 6), (1.0, *[0.0] * 7), (0.0,) * 8), 1.0)
    planner = planner_at((5.0, 5.0, 3.0), math.pi / 2)
    planner.start_trajectory([line, corner], 0.0)
    assert planner.goal(2.5).position == pytest.approx((2.0, 0.5, 1.0))
    assert planner.goal(9.0).position == pytest.approx((2.0, 1.0, 1.0))

    planner = planner_at((5.0, 5.0, 3.0), math.pi / 2)
    planner.start_trajectory([line, corner], 0.0, timescale=2.0, relative_position=True, relative_yaw=True)
    assert planner.goal(0.0).position == pytest.approx((5.0, 5.0, 3.0))
    end = planner.goal(6.0)
    assert end.position == pytest.approx((4.0, 7.0, 3.0))
    assert end.yaw == pytest.approx(math.pi / 2)
    assert not planner.finished(5.99)
    assert planner.finished(6.0)

    planner.start_trajectory([line, corner], 0.0, backwards=True)
    assert planner.goal(0.0).position == pytest.approx((2.0, 1.0, 1.0))
    assert planner.goal(3.0).position == pytest.approx((0.0, 0.0, 1.0))


def test_poly4d_memory():
    values = [float(n) for n in range(33)]
    memory = bytes(132) + struct.pack("<33f", *values)
    (piece,) = poly.unpack_poly4d(memory, 132, 1)
    assert piece.duration == 32.0
    assert piece.polynomials[3] == tuple(values[24:32])
    with pytest.raises(ValueError, match="past"):
        poly.unpack_poly4d(memory, 133, 1)


def test_compressed_trajectories_decode_what_cflib_encodes():
    trajectory_memory = pytest.importorskip("cflib.crazyflie.mem.trajectory_memory")
    start = trajectory_memory.CompressedStart(0.0, 1.0, 0.5, 0.0)
    bezier = [0.1, 0.4, 0.9]
    segment = trajectory_memory.CompressedSegment(2.0, [1.0], bezier, [], [math.radians(90.0)])
    memory = bytes(start.pack() + segment.pack() + b"\0\0\0")
    (piece,) = poly.unpack_compressed(memory, 0)
    end = poly.evaluate(piece, 2.0)
    assert end.position == pytest.approx((1.0, 0.9, 0.5))
    assert end.yaw == pytest.approx(math.pi / 2, abs=0.002)
    control = np.array([1.0, *bezier])
    s = 0.35  # de Casteljau by hand
    for _ in range(3):
        control = (1 - s) * control[:-1] + s * control[1:]
    assert poly.evaluate(piece, 2.0 * s).position[1] == pytest.approx(control[0], abs=1e-9)
    with pytest.raises(ValueError, match="past"):
        poly.unpack_compressed(memory[:-2], 0)
