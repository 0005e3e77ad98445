"""What the tests of the stream checks share: running one check or all, and planting values into a recording."""

from dataclasses import replace

import numpy as np
from made_flight import changed

from crazyem.doctor import CHECKS
from crazyem.recordings.finding import Finding
from crazyem.recordings.recording import Recording

IMU = ("body_rate", "specific_force")  # the signals of the stream "imu" of a made flight


def run(check: str, recording: Recording) -> list[Finding]:
    return next(c for c in CHECKS if c.module == check).run(recording)


def everything(recording: Recording) -> list[Finding]:
    return [finding for check in CHECKS for finding in check.run(recording)]


def only(check: str, recording: Recording) -> Finding:
    """The one finding of a check, which no other check repeats as unusable."""
    findings = run(check, recording)
    assert len(findings) == 1, [f.text for f in findings]
    return findings[0]


def covers(finding: Finding, start: float, end: float, slack: float = 0.02) -> bool:
    return any(a - slack <= start and end <= b + slack for a, b in finding.intervals)


def rows_of(finding: Finding) -> list[int]:
    """The samples that the repair of a finding changes."""
    assert finding.fix is not None
    assert finding.fix.rows is not None
    return finding.fix.rows.tolist()


def with_values(recording: Recording, name: str, place: object, value: object) -> Recording:
    """The recording with other values at a place: rows, or rows and columns."""
    values = recording.signals[name].value.copy()
    values[place] = value  # type: ignore[index]
    return changed(recording, name, value=values)


def with_fields(recording: Recording, *names: str, **fields: np.ndarray) -> Recording:
    """The recording with other arrays (`time`, `host_time`, `marked`) of some signals."""
    arrays = {name: replace(recording.signals[name], **fields) for name in names}
    return replace(recording, signals={**recording.signals, **arrays})
