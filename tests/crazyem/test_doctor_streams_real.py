"""The stream checks on real flights; what is expected of them is counted here, with plain numpy."""

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest
from doctor_checks import only, run

from crazyem.doctor.streams import runs
from crazyem.recordings.airborne import airtime
from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.registry import open_recording

# -- real flights -----------------------------------------------------------------------------------------------------


def column(path: Path, name: str) -> np.ndarray:
    """A column of a packed CSV, read without the project."""
    with gzip.open(path, "rt", newline="") as file:
        return np.array([float(row[name] or "nan") for row in csv.DictReader(file)])


def test_real_saturation_is_counted_right(shared_recordings):
    path = shared_recordings / "nanobench" / "B3_figure8_fast_rep2.csv.gz"
    finding = next(f for f in run("saturation", open_recording(path)) if "upper" in f.text)
    at_limit = int((column(path, "motor_motor_m4") >= 65535).sum())
    assert finding.evidence["share_m4"] == max(finding.evidence[f"share_m{i}"] for i in (1, 2, 3, 4))
    flight = airtime(open_recording(path))
    assert flight is not None
    seconds = sum(b - a for a, b in flight.airborne)
    # some of them were interpolated, and are missing
    assert 0.9 * at_limit <= finding.evidence["share_m4"] * seconds * 100.0 <= 1.3 * at_limit
    assert "low battery" in finding.text


def test_real_regrid(shared_recordings):
    """Rows of random_run1 that repeat the one before in all of 13 onboard columns, counted by hand."""
    path = shared_recordings / "nanodrone" / "raw" / "random_run1.csv.gz"
    names = ("x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz", "qx", "qy", "qz", "qw")
    table = np.column_stack([column(path, name) for name in names])
    share = float((table[1:] == table[:-1]).all(axis=1).mean())
    finding = next(f for f in run("repeated", open_recording(path)) if "whole rows" in f.text)
    assert finding.evidence["share"] == pytest.approx(share, abs=0.02)
    assert finding.evidence["rate_hz"] == pytest.approx(74.0, abs=1.0)


def test_real_log_that_stood_still(shared_recordings):
    path = shared_recordings / "nanodrone" / "raw" / "square_run1.csv.gz"
    finding = only("frozen", open_recording(path))
    t = column(path, "t")
    table = np.column_stack([column(path, name) for name in ("x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz")])
    still = np.concatenate([[False], (np.diff(table, axis=0) == 0).all(axis=1)]) & (t < 6.5)
    first, last = max(runs(still).tolist(), key=lambda span: span[1] - span[0])
    assert finding.intervals[0] == pytest.approx((t[first - 1], t[last - 1]), abs=0.03)
    assert finding.evidence["longest_s"] == pytest.approx(2.0, abs=0.05)


def test_real_impossible_rotor_speeds(shared_recordings):
    path = shared_recordings / "nanodrone" / "raw" / "chirp_run1.csv.gz"
    speeds = np.column_stack([column(path, f"m{i}_erpm") for i in (1, 2, 3, 4)])
    rows = np.flatnonzero(((speeds > 1e6) & (speeds != 65535)).any(axis=1))
    finding = only("numbers", open_recording(path))
    assert finding.fix is not None
    assert finding.fix.rows.tolist() == rows.tolist()


def test_real_crash_and_real_rough_landing(shared_recordings):
    """log10 ends on its back: the accelerometer at rest shows minus 1 g. log15 lands at 78 m/s^2 and stays upright."""
    options = ReadOptions(motor="duty")
    crash = open_recording(shared_recordings / "sysid" / "log10", options)
    assert crash.signals["specific_force"].value[-500:, 2].mean() == pytest.approx(-9.94, abs=0.05)
    finding = only("flight", crash)
    assert finding.evidence["rest_tilt_deg"] == pytest.approx(178.0, abs=1.0)
    assert run("flight", open_recording(shared_recordings / "sysid" / "log15", options)) == []


def test_real_fast_clock_and_dropped_records(shared_recordings):
    path = shared_recordings / "crazypad" / "motor__cut_propeller_M3_1mm_46mm__E8_log01"
    recording = open_recording(path)
    time = next(iter(recording.signals.values())).time
    steps = np.diff(time)
    gap = only("gaps", recording)
    assert gap.evidence["longest_s"] == pytest.approx(steps.max())
    assert gap.evidence["lost"] == round(float((steps[steps > 0.015] / np.median(steps) - 1).sum()))
    rate = only("clocks", recording)
    assert rate.evidence["deviation_percent"] == pytest.approx(100 * (0.01 / np.median(steps) - 1), abs=0.1)


def test_the_real_firmware_on_a_slow_computer(shared_recordings):
    """Its clock falls behind the host's by what the first and last packet say."""
    recording = open_recording(shared_recordings / "real_firmware" / "lee_brushless_39g.csv.gz")
    array = recording.signals["position"]
    behind = float((array.host_time[-1] - array.host_time[0]) - (array.time[-1] - array.time[0]))
    finding = next(f for f in run("clocks", recording) if "host" in f.text)
    assert finding.evidence["apart_s"] == pytest.approx(behind, rel=0.3)
    assert behind > 0.2
