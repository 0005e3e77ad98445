"""The delay of measured rotor speeds behind body rates: the offset of the clocks of two streams in a recording.

Rotor speeds and body rates reach a log on different ways, so each recording has its own offset, of either sign. It is
no property of the drone, so no vehicle file has it. But with an error of 15 ms, roll and pitch under feedback at some
hertz fit no rigid body.

The delay is where the torque of the rotors explains most of the angular acceleration, in a band in which the drone
shakes and sensors show more than noise. Noise in either makes this share smaller, but does not move the delay. Rate and
velocity are regressors, too (damping, flapping), so that the control loop does not look like a delay. Roll and pitch
have the same clock, so their separate delays must agree. Blocks with a collision are left out. Sums are kept by blocks,
so that a jackknife gives the standard error, and a prediction can use the flight before its start only.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.settings import CLOCKS, RECORDINGS
from crazyem.physics.rotors import PITCH_SIGN, ROLL_SIGN
from crazyem.recordings.airborne import Airtime
from crazyem.recordings.ordering import inside, ordered
from crazyem.recordings.recording import Recording


def delays_within(reach: float) -> NDArray:
    """(d,) s: delays to try, up to `reach` [s] on either side."""
    return np.arange(-reach, reach + CLOCKS.step / 2, CLOCKS.step)


def on_grid(time: NDArray, when: NDArray, value: NDArray) -> NDArray:
    """(n, k): columns of value (m, k) with stamps `when` (m,) s, interpolated at times (n,) s."""
    return np.stack([np.interp(time, when, column) for column in value.T], 1)


def spacing(time: NDArray, when: NDArray) -> NDArray:
    """(n,) s between the stamps (m,) on either side of times (n,)."""
    after = np.clip(np.searchsorted(when, time), 1, when.size - 1)
    return when[after] - when[after - 1]


def band_passed(value: NDArray) -> NDArray:
    """(n, k): columns on the grid, in the band: filtered by a difference of Gaussians of zero sum, of finite length."""
    half = round(CLOCKS.filter_half / CLOCKS.grid)
    t = np.arange(-half, half + 1) * CLOCKS.grid
    narrow, wide = (np.exp(-0.5 * np.square(t / width)) for width in CLOCKS.band)
    kernel = narrow / narrow.sum() - wide / wide.sum()
    return np.stack([np.convolve(column, kernel, "same") for column in value.T], 1)


def products(
    index: NDArray, block: NDArray, wanted: NDArray, cause: NDArray, beside: list[NDArray], delay: float
) -> NDArray:
    """(axes, blocks, k + 2, k + 2) sums of products of [cause(t - delay), beside, wanted], for each axis.

    Args:
        index: (r,) rows of the grid. block: (r,) their blocks.
        wanted, cause: (n, axes). beside: (n, axes) each, other regressors of the wanted series.
    """
    steps = delay / CLOCKS.grid
    low = int(np.floor(steps))
    part = steps - low
    out = []
    for axis in range(wanted.shape[1]):
        moved = (1 - part) * cause[index - low, axis] + part * cause[index - low - 1, axis]
        rows = np.stack([moved, *(b[index, axis] for b in beside), wanted[index, axis]], 1)
        squares = np.einsum("ni,nj->nij", rows, rows).reshape(len(rows), -1)
        total = np.stack([np.bincount(block, weights=column) for column in squares.T], 1)
        out.append(total.reshape(-1, rows.shape[1], rows.shape[1]))
    return np.stack(out)


def explained_share(sums: NDArray) -> NDArray:
    """Share (..., delays) of the wanted series that its cause explains beyond the other regressors.

    sums: (..., delays, k, k).
    """
    size = sums.shape[-1] - 1
    whole = np.maximum(sums[..., size, size], 1e-300)
    a = sums[..., :size, :size]
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", a), 1e-300))
    a = a / (scale[..., :, None] * scale[..., None, :]) + 1e-9 * np.eye(size)
    b = sums[..., :size, size] / scale
    got = np.linalg.solve(a, b[..., None])[..., 0]
    gain = np.where(got[..., 0] > 0, 1.0, 0.0)  # a cause has a positive coefficient
    rest = np.linalg.solve(a[..., 1:, 1:], b[..., 1:, None])[..., 0]
    return gain * (np.sum(got * b, -1) - np.sum(rest * b[..., 1:], -1)) / whole


def peak(delays: NDArray, curve: NDArray) -> float:
    """Delay of the maximum, interpolated by a parabola; NaN at the edge."""
    top = int(np.argmax(curve))
    if top in (0, curve.size - 1) or curve[top] <= 0:
        return float("nan")
    left, middle, right = curve[top - 1 : top + 2]
    bend = left - 2 * middle + right
    return float(delays[top] + CLOCKS.step * (0.5 * (left - right) / bend if bend < 0 else 0.0))


def delay_of(delays: NDArray, sums: NDArray) -> tuple[float, float]:
    """Delay [s] by all axes together, from sums (axes, delays, k, k), and the explained share."""
    share = explained_share(sums)
    whole = sums[:, 0, -1, -1]
    curve = (share * whole[:, None]).sum(0) / max(float(whole.sum()), 1e-300)
    return peak(delays, curve), float(curve.max())


def standard_error(delays: NDArray, sums: NDArray, total: NDArray) -> float:
    """Standard error of the delay [s]: each of up to 12 groups of blocks left out (jackknife).

    sums: (axes, blocks, delays, k, k). total: (axes, delays, k, k).
    """
    groups = np.array_split(np.arange(sums.shape[1]), min(12, sums.shape[1]))
    found = np.array([delay_of(delays, total - sums[:, g].sum(1))[0] for g in groups])
    if not np.isfinite(found).all():
        return float("inf")
    n = len(groups)
    return float(np.sqrt((n - 1) / n * np.square(found - found.mean()).sum()))


@dataclass(frozen=True, eq=False)
class Alignment:
    """The delay of the thrust of the rotors behind the stamps of their speeds.

    Attributes:
        delay: s, by roll and pitch of the whole recording; positive: the rates answer later than the stamps say.
        sd: s.
        roll, pitch: s, by one axis alone.
        explained: share of the variance of roll and pitch acceleration explained in the band.
        ends: (b,) s, time from which each block of flight is known.
        running: (b,) s, the delay by all blocks up to this one, shrunk towards 0 by its standard error.
    """

    delay: float
    sd: float
    roll: float
    pitch: float
    explained: float
    ends: NDArray
    running: NDArray

    def known_at(self, time: NDArray) -> NDArray:
        """(n,) s, the delay by the flight before times (n,) s; 0 before the first block."""
        at = np.searchsorted(self.ends, time, "right") - 1
        return np.where(at >= 0, self.running[np.maximum(at, 0)], 0.0)

    def description(self) -> str:
        """For people."""
        return (
            f"rotor speeds act {1e3 * self.delay:+.1f} ms after their stamps in this recording (roll "
            f"{1e3 * self.roll:+.1f}, pitch {1e3 * self.pitch:+.1f} ms); they are moved by that much"
        )


def align(recording: Recording, thrust_time: NDArray, thrust: NDArray, flight: Airtime | None) -> Alignment | None:
    """The delay of the rotor speeds behind the body rates of a recording; None if it is not determined.

    Args:
        recording: with body rates.
        thrust_time: (m,) s.
        thrust: (m, 4) N.
        flight: times in the air.
    """
    if flight is None or not flight.flown or "body_rate" not in recording.signals or thrust_time.size < 100:
        return None
    when, rate = _without_repeats(*ordered(recording.signals["body_rate"]))
    thrust_time, thrust = _without_repeats(thrust_time, thrust)
    if when.size < 100 or thrust_time.size < 100:
        return None
    time = np.arange(max(when[0], thrust_time[0]), min(when[-1], thrust_time[-1]), CLOCKS.grid)
    if time.size < CLOCKS.min_blocks * RECORDINGS.block / CLOCKS.grid:
        return None
    rates = on_grid(time, when, rate[:, :2])
    torque = on_grid(time, thrust_time, np.stack([thrust @ ROLL_SIGN, thrust @ PITCH_SIGN], 1))
    beside = [band_passed(rates)]
    if "velocity" in recording.signals:
        t, v = ordered(recording.signals["velocity"])
        if t.size > 2:
            speed = band_passed(on_grid(time, t, v))
            beside += [speed[:, [0]].repeat(2, 1), speed[:, [1]].repeat(2, 1)]
    acceleration = band_passed(np.gradient(rates, CLOCKS.grid, axis=0))
    shaken = band_passed(torque)
    margin = round((CLOCKS.max_delay + CLOCKS.filter_half) / CLOCKS.grid)
    good = inside(time, flight.flown)
    good &= (spacing(time, when) < 0.04) & (spacing(time, thrust_time) < 0.04)
    good[:margin], good[len(good) - margin :] = False, False
    index = np.flatnonzero(good)
    if index.size * CLOCKS.grid < CLOCKS.min_blocks * RECORDINGS.block:
        return None
    block = np.unique(((time[index] - time[0]) / RECORDINGS.block).astype(int), return_inverse=True)[1]
    delays = delays_within(CLOCKS.max_delay)
    sums = np.stack([products(index, block, acceleration, shaken, beside, d) for d in delays], 2)
    return _accepted(delays, sums, time[index], block)


def _without_repeats(time: NDArray, value: NDArray) -> tuple[NDArray, NDArray]:
    """The samples without rows that repeat the row before: a held value is no new sample."""
    new = np.concatenate([[True], np.any(np.diff(value, axis=0) != 0, axis=1)]) if time.size else np.ones(0, bool)
    return time[new], value[new]


def _without_collisions(delays: NDArray, sums: NDArray) -> NDArray:
    """(2, b, delays, k, k): the sums of blocks without a collision."""
    total = sums.sum(1)
    delay, _ = delay_of(delays, total)
    at = int(np.argmin(np.abs(delays - delay))) if np.isfinite(delay) else delays.size // 2
    left = np.empty(sums.shape[:2])
    for axis in range(2):
        a = total[axis, at]
        scale = np.sqrt(np.maximum(np.diag(a), 1e-300))
        a = a / np.outer(scale, scale) + 1e-9 * np.eye(len(a))
        weights = np.append(-np.linalg.solve(a[:-1, :-1], a[:-1, -1]) * scale[-1] / scale[:-1], 1.0)
        left[axis] = np.einsum("i,bij,j->b", weights, sums[axis, :, at], weights)
    usual = np.median(left, axis=1, keepdims=True)
    kept: NDArray = sums[:, np.all(left <= CLOCKS.collision * np.maximum(usual, 1e-300), axis=0)]
    return kept


def _accepted(delays: NDArray, sums: NDArray, time: NDArray, block: NDArray) -> Alignment | None:
    count = sums.shape[1]
    if count < CLOCKS.min_blocks:
        return None
    unhit = _without_collisions(delays, sums)
    total = unhit.sum(1)
    delay, explained = delay_of(delays, total)
    roll, pitch = (peak(delays, explained_share(total[i])) for i in range(2))
    sd = standard_error(delays, unhit, total)
    determined = (
        np.isfinite([delay, roll, pitch]).all() and explained > CLOCKS.min_explained and sd < CLOCKS.max_delay_sd
    )
    if not determined or abs(roll - pitch) > CLOCKS.axis_difference + 3 * sd:
        return None
    ends = np.array([time[block == b][-1] for b in range(count)]) + CLOCKS.filter_half + CLOCKS.max_delay
    running = np.zeros(count)
    looked_at = set(np.unique(np.geomspace(CLOCKS.min_blocks, count, 16).astype(int) - 1).tolist())
    for b in range(CLOCKS.min_blocks - 1, count):
        if b not in looked_at:
            running[b] = running[b - 1]
            continue
        until = _without_collisions(delays, sums[:, : b + 1])
        before = until.sum(1)
        found, _ = delay_of(delays, before)
        error = standard_error(delays, until, before)
        sound = np.isfinite(found) and np.isfinite(error)
        running[b] = found * CLOCKS.delay_sd**2 / (CLOCKS.delay_sd**2 + error**2) if sound else running[b - 1]
    return Alignment(delay, sd, roll, pitch, explained, ends, running)
