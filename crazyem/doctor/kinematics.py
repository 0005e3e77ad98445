"""Signals for the checks that use physics: tracks on one time grid, smoothed and differentiated in the same way.

A relation between two signals, y = dx/dt, is tested after both sides, y and the difference of x, are convolved with the
same smooth window. The window is a raised cosine of `width` seconds. It suppresses vibration, quantisation, jitter of
stamps and white noise. The lag between two tracks is found to a fraction of a grid step, for any units and axes.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from crazyem.doctor.regression import jackknife_error
from crazyem.physics.rotations import (
    quaternion_conjugate,
    quaternion_from_euler,
    quaternion_product,
    rotation_vector_from_quaternion,
)
from crazyem.recordings.ordering import Array, Flags
from crazyem.recordings.recording import Recording, SignalArray
from crazyem.signals.sample import SIGNALS

GRID_STEP = 0.01  # s, of the grid
LONGEST_GRID_SECONDS = 900.0  # s; of longer recordings only this part, about the middle, is used
SHORTEST_GRID_SECONDS = 2.0  # s; shorter ones are not judged
SMOOTHING_WINDOW = 0.16  # s, window for streams of 50 Hz or more
LONGEST_SAMPLE_INTERVAL = 0.25  # s; slower streams have no information about motion
IMPOSSIBLE_VALUE = 1e9  # of any quantity in any unit; other checks report it
MOST_AVERAGED_SAMPLES = 1000  # samples averaged into one: 100 kHz
BRIDGED_SECONDS = 0.045  # s, longest gap to interpolate: motion changes more slowly
UP = np.array([0.0, 0.0, 1.0])
GRAVITY = 9.81  # m/s^2; the true value differs from place to place by 0.3 %


def origin_of(name: str) -> str:
    """Origin of a measurement: "" for the recording's first choice, "mocap" for "position@mocap"."""
    return name.partition("@")[2]


def measurements(recording: Recording, quantity: str) -> dict[str, SignalArray]:
    """All signals that measure a quantity for at least 2 s at 4 Hz or more, through `light`; the first choice first.

    The reader says what a signal measures, else its name.
    """
    found = {}
    for name, array in recording.signals.items():
        measured = array.quantity or name.partition("@")[0]
        if measured == quantity and array.value.shape[1] == SIGNALS[quantity][0]:
            made = light(array, quantity)
            slow = quantity != "voltage" and _period(made.time) > LONGEST_SAMPLE_INTERVAL
            if made.time.size >= 20 and made.time[-1] - made.time[0] >= SHORTEST_GRID_SECONDS and not slow:
                found[name] = made
    return dict(sorted(found.items(), key=lambda item: (item[0] != quantity, item[0])))


# results of `light` by array and quantity: seven checks use the same signals
_light: WeakKeyDictionary[SignalArray, dict[str, SignalArray]] = WeakKeyDictionary()


def light(array: SignalArray, quantity: str) -> SignalArray:
    """The sound samples of a signal, in the order of their stamps, averaged down to 100 Hz where it is faster.

    Of samples with equal stamps the first is kept. At most `LONGEST_GRID_SECONDS` about the median stamp are kept; a
    few wrong stamps do not move the median. Angles are picked, not averaged, because they jump.
    """
    known = _light.setdefault(array, {})
    if quantity not in known:
        known[quantity] = _lightened(array, quantity)
    return known[quantity]


