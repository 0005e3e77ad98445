"""How much later than its stamp a measured rotor speed acts: the clocks of two streams, set by the recording itself.

Rotor speeds and body rates reach a log by different ways, and each recording joins them with an offset of its own, of
either sign. It is no property of the drone, so it belongs to no vehicle file; but with 15 ms wrong, roll and pitch fed
back at some hertz do not fit any rigid body. It is found where the torque of the rotors explains most of the angular
acceleration, with rate and velocity beside it (damping, flapping) so that the loop around them is not taken for a
delay, in a band in which the drone shakes and sensors are not noise alone. Roll and pitch are judged apart: they share
the clock, so they must agree. A block in which something hit the drone says nothing of its rotors, and is left out.

Sums are kept by blocks of flight, so that a prediction can use what was known when it starts and no more.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.rotors import PITCH_SIGN, ROLL_SIGN
from crazyem.recordings.airborne import Airtime
from crazyem.recordings.ordering import inside, ordered
from crazyem.recordings.recording import Recording

REACH = 0.15  # s, on either side
STEP = 2.5e-3  # s between delays tried
GRID = 5e-3  # s between rows
BLOCK = 1.0  # s
BAND = (0.015, 0.1)  # s, widths of the Gaussians whose difference is the band: about 1.5 to 10 Hz
SUPPORT = 0.3  # s, half the length of the band's filter
LEAST = 4  # blocks
SURE = 4e-3  # s: a larger standard error, and nothing is said
AGREE = 6e-3  # s between roll and pitch
EXPLAINED = 0.1  # share of the acceleration's variance that the rotors must explain
PRIOR = 0.01  # s, of delays before anything was seen
# A block in which the drone was hit: so much more of its acceleration is unexplained than of the median block's (power;
# 172 at most in 23 files of real flights, 2652 where one came down). It would outweigh the flight.
BLOW = 300.0


@dataclass(frozen=True, eq=False)
class Alignment:
    """How late the rotors' thrust is behind the stamps of their speeds.

    Attributes:
        delay: s, by roll and pitch of the whole recording; positive: the rates answer later than the stamps say.
        sd: s.
        roll, pitch: s, each alone.
        explained: share of the variance of roll and pitch acceleration explained in the band.
        ends: (b,) s: when each block of flight is known.
        running: (b,) s: the delay by all blocks up to that one, drawn towards 0 while little is known.
    """

    delay: float
    sd: float
    roll: float
    pitch: float
    explained: float
    ends: NDArray
    running: NDArray

    def known_at(self, time: NDArray) -> NDArray:
        """(n,) s: the delay as known at times (n,) s; 0 before anything is."""
        at = np.searchsorted(self.ends, time, "right") - 1
        return np.where(at >= 0, self.running[np.maximum(at, 0)], 0.0)

    def said(self) -> str:
        """For people."""
        return (
            f"rotor speeds act {1e3 * self.delay:+.1f} ms after their stamps in this recording (roll "
            f"{1e3 * self.roll:+.1f}, pitch {1e3 * self.pitch:+.1f} ms); they are moved by that much"
        )


def align(recording: Recording, thrust_time: NDArray, thrust: NDArray, flight: Airtime | None) -> Alignment | None:
    """The delay of a recording's rotor speeds behind its body rates; None where the recording does not tell.

    Args:
        recording: with body rates.
        thrust_time: (m,) s.
        thrust: (m, 4) N.
        flight: when the drone flew.
    """
    if flight is None or not flight.flown or "body_rate" not in recording.signals or thrust_time.size < 100:
        return None
    when, rate = _fresh(*ordered(recording.signals["body_rate"]))
    thrust_time, thrust = _fresh(thrust_time, thrust)
    if when.size < 100 or thrust_time.size < 100:
        return None
    time = np.arange(max(when[0], thrust_time[0]), min(when[-1], thrust_time[-1]), GRID)
    if time.size < LEAST * BLOCK / GRID:
        return None
    kernel = _band()
    rates = _on(time, when, rate[:, :2])
    torque = _on(time, thrust_time, np.stack([thrust @ ROLL_SIGN, thrust @ PITCH_SIGN], 1))
    beside = [_filtered(rates, kernel)]
    if "velocity" in recording.signals:
        t, v = ordered(recording.signals["velocity"])
        if t.size > 2:
            speed = _filtered(_on(time, t, v), kernel)
            beside += [speed[:, [0]].repeat(2, 1), speed[:, [1]].repeat(2, 1)]
    acceleration = _filtered(np.gradient(rates, GRID, axis=0), kernel)
    shaken = _filtered(torque, kernel)
    margin = round((REACH + SUPPORT) / GRID)
    good = inside(time, flight.flown)
    good &= (_age(time, when) < 0.04) & (_age(time, thrust_time) < 0.04)
    good[:margin], good[len(good) - margin :] = False, False
    index = np.flatnonzero(good)
    if index.size * GRID < LEAST * BLOCK:
        return None
    block = np.unique(((time[index] - time[0]) / BLOCK).astype(int), return_inverse=True)[1]
    delays = np.arange(-REACH, REACH + STEP / 2, STEP)
    sums = np.stack([_sums(index, block, acceleration, shaken, beside, d) for d in delays], 2)  # axis, block, delay
    return _accepted(delays, sums, time[index], block)


def _fresh(time: NDArray, value: NDArray) -> tuple[NDArray, NDArray]:
    """Without rows that repeat the one before: a held value is no new sample."""
    new = np.concatenate([[True], np.any(np.diff(value, axis=0) != 0, axis=1)]) if time.size else np.ones(0, bool)
    return time[new], value[new]


def _on(time: NDArray, when: NDArray, value: NDArray) -> NDArray:
    return np.stack([np.interp(time, when, column) for column in value.T], 1)


def _age(time: NDArray, when: NDArray) -> NDArray:
    after = np.clip(np.searchsorted(when, time), 1, when.size - 1)
    return when[after] - when[after - 1]


def _band() -> NDArray:
    """A difference of Gaussians of zero sum, of finite length."""
    t = np.arange(-round(SUPPORT / GRID), round(SUPPORT / GRID) + 1) * GRID
    narrow, wide = (np.exp(-0.5 * np.square(t / width)) for width in BAND)
    return narrow / narrow.sum() - wide / wide.sum()


def _filtered(value: NDArray, kernel: NDArray) -> NDArray:
    return np.stack([np.convolve(column, kernel, "same") for column in value.T], 1)


def _sums(
    index: NDArray, block: NDArray, wanted: NDArray, torque: NDArray, beside: list[NDArray], delay: float
) -> NDArray:
    """(2, blocks, k + 2, k + 2) sums of products of [torque(t - delay), beside, wanted], for roll and pitch."""
    steps = delay / GRID
    low = int(np.floor(steps))
    part = steps - low
    out = []
    for axis in range(2):
        moved = (1 - part) * torque[index - low, axis] + part * torque[index - low - 1, axis]
        rows = np.stack([moved, *(b[index, axis] for b in beside), wanted[index, axis]], 1)
        products = np.einsum("ni,nj->nij", rows, rows).reshape(len(rows), -1)
        total = np.stack([np.bincount(block, weights=column) for column in products.T], 1)
        out.append(total.reshape(-1, rows.shape[1], rows.shape[1]))
    return np.stack(out)


def _share(sums: NDArray) -> NDArray:
    """Share (..., delays) of the wanted that torque explains beyond what is beside it, from (..., delays, k, k)."""
    size = sums.shape[-1] - 1
    whole = np.maximum(sums[..., size, size], 1e-300)
    a = sums[..., :size, :size]
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", a), 1e-300))
    a = a / (scale[..., :, None] * scale[..., None, :]) + 1e-9 * np.eye(size)
    b = sums[..., :size, size] / scale
    got = np.linalg.solve(a, b[..., None])[..., 0]
    gain = np.where(got[..., 0] > 0, 1.0, 0.0)  # torque turns the drone the way it points
    rest = np.linalg.solve(a[..., 1:, 1:], b[..., 1:, None])[..., 0]
    return gain * (np.sum(got * b, -1) - np.sum(rest * b[..., 1:], -1)) / whole


def _peak(delays: NDArray, curve: NDArray) -> float:
    """Delay of the maximum, between those tried by a parabola; NaN at the edge."""
    top = int(np.argmax(curve))
    if top in (0, curve.size - 1) or curve[top] <= 0:
        return float("nan")
    left, middle, right = curve[top - 1 : top + 2]
    bend = left - 2 * middle + right
    return float(delays[top] + STEP * (0.5 * (left - right) / bend if bend < 0 else 0.0))


def _both(delays: NDArray, sums: NDArray) -> tuple[float, float]:
    """Delay by roll and pitch together, from (2, delays, k, k), and the share explained."""
    share = _share(sums)
    whole = sums[:, 0, -1, -1]
    curve = (share * whole[:, None]).sum(0) / max(float(whole.sum()), 1e-300)
    return _peak(delays, curve), float(curve.max())


def _unhit(delays: NDArray, sums: NDArray) -> NDArray:
    """(2, b, delays, k, k): the blocks in which nothing hit the drone."""
    total = sums.sum(1)
    delay, _ = _both(delays, total)
    at = int(np.argmin(np.abs(delays - delay))) if np.isfinite(delay) else delays.size // 2
    left = np.empty(sums.shape[:2])
    for axis in range(2):
        a = total[axis, at]
        scale = np.sqrt(np.maximum(np.diag(a), 1e-300))
        a = a / np.outer(scale, scale) + 1e-9 * np.eye(len(a))
        weights = np.append(-np.linalg.solve(a[:-1, :-1], a[:-1, -1]) * scale[-1] / scale[:-1], 1.0)
        left[axis] = np.einsum("i,bij,j->b", weights, sums[axis, :, at], weights)
    usual = np.median(left, axis=1, keepdims=True)
    kept: NDArray = sums[:, np.all(left <= BLOW * np.maximum(usual, 1e-300), axis=0)]
    return kept


def _accepted(delays: NDArray, sums: NDArray, time: NDArray, block: NDArray) -> Alignment | None:
    count = sums.shape[1]
    if count < LEAST:
        return None
    unhit = _unhit(delays, sums)
    total = unhit.sum(1)
    delay, explained = _both(delays, total)
    roll, pitch = (_peak(delays, _share(total[i])) for i in range(2))
    sd = _error(delays, unhit, total)
    told = np.isfinite([delay, roll, pitch]).all() and explained > EXPLAINED and sd < SURE
    if not told or abs(roll - pitch) > AGREE + 3 * sd:
        return None
    ends = np.array([time[block == b][-1] for b in range(count)]) + SUPPORT + REACH
    running = np.zeros(count)
    looked_at = set(np.unique(np.geomspace(LEAST, count, 16).astype(int) - 1).tolist())
    for b in range(LEAST - 1, count):
        if b not in looked_at:
            running[b] = running[b - 1]
            continue
        until = _unhit(delays, sums[:, : b + 1])
        before = until.sum(1)
        found, _ = _both(delays, before)
        error = _error(delays, until, before)
        sound = np.isfinite(found) and np.isfinite(error)
        running[b] = found * PRIOR**2 / (PRIOR**2 + error**2) if sound else running[b - 1]
    return Alignment(delay, sd, roll, pitch, explained, ends, running)


def _error(delays: NDArray, sums: NDArray, total: NDArray) -> float:
    """Standard error of the delay, each of up to 12 groups of blocks left out (jackknife)."""
    groups = np.array_split(np.arange(sums.shape[1]), min(12, sums.shape[1]))
    found = np.array([_both(delays, total - sums[:, g].sum(1))[0] for g in groups])
    if not np.isfinite(found).all():
        return float("inf")
    n = len(groups)
    return float(np.sqrt((n - 1) / n * np.square(found - found.mean()).sum()))
