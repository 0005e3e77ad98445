"""Judges whether the drone flies worse after a write of parameters than before, by three figures.

The figures are the distance from the setpoint, the normalised innovation of the estimator, and the oscillation of the
body rates. All times are on the drone's clock; the same samples and writes give the same verdicts.
"""

import math
import threading
from collections import deque
from dataclasses import dataclass, replace

from crazyem.control.indi import IndiResponse
from crazyem.live.policy import MonitorLimits
from crazyem.live.telemetry import tilt_of
from crazyem.signals.sample import Sample

ALARM_SECONDS = 0.3  # s, averaging time of an alarm
# m/s, largest increase of the setpoint's speed for a comparison of innovations: drag is not in the model and grows with
# speed.
LIKE_SPEED = 0.5
SPEED_SPAN = 0.1  # s, span for the setpoint's speed: logged positions are in whole millimetres
FEWEST_VALUES = 20  # fewest values of a stretch
SERIES_LENGTH = 4096  # values of each series: bounds the memory
LOST_TRACKING_DISTANCE = 1.0  # m; a drone this far from its setpoint before a write does not follow it
# s for the return to the setpoint after a change of mass, and after the write of the new mass
RETURN_SECONDS = 2.5
GUST_RETURN_SECONDS = 1.0  # s, the same after a gust that looked like a change of mass
EXCUSED_ALARM = 0.5  # m, added to the alarm limit during this time
HIGH_PASS_GAP = 0.5  # s without a sample after which the high-pass starts again


@dataclass(frozen=True)
class Figures:
    """Root mean squares over a stretch; NaN where unknown.

    Attributes:
        tracking: distance from the setpoint, m. speed: of the setpoint, m/s.
        innovation: normalised, 1 if the model's noise is right. oscillation: fast part of the body rates, rad/s.
    """

    tracking: float = math.nan
    speed: float = math.nan
    innovation: float = math.nan
    oscillation: float = math.nan


class _Series:
    """Squares over time, the newest `SERIES_LENGTH`."""

    def __init__(self) -> None:
        self._items: deque[tuple[float, float]] = deque(maxlen=SERIES_LENGTH)

    def add(self, time: float, square: float) -> None:
        if math.isfinite(square):
            self._items.append((time, square))

    def forget(self, since: float) -> None:
        """Drop values after `since` [s]."""
        self._items = deque((i for i in self._items if i[0] <= since), maxlen=SERIES_LENGTH)

    def rms(self, start: float, end: float, fewest: int = FEWEST_VALUES) -> float:
        """Root mean square over [start, end], NaN with fewer than `fewest` values."""
        total, count = 0.0, 0
        for time, square in reversed(tuple(self._items)):  # a copy: another thread adds to it
            if time < start:
                break
            if time <= end:
                total += square
                count += 1
        return math.sqrt(total / count) if count >= fewest else math.nan


