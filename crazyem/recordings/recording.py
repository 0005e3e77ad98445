"""A flight from a file: arrays of signals, the order in which the estimator processes the samples, and findings."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import DataError
from crazyem.notebook import finite, html_table, new_figure, saved
from crazyem.recordings.finding import Finding
from crazyem.signals.mavlink import carries_attitude
from crazyem.signals.sample import ESTIMATOR_SIGNALS, SIGNALS, Sample, components

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class SignalArray:
    """All samples of one signal, as measured: at its own rate, neither resampled nor filled in.

    Attributes:
        time: (n,) s on the clock of the source, minus the recording's `origin`.
        value: (n, c) NaN where missing; SI for signals of the vocabulary, else in `unit`.
        order: (n,) position of each sample in the processing order of the whole recording.
        host_time: (n,) s since the epoch, NaN where unknown.
        marked: (n,) True where the reader set NaN (interpolated interval, sensor says "missing"), not the file.
        quantity: key of `crazyem.signals.sample.SIGNALS`, "" for a column without a mapping.
        unit: of `value`; "" where the source does not say.
        frame: as in `SIGNALS`, or as far as known.
        clock: "firmware", "host", or the name in the source; times of signals with the same clock are comparable.
        stream: signals with the same stream were sampled together (a log block, a table, a topic) and share `time`.
        source: the names in the file, one per component if there are several.
    """

    time: NDArray[np.float64]
    value: NDArray[np.float64]
    order: NDArray[np.int64]
    host_time: NDArray[np.float64]
    marked: NDArray[np.bool_]
    quantity: str = ""
    unit: str = ""
    frame: str = ""
    clock: str = ""
    stream: str = ""
    source: tuple[str, ...] = ()

    @property
    def period(self) -> float:
        """Median time between samples [s]; NaN with fewer than two."""
        return float(np.median(np.diff(self.time))) if self.time.size > 1 else math.nan

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the components, () for a scalar."""
        if self.quantity in SIGNALS:
            return components(self.quantity)
        count = self.value.shape[1]
        return tuple(str(i) for i in range(count)) if count > 1 else ()

    def rows(self, chosen: slice | NDArray[np.int64]) -> "SignalArray":
        """The signal with only the chosen samples, in the chosen order."""
        return replace(
            self,
            time=self.time[chosen],
            value=self.value[chosen],
            order=self.order[chosen],
            host_time=self.host_time[chosen],
            marked=self.marked[chosen],
        )


def about(signal: Any) -> dict[str, Any]:
    """What is known of a signal, from a `SignalArray` or an object with the same attributes."""
    return {name: getattr(signal, name) for name in ("quantity", "unit", "frame", "clock", "stream", "source")}


