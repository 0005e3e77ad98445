"""Check: lag between streams, and its drift inside a flight.

Rates and velocities are compared, not angles and positions: slow signals have little information about time. Each
window of some seconds gives a lag by cross-correlation, with a standard error from the unexplained variance. The lead
of a motor command over an acceleration is physics and is not examined.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from crazyem.doctor import kinematics
from crazyem.recordings.finding import Finding, Fix, Grade
from crazyem.recordings.ordering import Array
from crazyem.recordings.recording import Recording, SignalArray

LAG_CONFIDENCE = 0.995  # one-sided confidence level of a significant lag
REPORTED_LAG = 0.003  # s, smallest reported lag
DEGRADING_LAG = 0.010  # s, lag that degrades; half of it for a drift, which no shift repairs
WINDOW_SECONDS = 5.0  # s, length of the windows that each give a lag
LEAST_WINDOW_SHARE = 0.6  # least share of the variance that a window's best lag explains
MOST_WINDOWS = 40  # most windows; long recordings have longer windows
FEWEST_WINDOWS = 4  # fewest windows
LAG_BRIDGED_SECONDS = 0.1  # s, longest gap to interpolate: a cubic across a gap causes no lag
LARGEST_WINDOW_ERROR = 0.02  # s, largest standard error of a window that is used
LEAST_SCATTER_RATIO = 0.3  # lower bound of the windows' scatter, over their standard errors
SMALLEST_WINDOW_ERROR = 0.0005  # s, lower bound of the standard error of a window
UNSTEADY_SCATTER_RATIO = 2.5  # scatter of the windows over their standard errors, above which the lag changes


def check(recording: Recording) -> list[Finding]:
    """One finding for each stream (or origin within one) that is late or early against the stream of the first pose."""
    pose = next(iter(kinematics.poses(recording).items()), None)
    movers = [
        *kinematics.measurements(recording, "position").items(),
        *kinematics.measurements(recording, "velocity").items(),
    ]
    moving = next((mover for mover in movers if pose is None or _path(*mover) == _path(*pose)), None)
    reference = pose or moving
    if reference is None:
        return []
    base = _path(*reference)
    best: dict[_Path, _Lag] = {}
    for name, array in _comparable(recording):
        path = _path(name, array)
        against = pose if array.quantity in ("body_rate", "attitude") else moving
        if path == base or against is None:
            continue
        lag = _fit(name, array, *against)
        if lag is not None and (path not in best or lag.error < best[path].error):
            best[path] = lag
    found = [_judge(recording, base, path, lag) for path, lag in best.items()]
    return [finding for finding in found if finding is not None]


@dataclass(frozen=True)
class _Changes:
    """How the lag changes inside a flight [s]."""

    start: float  # of a line through the windows
    end: float
    drift: float  # end less start
    drift_error: float
    scatter: float  # robust standard deviation of the windows about their median, over their standard errors
    about_line: float  # the same about the line
    low: float  # 10th percentile of the windows
    high: float  # 90th percentile
    windows: int


@dataclass(frozen=True)
class _Lag:
    """Lag of a stream [s] from one of its signals over the whole flight, and its changes."""

    signal: str
    against: str
    value: float
    error: float
    blocks: int
    explained: float
    interval: tuple[float, float]
    changes: _Changes | None


# stream and origin of samples; a table may hold signals of several origins
_Path = tuple[str, str]


def _path(name: str, array: SignalArray) -> _Path:
    return array.stream or name, kinematics.origin_of(name)


def _said(path: _Path, base: _Path) -> str:
    """Text for a path: the stream, or the origin if both paths share a stream."""
    return path[1] or path[0] if path[0] == base[0] and path != base else path[0]


def _comparable(recording: Recording) -> list[tuple[str, SignalArray]]:
    """Signals to compare; a velocity (which may come from a filter) only if its origin has no position."""
    positions = kinematics.measurements(recording, "position")
    placed = {kinematics.origin_of(name) for name in positions}
    velocities = kinematics.measurements(recording, "velocity")
    return [
        *kinematics.measurements(recording, "body_rate").items(),
        *kinematics.measurements(recording, "attitude").items(),
        *positions.items(),
        *((name, array) for name, array in velocities.items() if kinematics.origin_of(name) not in placed),
    ]


def _speed(array: SignalArray, grid: kinematics.Grid) -> kinematics.Track:
    given = kinematics.track(array, grid, bridge=LAG_BRIDGED_SECONDS)
    if array.quantity == "attitude":
        return kinematics.rate_of_attitude(given)
    return kinematics.difference(given) if array.quantity == "position" else given


def _fit(name: str, array: SignalArray, against: str, other: SignalArray) -> _Lag | None:
    grid = kinematics.grid_of(array, other)
    if grid.size * kinematics.GRID_STEP < WINDOW_SECONDS * FEWEST_WINDOWS / 2:
        return None
    window = kinematics.Window(max(0.3 if other.quantity == "attitude" else 0.2, kinematics.width_for(array, other)))
    first, second, width = window.mean(_speed(other, grid)), window.mean(_speed(array, grid)), window.width
    whole = kinematics.delay(first, second, mixed=False)
    if whole is None or whole.at_edge or whole.explained < LEAST_WINDOW_SHARE:
        return None
    size = round(max(WINDOW_SECONDS, grid.size * kinematics.GRID_STEP / MOST_WINDOWS) / kinematics.GRID_STEP)
    error, count = kinematics.spread(first, second, whole, size // 2)
    error = max(error, _error(first, second, whole.value, whole.explained, width))
    if count < FEWEST_WINDOWS or not error < math.inf:
        return None
    found = []
    for first_row in range(0, grid.size - size // 2, size):
        rows = slice(first_row, first_row + size)
        one = kinematics.delay(
            first.part(rows), second.part(rows), reach=min(kinematics.LARGEST_LAG, abs(whole.value) + 0.15), mixed=False
        )
        if one is None or one.at_edge or one.explained < LEAST_WINDOW_SHARE:
            continue
        rough = _error(first.part(rows), second.part(rows), one.value, one.explained, width)
        if rough < LARGEST_WINDOW_ERROR:
            found.append((float(grid.time[rows].mean()), one.value, rough))
    start, end = float(grid.time[0]), float(grid.time[-1])
    changes = _changes(np.array(found), start, end) if len(found) >= FEWEST_WINDOWS else None
    return _Lag(name, against, whole.value, error, count, whole.explained, (start, end), changes)


def _changes(found: Array, start: float, end: float) -> _Changes:
    """Changes of the lag, from windows (n, 3) of time, lag, standard error."""
    t, y, e = found.T
    middle = _weighted_median(y, 1.0 / e)
    i, j = np.triu_indices(t.size, 1)
    ramp = float(np.median((y[j] - y[i]) / (t[j] - t[i])))  # median of the slopes of all pairs (Theil and Sen)
    line = _weighted_median(y - ramp * (t - t.mean()), 1.0 / e)
    rest = y - line - ramp * (t - t.mean())
    error = max(_robust(rest), LEAST_SCATTER_RATIO * float(np.median(e)))
    return _Changes(
        start=line + ramp * (start - float(t.mean())),
        end=line + ramp * (end - float(t.mean())),
        drift=ramp * (end - start),
        drift_error=1.25 * error / math.sqrt(t.size) / float(t.std()) * (end - start),
        scatter=_robust((y - middle) / e),
        about_line=_robust(rest / e),
        low=float(np.quantile(y, 0.1)),
        high=float(np.quantile(y, 0.9)),
        windows=t.size,
    )


def _error(first: kinematics.Track, second: kinematics.Track, lag: float, explained: float, width: float) -> float:
    """Standard error [s] of a lag, from the unexplained variance and the frequency of the common part.

    The mean square frequency of the common part is the covariance of the derivatives over that of the signals; noise of
    either signal does not change it. One sample per window width counts as independent.
    """
    steps = round(lag / kinematics.GRID_STEP)
    n = len(first.value) - abs(steps)
    x, y = first.value[max(0, -steps) :][:n], second.value[max(0, steps) :][:n]
    good = first.valid[max(0, -steps) :][:n] & second.valid[max(0, steps) :][:n]
    both = good[1:] & good[:-1]
    if both.sum() < 10:
        return math.inf
    dx, dy = np.diff(x, axis=0)[both] / kinematics.GRID_STEP, np.diff(y, axis=0)[both] / kinematics.GRID_STEP
    x, y = x[good] - x[good].mean(axis=0), y[good] - y[good].mean(axis=0)
    common = float((x * y).mean(axis=0) @ (x * y).mean(axis=0))
    moving = float((dx * dy).mean(axis=0) @ (x * y).mean(axis=0))
    if common <= 0.0 or moving <= 0.0:
        return math.inf
    independent = max(good.sum() * kinematics.GRID_STEP / width, 1.0)
    return max(SMALLEST_WINDOW_ERROR, math.sqrt(max(1.0 - explained, 0.0) / explained * common / moving / independent))


def _robust(rest: Array) -> float:
    """Standard deviation by the median of absolute values."""
    return 1.4826 * float(np.median(np.abs(rest)))


def _weighted_median(y: Array, w: Array) -> float:
    order = np.argsort(y)
    total = np.cumsum(w[order])
    return float(np.interp(0.5 * total[-1], total - 0.5 * w[order], y[order]))


def _judge(recording: Recording, base: _Path, path: _Path, lag: _Lag) -> Finding | None:
    wide, sure = (float(stats.t.ppf(level, lag.blocks - 1)) for level in (0.975, LAG_CONFIDENCE))
    drifts, wanders = _drifts(lag.changes), _wanders(lag.changes)
    late = (
        abs(lag.value) >= REPORTED_LAG and abs(lag.value) > sure * lag.error and lag.error < 0.5 * LARGEST_WINDOW_ERROR
    )
    if not (late or drifts or wanders):
        return None
    low, high = lag.value - wide * lag.error, lag.value + wide * lag.error
    evidence = {
        "lag_ms": 1e3 * lag.value,
        "lag_low_ms": 1e3 * low,
        "lag_high_ms": 1e3 * high,
        "explained": lag.explained,
    }
    # for a drifting lag, the middle of the line is better than the overall peak, which depends on the parts with motion
    said = 0.5 * (lag.changes.start + lag.changes.end) if lag.changes is not None and drifts else lag.value
    how = "late" if said > 0 else "early"
    what = lag.signal if path[0] == lag.signal else f"The stream {_said(path, base)}"
    text = f"{what} is {1e3 * abs(said):.1f} ms {how} against {_said(base, base)}"
    text += f" ({lag.signal} against {lag.against})"
    fix: Fix | None = None
    advice = "Use a stretch with one lag, or estimate the lag along; a single shift does not repair it."
    if lag.changes is not None:
        evidence |= _numbers(lag.changes)
    if lag.changes is not None and drifts:
        text += f", drifting from {1e3 * lag.changes.start:.1f} ms at the start to {1e3 * lag.changes.end:.1f} ms"
    elif lag.changes is not None and wanders:
        text += f", and it changes: {1e3 * lag.changes.low:.1f} to {1e3 * lag.changes.high:.1f} ms within the flight"
    else:
        names = tuple(n for n, a in recording.signals.items() if _path(n, a) == path)
        fix = Fix("shift", names, (-lag.value,))
        text += f"; 95 % interval {1e3 * min(abs(low), abs(high)):.1f} to {1e3 * max(abs(low), abs(high)):.1f} ms"
        advice = "Shift the stream, or estimate the lag along."
    grade = Grade.DEGRADES if abs(lag.value) >= DEGRADING_LAG or drifts or wanders else Grade.HARMLESS
    return Finding("lag", grade, text + ".", lag.signal, (lag.interval,), evidence, advice, fix)


def _drifts(changes: _Changes | None) -> bool:
    if changes is None or abs(changes.drift) < 0.5 * DEGRADING_LAG:
        return False
    sure = float(stats.t.ppf(LAG_CONFIDENCE, changes.windows - 2))
    straight = changes.about_line < max(UNSTEADY_SCATTER_RATIO, 0.7 * changes.scatter)
    return abs(changes.drift) > sure * changes.drift_error and straight


def _wanders(changes: _Changes | None) -> bool:
    return (
        changes is not None
        and changes.high - changes.low >= DEGRADING_LAG
        and changes.scatter >= UNSTEADY_SCATTER_RATIO
    )


def _numbers(changes: _Changes) -> dict[str, float]:
    wide = float(stats.t.ppf(0.975, changes.windows - 2))
    return {
        "start_ms": 1e3 * changes.start,
        "end_ms": 1e3 * changes.end,
        "drift_ms": 1e3 * changes.drift,
        "drift_low_ms": 1e3 * (changes.drift - wide * changes.drift_error),
        "drift_high_ms": 1e3 * (changes.drift + wide * changes.drift_error),
        "window_low_ms": 1e3 * changes.low,
        "window_high_ms": 1e3 * changes.high,
        "scatter": changes.scatter,
        "windows": float(changes.windows),
    }