class PostWriteMonitor:
    """Judges writes by the flight after them.

    Several writes in short succession are judged together, against the stretch before the first. Samples, innovations
    and writes may come from three threads.

    Args:
        response: where a controller takes the drone that follows positions ahead of the drone (INDI). The distance is
            then that from the expected position, not from the setpoint, and horizontal: what is written to INDI
            changes torques, not thrust.
    """

    def __init__(self, limits: MonitorLimits | None = None, response: IndiResponse | None = None) -> None:
        self.limits = limits or MonitorLimits()
        self.response = response
        self._lock = threading.RLock()
        self._tracking, self._speed = _Series(), _Series()
        self._innovation, self._oscillation = _Series(), _Series()
        self._setpoints: deque[tuple[float, tuple[float, ...]]] = deque(maxlen=64)
        self._velocity: tuple[float, ...] = (0.0, 0.0, 0.0)
        self._rate: tuple[float, tuple[float, ...]] | None = None
        self._slow: list[tuple[float, ...]] = []  # low-passed input of each stage of the high-pass
        self._tilt = 0.0
        self._raw = _Series()  # distance from the setpoint, also during changes of mass
        self._excused = (math.inf, -math.inf)  # start and end of the time in which a change of mass explains errors
        self._unwritten = False  # the new mass is not in the drone yet
        self._reference: Figures | None = None
        self._first = self._last = -math.inf
        self.newest = -math.inf
        self.unjudged = 0

    # measurements

    def take(self, sample: Sample) -> None:
        """One sample of the flight."""
        with self._lock:
            self.newest = max(self.newest, sample.time)
            if sample.signal == "setpoint_position":
                self._setpoint(sample.time, sample.value)
            elif sample.signal == "position":
                self._position(sample.time, sample.value)
            elif sample.signal == "velocity":
                self._velocity = sample.value
            elif sample.signal == "body_rate":
                self._body_rate(sample.time, sample.value)
            elif sample.signal == "attitude":
                self._tilt = tilt_of(sample.value)

    def innovation(self, time: float, mean_square: float) -> None:
        """Mean square of the normalised innovations of a sample at `time` [s]."""
        with self._lock:
            if not self._is_excused(time):
                self._innovation.add(time, mean_square)

    def on_mass_step(self, *, began: float, now: float, real: bool | None) -> None:
        """The mass changed at `began` [s] (True), may have changed (None), or did not change after all (False).

        The distance from the setpoint is then no evidence about a write, before or after it. The body rates and the
        alarm for a very large distance remain active.
        """
        with self._lock:
            if real is None:
                self._excused = (began, now + RETURN_SECONDS)  # with an end, because the estimator may stall
                self._tracking.forget(began)
                self._innovation.forget(began)
                self.unjudged = min(self.unjudged, self.limits.unjudged - 1)  # the new mass does not wait for verdicts
            elif began == self._excused[0]:
                self._excused = (began, now + (RETURN_SECONDS if real else GUST_RETURN_SECONDS))
                self._unwritten = real

    def _is_excused(self, time: float) -> bool:
        return self._excused[0] < time < self._excused[1]

    def _setpoint(self, time: float, wanted: tuple[float, ...]) -> None:
        self._setpoints.append((time, wanted))
        for before, value in tuple(self._setpoints):
            if 0.0 < time - before <= SPEED_SPAN + 1e-6:
                self._speed.add(time, math.dist(wanted, value) ** 2 / (time - before) ** 2)
                break

    def _position(self, time: float, position: tuple[float, ...]) -> None:
        if self._setpoints and abs(time - self._setpoints[-1][0]) <= SPEED_SPAN:
            wanted = self._setpoints[-1][1]
            if self.response is not None:
                wanted = self.response.expected(time, wanted, position, self._velocity)
            self._raw.add(time, math.dist(position, wanted) ** 2)
            if not self._is_excused(time):
                axes = 3 if self.response is None else 2
                self._tracking.add(time, math.dist(position[:axes], wanted[:axes]) ** 2)

    def _body_rate(self, time: float, rate: tuple[float, ...]) -> None:
        before, self._rate = self._rate, (time, rate)
        if before is None or not 0.0 < time - before[0] < HIGH_PASS_GAP:
            self._slow = [rate] + [(0.0, 0.0, 0.0)] * (self.limits.high_pass_order - 1)
            return
        share = 1.0 - math.exp(-(time - before[0]) / self.limits.high_pass)
        fast = rate
        for stage, slow in enumerate(self._slow):
            self._slow[stage] = tuple(s + share * (f - s) for s, f in zip(slow, fast))
            fast = tuple(f - s for s, f in zip(self._slow[stage], fast))
        self._oscillation.add(time, math.hypot(*fast) ** 2)

    def figures(self, start: float, end: float, fewest: int = FEWEST_VALUES) -> Figures:
        """The figures between two times [s]."""
        return Figures(
            tracking=self._tracking.rms(start, end, fewest),
            speed=self._speed.rms(start, end, 1),
            innovation=self._innovation.rms(start, end, 5),  # one per update
            oscillation=self._oscillation.rms(start, end, fewest),
        )

    # verdicts

    @property
    def judging(self) -> bool:
        """Whether a write waits for a verdict."""
        return self._reference is not None

    @property
    def full(self) -> bool:
        """Whether the next write must wait for a verdict."""
        return self.limits.enabled and self.unjudged >= self.limits.unjudged

    def on_write(self, begun: float, ended: float) -> None:
        """A set of parameters was written between `begun` and `ended` [s]."""
        with self._lock:
            if self._is_excused(begun):
                self._excused = (self._excused[0], max(self._excused[1], ended + RETURN_SECONDS))
            self._unwritten = False
            if self._reference is None:
                until = self._excused[0] if self._is_excused(begun) else begun
                self._reference = self.figures(until - self.limits.before, until)
                self._first = begun
            self._last = max(self._last, ended)
            self.unjudged += 1

    def forget(self) -> None:
        """End the judgement: the writes are good, or undone."""
        with self._lock:
            self._reference = None
            self._first = self._last = -math.inf
            self.unjudged = 0

    def judge(self, time: float) -> tuple[str, str]:
        """Verdict at `time` [s]: ("good", figures), ("worse", why), or ("", "") if undecided or nothing is to judge."""
        with self._lock:
            before = self._reference
            if before is None or not self.limits.enabled:
                return "", ""
            if alarm := self._alarm(before, time):
                return "worse", alarm
            start = self._last + self.limits.settle
            if self._excused[1] > self._first:
                start = max(start, self._excused[1])
                if self._unwritten:  # an unwritten mass causes the error, not the writes
                    before = replace(before, tracking=math.nan)
            if time - start < min(1.0, self.limits.after):
                return "", ""
            after = self.figures(start, time)
            if why := self._worse(before, after):
                return "worse", why
            # without data (an outage) there is no verdict
            known = not (math.isnan(after.tracking) and math.isnan(after.oscillation))
            if time - start < self.limits.after or not known:
                return "", ""
            return "good", f"{_said(before)} before, {_said(after)} after"

    def _alarm(self, before: Figures, time: float) -> str:
        limits, now = self.limits, self.figures(time - ALARM_SECONDS, time, 5)
        if self._tilt > limits.tilt_alarm:
            return f"the drone leans {math.degrees(self._tilt):.0f} degrees"
        base, distance = _or(before.tracking, 0.0), self._raw.rms(time - ALARM_SECONDS, time, 5)
        alarm = limits.tracking_alarm + (EXCUSED_ALARM if self._is_excused(time) or self._unwritten else 0.0)
        if (
            base < LOST_TRACKING_DISTANCE
            and time - self._first > 0
            and distance > base + alarm + limits.lead * now.speed
        ):
            return f"{distance:.2f} m from the setpoint, {base:.2f} m before"
        if now.oscillation > _or(before.oscillation, 0.0) + limits.oscillation_alarm:
            return f"body rates oscillate by {now.oscillation:.1f} rad/s"
        return ""

    def _worse(self, before: Figures, after: Figures) -> str:
        """Why the flight after is worse, "" if it is not. Comparisons with NaN are false: unknown is not worse."""
        limits = self.limits
        moving = limits.lead * max(_or(after.speed, 0.0) - _or(before.speed, 0.0), 0.0)
        allowed = max(limits.tracking_ratio * before.tracking, before.tracking + limits.tracking) + moving
        if before.tracking < LOST_TRACKING_DISTANCE and after.tracking > allowed:
            return f"{after.tracking:.3f} m rms from the setpoint, {before.tracking:.3f} m before"
        faster = _or(after.speed, 0.0) - _or(before.speed, 0.0) > LIKE_SPEED
        if not faster and after.innovation > max(limits.innovation_ratio * before.innovation, limits.innovation):
            return f"innovations of {after.innovation:.1f} standard deviations, {before.innovation:.1f} before"
        allowed = max(limits.oscillation_ratio * before.oscillation, before.oscillation + limits.oscillation)
        if after.oscillation > allowed:
            return f"body rates oscillate by {after.oscillation:.2f} rad/s, {before.oscillation:.2f} before"
        return ""


def _or(value: float, otherwise: float) -> float:
    return otherwise if math.isnan(value) else value


def _said(f: Figures) -> str:
    texts = (f"{f.tracking:.3f} m", f"{f.innovation:.2f} sd", f"{f.oscillation:.2f} rad/s")
    return ", ".join(text for text in texts if not text.startswith("nan")) or "nothing known"