@dataclass(frozen=True, slots=True)
class Event:
    """An event in the flight: a setpoint, a write of a parameter, an estimate or a log message."""

    time: float  # s since the epoch (host clock)
    kind: str  # "setpoint", "parameter_write", "estimate" or "log"
    data: Mapping[str, object]  # its fields by name


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A flight as signals.

    Attributes:
        path: the file, as given.
        source: which reader and mapping produced it, e.g. "mcap" or "csv:nanobench".
        signals: arrays by name: a key of `SIGNALS` for inputs of the estimator, "<quantity>@<origin>" for further
            measurements of the same quantity ("position@mocap"), and the name in the source for all others.
        metadata: configuration of the run and similar texts: section -> key -> text.
        findings: problems that the reader found; the doctor searches for more.
        events: events in the flight, by time.
        origin: s on the clock of the source at which `time` is 0; `origin + time` are exactly the stamps of the file.
    """

    path: str
    source: str
    signals: Mapping[str, SignalArray]
    metadata: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    events: tuple[Event, ...] = ()
    origin: float = 0.0

    @property
    def notices(self) -> tuple[str, ...]:
        """The sentence of each finding of the reader."""
        return tuple(finding.text for finding in self.findings)

    @property
    def duration(self) -> float:
        """Seconds from the first to the last sample, on the clock of the source."""
        times = [array.time for array in self.signals.values() if array.time.size]
        return float(max(t.max() for t in times) - min(t.min() for t in times)) if times else 0.0

    def to_dict(self) -> dict[str, Any]:
        """A summary without the samples, ready for JSON."""
        signals = {
            name: {
                "samples": int(a.time.size), "period_s": a.period, "unit": a.unit, "frame": a.frame, "clock": a.clock,
                "source": list(a.source),
            }
            for name, a in self.signals.items()
        }  # fmt: skip
        whole: dict[str, Any] = finite(
            {"path": self.path, "source": self.source, "duration_s": self.duration, "signals": signals,
             "notices": list(self.notices)}
        )  # fmt: skip
        return whole

    def __str__(self) -> str:
        return f"{self.path} ({self.source}): {self.duration:.1f} s, {len(self)} samples of {len(self.signals)} signals"

    def _repr_html_(self) -> str:
        rows = [
            (name, a.time.size, 1.0 / a.period if a.period else math.nan, a.unit, a.frame)
            for name, a in self.signals.items()
        ]
        return html_table(str(self), ("signal", "samples", "Hz", "unit", "frame"), rows, self.notices)

    def plot(self, path: str | Path | None = None) -> "Figure":
        """Plot the signals that an estimator uses over time; saved to `path` if given.

        Raises:
            UsageError: the file cannot be written. MissingExtraError: no matplotlib.
        """
        shown = {n: a for n, a in self.signals.items() if n in ESTIMATOR_SIGNALS and a.time.size}
        figure = new_figure(8.0, 1.6 * max(1, len(shown)))
        panels = figure.subplots(max(1, len(shown)), sharex=True, squeeze=False)[:, 0]
        for axes, (name, a) in zip(panels, shown.items(), strict=False):
            axes.plot(a.time, a.value, linewidth=0.8, label=a.components or None)
            axes.set_ylabel(f"{name} [{a.unit}]" if a.unit else name)
            axes.grid(alpha=0.3)
        panels[-1].set_xlabel("time [s]")
        return saved(figure, path)

    def __len__(self) -> int:
        return sum(array.time.size for array in self.signals.values())

    def samples(self) -> Iterator[Sample]:
        """Every sample for the estimator, in the order in which a live estimator processes them."""
        names = [name for name in self.signals if name in ESTIMATOR_SIGNALS and self.signals[name].time.size]
        if not names:
            return
        arrays = [self.signals[name] for name in names]
        order = np.concatenate([a.order for a in arrays])
        which = np.concatenate([np.full(a.order.size, i) for i, a in enumerate(arrays)])
        row = np.concatenate([np.arange(a.order.size) for a in arrays])
        place = np.argsort(order, kind="stable")
        times = [a.time.tolist() for a in arrays]
        hosts = [a.host_time.tolist() for a in arrays]
        values = [[tuple(v) for v in a.value.tolist()] for a in arrays]
        for i, k in zip(which[place].tolist(), row[place].tolist(), strict=True):
            yield Sample(names[i], times[i][k], values[i][k], hosts[i][k])

    def check(self, required: Iterable[str]) -> None:
        """Raise DataError if a required signal is absent, has no times or contains NaN from the file itself."""
        for name in required:
            array = self.signals.get(name)
            if array is None or array.time.size == 0:
                raise DataError(f"{self.path}: the recording has no {name}, which the estimator needs.")
            bad = ~np.isfinite(array.value).all(axis=1) & ~array.marked
            if bad.any():
                first = float(array.time[int(np.argmax(bad))])
                raise DataError(
                    f"{self.path}: {name} is not a number in {int(bad.sum())} of {bad.size} samples, "
                    f"first at t = {first:.3f} s."
                )
            if not np.isfinite(array.time).all():
                raise DataError(f"{self.path}: {name} has samples without a time.")


# Prefixes of names of attitudes from a filter on board, besides MAVLink: Crazyflie, ULog.
CRAZYFLIE_PREFIXES = ("stateEstimate", "kalman.")
ONBOARD_PREFIXES = (*CRAZYFLIE_PREFIXES, "vehicle_attitude.")


def onboard_attitude(recording: Recording) -> bool:
    """Whether the attitude is from a filter on board, not from motion capture: by its name, or by the claim of a CSV
    mapping (`attitude = "onboard"`)."""
    attitude = recording.signals.get("attitude")
    if attitude is None:
        return False
    claimed = recording.metadata.get("claims", {}).get("attitude") == "onboard" or "mavlink" in recording.metadata
    return claimed or _named(attitude, ONBOARD_PREFIXES) or any(carries_attitude(s) for s in attitude.source)


def onboard_estimate(recording: Recording) -> bool:
    """Whether the attitude is from a filter on board; without an attitude: whether the velocity is."""
    velocity = recording.signals.get("velocity")
    if "attitude" in recording.signals or velocity is None:
        return onboard_attitude(recording)
    return "mavlink" in recording.metadata or _named(velocity, (*CRAZYFLIE_PREFIXES, "vehicle_local_position."))


def crazyflie_attitude(recording: Recording) -> bool:
    """Whether the attitude is from the filter of a Crazyflie, by its name, at any rate."""
    return "attitude" in recording.signals and _named(recording.signals["attitude"], CRAZYFLIE_PREFIXES)


def _named(signal: SignalArray, prefixes: tuple[str, ...]) -> bool:
    return any(s.rsplit("/", 1)[-1].startswith(prefixes) for s in signal.source)
