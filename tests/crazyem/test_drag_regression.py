"""Drag over mass by regression: samples of a motion whose drag is known."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crazyem.estimation.drag import DragRegression
from crazyem.signals.sample import Sample


def flown(drag, *, speed=1.2, yaw=0.0, wind=0.0, mounting=0.0, noise=0.0, seconds=12.0, airborne=True):
    """A Lissajous figure at heading `yaw`, nose down by the sine of 0.2; 100 Hz; what the accelerometer feels of it."""
    regression, rng = DragRegression(), np.random.default_rng(0)
    w = np.array([1.3, 2.1])
    for n in range(round(100 * seconds)):
        t = n / 100.0
        tilt = Rotation.from_euler("ZYX", [yaw, 0.2 * math.sin(w[0] * t), 0.1 * math.cos(w[1] * t)])
        p = np.array([*(speed / w * np.sin(w * t)), 1.0])
        v = np.array([*(speed * np.cos(w * t)), 0.0])
        body = tilt.inv().apply(v - np.array([wind, 0.0, 0.0]))
        force = -np.array([*drag, 0.0]) * body + [mounting, -mounting, 9.81] + noise * rng.standard_normal(3)
        for signal, value in (("position", p), ("attitude", tilt.as_quat()), ("specific_force", force)):
            regression.feed(Sample(signal, t, tuple(map(float, value))), airborne=airborne)
    return regression.estimates()


@settings(max_examples=5, deadline=None)
@given(st.floats(0.1, 1.0), st.floats(0.1, 1.0), st.floats(-3.0, 3.0))
def test_known_drag_is_found_at_any_heading(dx, dy, yaw) -> None:
    found = flown((dx, dy), yaw=yaw)
    assert [found[n].value for n in ("drag_x", "drag_y")] == pytest.approx([dx, dy], rel=0.03, abs=0.01)
    assert all(p.identifiable and p.unit == "1/s" for p in found.values())


def test_wind_at_one_heading_and_a_tilted_sensor_change_nothing() -> None:
    found = flown((0.4, 0.3), wind=0.8, mounting=0.5)
    assert [p.value for p in found.values()] == pytest.approx([0.4, 0.3], rel=0.05)


def test_the_interval_holds_the_truth_under_noise() -> None:
    found = flown((0.4, 0.3), noise=1.0, seconds=30.0)
    for p, true in zip(found.values(), (0.4, 0.3), strict=True):
        assert p.ci95[0] < true < p.ci95[1]
        assert p.sd < 0.1 * true


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"speed": 0.1}, "too small"),
        ({"seconds": 3.0}, "too few"),
        ({"airborne": False}, "too few"),
        ({"drag": (0.0, 0.0), "noise": 0.5}, "no drag is seen"),
        ({"drag": (0.02, 0.02), "noise": 2.0}, "drag is seen|uncertain"),
    ],
)
def test_what_is_not_identifiable_is_said(how, said) -> None:
    found = flown(**({"drag": (0.4, 0.3)} | how))
    assert not any(p.identifiable for p in found.values())
    for p in found.values():
        assert any(part in p.reason for part in said.split("|"))


def test_a_gap_and_a_landing_begin_a_new_span() -> None:
    """No distance is taken across them."""
    regression = DragRegression()
    for n in range(1000):
        t = n / 100.0 + (5.0 if n >= 500 else 0.0)
        x = 100.0 if n >= 500 else 0.0
        for signal, value in (("position", (x, 0.0, 1.0)), ("attitude", (0.0, 0.0, 0.0, 1.0)),
                              ("specific_force", (0.0, 0.0, 9.81))):  # fmt: skip
            regression.feed(Sample(signal, t, value), airborne=not 700 < n < 720)
    assert all("too small" in p.reason for p in regression.estimates().values())