def _lightened(array: SignalArray, quantity: str) -> SignalArray:
    good = _sound(array)
    time, value = array.time[good], array.value[good]
    if time.size > 1 and (np.diff(time) <= 0).any():
        time, kept = np.unique(time, return_index=True)
        value = value[kept]
    if time.size and time[-1] - time[0] > LONGEST_GRID_SECONDS:
        near = np.abs(time - float(np.median(time))) <= 0.5 * LONGEST_GRID_SECONDS
        time, value = time[near], value[near]
    if quantity == "attitude":
        value = continuous(value)
    period = _period(time)
    many = int(min(GRID_STEP / period + 1e-6, MOST_AVERAGED_SAMPLES)) if period > 0 else 1
    if many > 1:
        rest = time.size // many * many
        first, last = time[:rest:many], time[many - 1 : rest : many]
        # no average across a gap: it would belong to no time
        whole = last - first <= 2.0 * many * period
        if quantity == "euler":
            time, value = time[many // 2 : rest : many][whole], value[many // 2 : rest : many][whole]
        else:
            value = np.asarray(sum(value[k:rest:many] for k in range(many)), float)[whole] / many
            time = np.asarray(sum(time[k:rest:many] for k in range(many)), float)[whole] / many
    clean = np.zeros(time.size, bool)
    rows = np.arange(time.size, dtype=np.int64)
    none = np.full(time.size, np.nan)
    return replace(array, time=time, value=value, marked=clean, order=rows, host_time=none, quantity=quantity)


@dataclass(frozen=True, slots=True)
class Grid:
    """Times `start + i GRID_STEP`, i < size."""

    start: float
    size: int

    @property
    def time(self) -> Array:
        return np.asarray(self.start + GRID_STEP * np.arange(self.size), float)


def grid_of(*arrays: SignalArray) -> Grid:
    """A grid over the common time of all arrays (from `light`); size 0 if there is too little."""
    if any(array.time.size < 4 for array in arrays):
        return Grid(0.0, 0)
    start = max(float(array.time[0]) for array in arrays)
    end = min(float(array.time[-1]) for array in arrays)
    return Grid(start, int((end - start) / GRID_STEP) + 1) if end - start >= SHORTEST_GRID_SECONDS else Grid(0.0, 0)


@dataclass(frozen=True, eq=False)
class Track:
    """Values (m, c) on a grid, and where they are valid (m,)."""

    value: Array
    valid: Flags

    def part(self, rows: slice) -> "Track":
        return Track(self.value[rows], self.valid[rows])


def width_for(*arrays: SignalArray) -> float:
    """Length [s] of the window for streams of these rates: eight samples of the slowest, or `SMOOTHING_WINDOW`."""
    return max([SMOOTHING_WINDOW, *(8.0 * _period(array.time) for array in arrays)])


def track(array: SignalArray, grid: Grid, *, shift: float = 0.0, bridge: float = BRIDGED_SECONDS) -> Track:
    """A signal from `light` on a grid, interpolated by local cubics; not valid across gaps.

    Args:
        array: of one signal, from `measurements`.
        grid: from `grid_of`.
        shift: s, delay of the stamps of the array; it is subtracted from them.
        bridge: s, longest gap that a cubic bridges (always at least 2.6 periods of the stream).
    """
    time = array.time - shift
    if time.size < 4 or grid.size == 0:
        return Track(np.zeros((grid.size, array.value.shape[1])), np.zeros(grid.size, bool))
    at = grid.time
    row = np.clip(np.searchsorted(time, at, side="right") - 1, 0, time.size - 2)
    out = _cubic(time, array.value, at, row)
    step = np.diff(time)
    valid = (at >= time[0]) & (at <= time[-1]) & (step[row] <= max(2.6 * _period(time), bridge))
    if array.quantity == "attitude":
        norm = np.sqrt(np.einsum("ij,ij->i", out, out))
        valid &= norm > 1e-3
        out /= np.where(norm > 1e-3, norm, 1.0)[:, None]
    return Track(out, valid)


@dataclass(frozen=True)
class Window:
    """The raised cosine of `width` seconds, as a convolution kernel on the grid."""

    width: float

    @property
    def half(self) -> int:
        return max(2, round(0.5 * self.width / GRID_STEP))

    @cached_property
    def kernel(self) -> Array:
        k = 1.0 + np.cos(np.pi * np.arange(-self.half, self.half + 1) / self.half)
        return np.asarray(k / k.sum(), float)

    def mean(self, given: Track) -> Track:
        """The weighted mean about each time; valid where all values in the window are."""
        valid = np.zeros(given.valid.size, bool)
        if valid.size < self.kernel.size:
            return Track(given.value, valid)
        clean = np.where(given.valid[:, None], given.value, 0.0)
        value = convolve1d(clean, self.kernel, axis=0, mode="nearest")
        missing = np.concatenate([[0], np.cumsum(~given.valid)])
        valid[self.half : -self.half] = missing[self.kernel.size :] == missing[: -self.kernel.size]
        return Track(value, valid)


def rate_of_attitude(attitude: Track) -> Track:
    """Body rate (m, 3) [rad/s] of a quaternion track: rotation vectors between neighbours, to fourth order."""
    q = attitude.value
    rate = np.zeros((len(q), 3))
    if len(q) >= 5:
        near = turn(q[1:-3], q[3:-1]) / (2.0 * GRID_STEP)
        far = turn(q[:-4], q[4:]) / (4.0 * GRID_STEP)
        rate[2:-2] = (4.0 * near - far) / 3.0
    return Track(rate, _inner(attitude.valid))


def difference(given: Track) -> Track:
    """Derivative on the grid to fourth order, per second: (m, c)."""
    x = given.value
    value = np.zeros_like(x)
    if len(x) >= 5:
        value[2:-2] = (8.0 * (x[3:-1] - x[1:-3]) - (x[4:] - x[:-4])) / (12.0 * GRID_STEP)
    return Track(value, _inner(given.valid))


def _inner(valid: Flags) -> Flags:
    """Where two neighbours on either side are valid, too."""
    out = np.zeros(valid.size, bool)
    if valid.size >= 5:
        out[2:-2] = valid[:-4] & valid[1:-3] & valid[2:-2] & valid[3:-1] & valid[4:]
    return out


def turn(first: Array, second: Array) -> Array:
    """Rotation vectors (m, 3) [rad] of conj(first) * second, (m, 4) each."""
    return rotation_vector_from_quaternion(quaternion_product(quaternion_conjugate(first), second))


def upright(q: Array) -> Array:
    """(n,) cosine of the tilt, from quaternions (n, 4) x y z w of any length but zero."""
    square = np.sum(q**2, axis=1)
    return np.asarray(1.0 - 2.0 * (q[:, 0] ** 2 + q[:, 1] ** 2) / np.where(square > 0.0, square, 1.0), float)


def continuous(q: Array) -> Array:
    """Quaternions with signs chosen so that neighbours are near: q and -q are one attitude."""
    flips = np.where(np.einsum("ij,ij->i", q[1:], q[:-1]) < 0.0, -1.0, 1.0)
    return q * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def _cubic(time: Array, value: Array, at: Array, i: NDArray[np.int64]) -> Array:
    """Values (m, c) at times (m,) in intervals i, by cubics with slopes from three points; constant outside."""
    step = np.diff(time)
    secant = np.diff(value, axis=0) / step[:, None]
    slope = np.empty_like(value)
    slope[0], slope[-1] = secant[0], secant[-1]
    before, after = step[:-1, None], step[1:, None]
    slope[1:-1] = (secant[:-1] * after + secant[1:] * before) / (before + after)
    h = step[i, None]
    u = np.clip((at - time[i])[:, None] / h, 0.0, 1.0)
    v = 1.0 - u
    ends = v * v * (1 + 2 * u) * value[i] + u * u * (1 + 2 * v) * value[i + 1]
    return np.asarray(ends + h * u * v * (v * slope[i] - u * slope[i + 1]), float)


def _sound(array: SignalArray) -> Flags:
    """(n,) samples that have a time and all components, with plausible sizes."""
    sound = np.isfinite(array.time)
    sound &= ~array.marked
    for column in range(array.value.shape[1]):  # a reduction over a short axis costs ten times as much
        sound &= np.abs(array.value[:, column]) < IMPOSSIBLE_VALUE  # false for NaN
    return sound


def _period(time: Array) -> float:
    steps = np.diff(time)
    steps = steps[steps > 0]
    return float(np.median(steps)) if steps.size else 0.0


def poses(recording: Recording) -> dict[str, SignalArray]:
    """Quaternions x y z w, body to world, of every attitude; if there is none, of every Euler angles (in radians)."""
    return measurements(recording, "attitude") or {
        name: replace(array, value=quaternion_from_euler(*array.value.T), quantity="attitude")
        for name, array in measurements(recording, "euler").items()
        if np.nanmax(np.abs(array.value)) <= 7.0
    }


LARGEST_LAG = 0.3  # s, largest lag of the search, on either side
COARSE_LAG_STEP = 3  # grid steps between lags tried at first
MOST_CORRELATION_ROWS = 4000  # most rows of the grid in a correlation
JACKKNIFE_REACH = 6  # grid steps by which a lag may move, on either side, when a block is left out
FEWEST_CORRELATION_ROWS = 45  # fewest rows of the grid in a correlation


@dataclass(frozen=True, slots=True)
class Delay:
    """Lag of the second track behind the first."""

    value: float  # s; positive where the second is late
    explained: float  # share of the variance of the second track that the first explains at this lag
    at_edge: bool  # the best lag is at the end of the range, so there is no maximum inside


def delay(first: Track, second: Track, *, reach: float = LARGEST_LAG, mixed: bool = True) -> Delay | None:
    """Lag of `second` behind `first`, (m, c) each; None if they have too few valid rows in common.

    Args:
        first, second: on one grid, smoothed with the same window.
        reach: s, largest lag on either side.
        mixed: explain each component of the second by all components of the first (any axes, signs and units); else
            by the same component with a free factor.
    """
    most = round(reach / GRID_STEP)
    steps = np.arange(-most, most + 1)
    curve = np.full(steps.size, np.nan)
    # a smoothed signal has no peak narrower than the window: every third lag finds the peak, its neighbours refine it
    for k in range(0, steps.size, COARSE_LAG_STEP):
        curve[k] = _explained(first, second, int(steps[k]), mixed)
    if not np.isfinite(curve).any():
        return None
    near = int(np.nanargmax(curve))
    for k in range(max(near - COARSE_LAG_STEP, 0), min(near + COARSE_LAG_STEP + 1, steps.size)):
        curve[k] = _explained(first, second, int(steps[k]), mixed)
    top = int(np.nanargmax(curve))
    edge = top in (0, steps.size - 1) or not np.isfinite(curve[top - 1 : top + 2]).all()
    place = float(steps[top])
    if not edge:
        place = place - 1.0 + _peak(curve[top - 1 : top + 2])
    return Delay(place * GRID_STEP, float(curve[top]), edge)


def _explained(first: Track, second: Track, steps: int, mixed: bool) -> float:
    """Share of the variance of second(t) that first(t - steps) explains; NaN with too few common rows."""
    x, y, _ = _common(first, second, steps)
    count = len(x)
    if count < FEWEST_CORRELATION_ROWS:
        return math.nan
    one = np.full(count, 1.0 / count)
    mx, my = one @ x, one @ y
    sxx = x.T @ x / count - np.outer(mx, mx)
    sxy = x.T @ y / count - np.outer(mx, my)
    syy = np.einsum("ij,ij->j", y, y) / count - my * my
    whole = float(syy.sum())
    if whole <= 0.0 or np.trace(sxx) <= 0.0:
        return math.nan
    if mixed:
        sxx = sxx + np.eye(len(sxx)) * (1e-9 * np.trace(sxx))
        got = float(np.einsum("ij,ij->", sxy, np.linalg.solve(sxx, sxy)))
    else:
        got = float((np.diag(sxy) ** 2 / np.maximum(np.diag(sxx), 1e-300)).sum())
    return got / whole


def _common(first: Track, second: Track, steps: int) -> tuple[Array, Array, NDArray[np.int64]]:
    """first(t - steps) and second(t), (n, c) each, at every second valid row t or fewer, and these rows (n,)."""
    n = len(first.value) - abs(steps)
    a, b = max(0, -steps), max(0, steps)
    stride = max(2, n // MOST_CORRELATION_ROWS)
    good = first.valid[a : a + n : stride] & second.valid[b : b + n : stride]
    x, y = first.value[a : a + n : stride][good], second.value[b : b + n : stride][good]
    return x, y, np.arange(b, b + n, stride)[good]


def spread(first: Track, second: Track, found: Delay, block_rows: int) -> tuple[float, int]:
    """Standard error [s] of a lag by leaving out one block at a time (jackknife), and the number of blocks.

    Args:
        first, second, found: arguments and result of `delay`.
        block_rows: grid steps of a block.
    """
    middle = round(found.value / GRID_STEP)
    steps = np.arange(middle - JACKKNIFE_REACH, middle + JACKKNIFE_REACH + 1)
    sums = np.array([_block_sums(first, second, int(k), block_rows) for k in steps])
    used = sums[:, :, 0, 0].min(axis=0) > 0
    sums = sums[:, used]
    count = int(used.sum())
    if count < 3:
        return math.inf, count
    total = sums.sum(axis=1)
    peaks = np.array([_peak(_share(total - sums[:, b])) for b in range(count)]) * GRID_STEP
    if peaks.min() <= 0.0 or peaks.max() >= 2 * JACKKNIFE_REACH * GRID_STEP:
        return math.inf, count
    return float(jackknife_error(peaks)), count


def _block_sums(first: Track, second: Track, steps: int, block_rows: int) -> Array:
    """(blocks, 6, c) sums of 1, x, y, xx, xy, yy of x = first(t - steps), y = second(t), by blocks of t."""
    x, y, rows = _common(first, second, steps)
    block, blocks = rows // block_rows, -(-len(first.value) // block_rows)
    parts = (np.ones_like(x), x, y, x * x, x * y, y * y)
    sums = [[np.bincount(block, weights=column, minlength=blocks) for column in part.T] for part in parts]
    return np.array(sums).transpose(2, 0, 1)


def _share(sums: Array) -> Array:
    """Explained share at each lag, from (lags, 6, c) sums."""
    n = np.maximum(sums[:, 0], 1.0)
    mx, my = sums[:, 1] / n, sums[:, 2] / n
    sxx, sxy, syy = sums[:, 3] / n - mx * mx, sums[:, 4] / n - mx * my, sums[:, 5] / n - my * my
    # a variance this small is the rounding error of sums that cancel
    still = (sxx <= 1e-12 * (sums[:, 3] / n)) | (syy <= 1e-12 * (sums[:, 5] / n))
    got = np.where(still, 0.0, sxy**2 / np.where(still, 1.0, sxx)).sum(axis=1)
    whole = np.where(still, 0.0, syy).sum(axis=1)
    return np.asarray(np.where(whole > 0.0, got / np.where(whole > 0.0, whole, 1.0), 0.0), float)


def _peak(curve: Array) -> float:
    """Position of the maximum in samples, from a parabola through three samples."""
    top = int(np.argmax(curve))
    if top in (0, curve.size - 1):
        return float(top)
    left, middle, right = curve[top - 1 : top + 2]
    bend = left - 2.0 * middle + right
    return top + (0.5 * (left - right) / bend if bend < 0.0 else 0.0)
