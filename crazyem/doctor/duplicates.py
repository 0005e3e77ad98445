"""Flights that are in a folder twice: whole or trimmed copies, with other clocks, units or formats.

A fingerprint is a set of hashes from turning points: instants at which a measured channel is highest or lowest among
its neighbours. Three of them in a row give two time spans and the ratio of two changes of value. Rounded, these make a
hash. It does not depend on the clock's offset or on the unit, sign or offset of the channel, and noise makes it rare.
Copies of one flight share many hashes at one time offset. Two flights along one trajectory share some, at many time
offsets. Setpoints are left out: they are equal in different flights.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.ordering import Array, sound_samples
from crazyem.recordings.recording import Recording, SignalArray

Hashes = NDArray[np.uint32]

TURNING_POINT_NEIGHBOURS = 6  # samples on each side that a turning point is compared with
SPAN_STEP = 0.005  # s, rounding of the spans
RATIO_STEP = 0.1  # rounding of the logarithm of the ratio; each ratio is rounded twice, half a step apart
HASHES_PER_SECOND = 40.0  # most hashes kept per second; their value decides, so copies keep the same ones
MOST_HASHES = 60_000  # most hashes kept of one flight
LARGE_GROUP = 16  # entries with one hash; in larger groups not every pair is compared
TIME_TOLERANCE = 0.02  # s, largest difference of time offsets that agree
FEWEST_COMMON_HASHES = 20  # least number of common hashes at one time offset
LEAST_COMMON_SHARE = 0.15  # least share of common hashes in the common stretch
_CHANNELS = 12
_CHANNELS_LARGE = 5  # for recordings with more than _LARGE_CHANNEL_ROWS rows a channel
_LARGE_CHANNEL_ROWS = 150_000
_PREFERRED_SIGNALS = (
    "body_rate", "specific_force", "motor_command", "velocity", "position", "rotor_speed", "attitude", "motor_request",
    "mixer_command", "acceleration", "euler",
)  # fmt: skip
_IGNORED_SIGNALS = ("setpoint", "sp_", "ctrltarget", "ref")


@dataclass(frozen=True, slots=True, eq=False)
class Fingerprint:
    """Hashes by which a flight is recognised."""

    path: str  # of the recording
    start_s: float  # of its time axis
    end_s: float
    hashes: Hashes  # (n,), see the module
    times: Array  # (n,) s, the time of each hash


@dataclass(frozen=True, slots=True)
class Duplicate:
    """Two recordings of one flight."""

    first: str  # path of the longer recording
    second: str
    overlap_s: float  # length of the common stretch
    offset_s: float  # time in the second recording less time in the first, at one instant
    share_first: float  # common share of the first recording
    share_second: float
    start_s: float  # of the common stretch, on the time axis of the first
    end_s: float
    matches: int  # number of common hashes

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def finding(self) -> Finding:
        """The duplicate as a finding, on the time axis of the first recording."""
        if self.share_first > 0.98 and self.share_second > 0.98:
            what = f"{self.second} is the same flight as {self.first}"
        elif self.share_second > 0.98:
            what = f"{self.second} is a part of {self.first}"
        else:
            what = f"{self.second} and {self.first} have a part in common"
        text = f"{what}: {self.overlap_s:.1f} s, {self.offset_s:+.3f} s apart on their time axes."
        names = ("overlap_s", "offset_s", "share_first", "share_second", "matches")
        evidence = {name: getattr(self, name) for name in names}
        advice = "Use one of them only: as two they count one flight twice, in training and test they leak."
        return Finding("duplicate", Grade.DEGRADES, text, "", ((self.start_s, self.end_s),), evidence, advice)


def fingerprint(recording: Recording) -> Fingerprint:
    """The fingerprint of a recording; empty without noisy measurements, and then it matches nothing."""
    none = (np.zeros(0, np.uint32), np.zeros(0))
    hashes, times = zip(none, *(_numbers(time, value) for time, value in _channels(recording)))
    hashed, at = np.concatenate(hashes), np.concatenate(times)
    stamps = [a.time[np.isfinite(a.time)] for a in recording.signals.values()]
    stamps = [t for t in stamps if t.size]
    start = min((float(t.min()) for t in stamps), default=0.0)
    end = max((float(t.max()) for t in stamps), default=0.0)
    if at.size:
        rate = at.size / max(end - start, 1.0)
        thin = max(0, math.ceil(math.log2(rate / HASHES_PER_SECOND))) if rate > HASHES_PER_SECOND else 0
        while hashed.size * 2.0**-thin > MOST_HASHES:
            thin += 1
        keep = hashed < np.uint32(min(2.0 ** (32 - thin), 2.0**32 - 1))
        hashed, at = hashed[keep], at[keep]
    return Fingerprint(recording.path, start, end, hashed, at)


def find_duplicates(fingerprints: Iterable[Fingerprint]) -> list[Duplicate]:
    """Pairs of recordings of one flight, the longest common stretch first.

    Each of several copies is paired with the longest one only.
    """
    prints = sorted(fingerprints, key=lambda p: (p.start_s - p.end_s, p.path))
    votes = _votes(prints)
    found: list[Duplicate] = []
    partners: dict[int, set[int]] = {}
    for (a, b), offsets in sorted(votes.items()):
        if partners.get(a, set()) & partners.get(b, set()):
            continue
        duplicate = _judge(prints[a], prints[b], offsets)
        if duplicate is not None:
            found.append(duplicate)
            partners.setdefault(b, set()).add(a)
    return sorted(found, key=lambda d: (-d.overlap_s, d.first, d.second))


def _channels(recording: Recording) -> list[tuple[Array, Array]]:
    """Times (n,) and values (n,) of the channels to use, known measurements first."""
    chosen: list[tuple[Array, Array]] = []
    for name, array in sorted(recording.signals.items(), key=lambda item: _rank(*item)):
        low = f".{name.lower()}"
        ignored = array.quantity.startswith("setpoint") or any(f".{word}" in low for word in _IGNORED_SIGNALS)
        found = None if ignored else sound_samples(array)
        if found is None or found[0].size < 8 * TURNING_POINT_NEIGHBOURS:
            continue
        time, value = found
        for column in value.T:
            if len(chosen) >= (_CHANNELS_LARGE if time.size > _LARGE_CHANNEL_ROWS else _CHANNELS):
                return chosen
            chosen.append((time, column))
    return chosen


def _rank(name: str, array: SignalArray) -> tuple[int, str]:
    known = [*_PREFERRED_SIGNALS, array.quantity]
    return 2 * known.index(array.quantity) + ("@" in name), name


def _numbers(time: Array, value: Array) -> tuple[Hashes, Array]:
    """The hashes (n,) of one channel and their times (n,)."""
    fresh = np.append(True, value[1:] != value[:-1])  # held values are one sample
    time, value = time[fresh], value[fresh]
    if value.size < 4 * TURNING_POINT_NEIGHBOURS:
        return np.zeros(0, np.uint32), np.zeros(0)
    size = 2 * TURNING_POINT_NEIGHBOURS + 1
    turning = (value == maximum_filter1d(value, size)) | (value == minimum_filter1d(value, size))
    # an extreme at an end may be none in a longer copy
    turning[:TURNING_POINT_NEIGHBOURS] = turning[-TURNING_POINT_NEIGHBOURS:] = False
    t, v = time[turning], value[turning]
    if t.size < 3:
        return np.zeros(0, np.uint32), np.zeros(0)
    spans, steps = np.round(np.diff(t) / SPAN_STEP), np.diff(v)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(np.abs(steps[1:] / steps[:-1])) / RATIO_STEP
    good = np.isfinite(ratio) & (np.abs(ratio) < 1e3) & (spans[1:] < 1e5) & (spans[:-1] < 1e5)
    against = (steps[1:] * steps[:-1] < 0.0)[good].astype(np.uint64)
    parts = []
    for shifted in (0, 1):
        rounded = np.floor(ratio[good] + 0.5 * shifted).astype(np.int64) + 2_000
        words = (spans[:-1][good].astype(np.uint64), spans[1:][good].astype(np.uint64), rounded.astype(np.uint64))
        parts.append(_mixed(*words, 2 * against + np.uint64(shifted)))
    return np.concatenate(parts), np.tile(t[1:-1][good], 2)


def _mixed(*words: NDArray[np.uint64]) -> Hashes:
    """A 32-bit hash of some words, by multiplications by odd constants; the overflow is intended."""
    state = np.full(words[0].shape, 0x9E3779B97F4A7C15, np.uint64)
    for word in words:
        state = (state ^ word) * np.uint64(0xBF58476D1CE4E5B9)
        state ^= state >> np.uint64(29)
        state *= np.uint64(0x94D049BB133111EB)
        state ^= state >> np.uint64(32)
    return (state & np.uint64(0xFFFFFFFF)).astype(np.uint32)


def _votes(prints: Sequence[Fingerprint]) -> dict[tuple[int, int], Array]:
    """For each pair of fingerprints with enough common hashes, the time offsets (n,) of these."""
    if not prints:
        return {}
    owner = np.repeat(np.arange(len(prints)), [p.hashes.size for p in prints])
    hashes = np.concatenate([p.hashes for p in prints])
    times = np.concatenate([p.times for p in prints])
    place = np.lexsort((owner, hashes))
    hashes, owner, times = hashes[place], owner[place], times[place]
    edges = np.flatnonzero(np.append(True, hashes[1:] != hashes[:-1]))
    start = np.repeat(edges, np.diff(np.append(edges, hashes.size)))
    rows = np.arange(hashes.size)
    firsts, seconds = [], []
    for back in range(1, LARGE_GROUP):  # pair each entry with those before it in its group
        other = rows - back
        inside = other >= start
        if not inside.any():
            break
        firsts.append(other[inside])
        seconds.append(rows[inside])
    far = rows - start >= LARGE_GROUP  # in large groups, with the first
    firsts.append(start[far])
    seconds.append(rows[far])
    a, b = np.concatenate(firsts), np.concatenate(seconds)
    apart = owner[a] != owner[b]
    a, b = a[apart], b[apart]
    pair = owner[a].astype(np.int64) * len(prints) + owner[b]
    distance = times[b] - times[a]
    place = np.argsort(pair, kind="stable")
    pair, distance = pair[place], distance[place]
    pairs, edges = np.unique(pair, return_index=True)
    parts = zip(pairs, np.split(distance, edges[1:]))
    return {divmod(int(p), len(prints)): np.sort(part) for p, part in parts if part.size >= FEWEST_COMMON_HASHES}


def _judge(first: Fingerprint, second: Fingerprint, distances: Array) -> Duplicate | None:
    """The duplicate if enough hashes agree at one time offset, else None."""
    upper = np.searchsorted(distances, distances + TIME_TOLERANCE, "right")
    counts = upper - np.arange(distances.size)
    best = int(np.argmax(counts))
    if counts[best] < FEWEST_COMMON_HASHES:
        return None
    offset = float(np.median(distances[best : upper[best]]))
    start = max(first.start_s, second.start_s - offset)
    end = min(first.end_s, second.end_s - offset)
    if not end > start:
        return None
    matched, seen = _matches(first, second, offset)
    if matched.size < FEWEST_COMMON_HASHES:
        return None
    # the stretch reaches to the ends of the files, unless the common hashes end long before
    reach = 5.0 * max(float(np.median(np.diff(np.sort(matched)))), 0.2)
    low = start if matched.min() - start < max(reach, 2.0) else float(matched.min())
    high = end if end - matched.max() < max(reach, 2.0) else float(matched.max())
    inside = (seen >= low) & (seen <= high)
    if not high > low or matched.size < LEAST_COMMON_SHARE * inside.sum():
        return None
    length = high - low
    share_first, share_second = (min(length / max(one.end_s - one.start_s, 1e-9), 1.0) for one in (first, second))
    paths = (first.path, second.path)
    return Duplicate(*paths, length, offset, share_first, share_second, low, high, int(matched.size))


def _matches(first: Fingerprint, second: Fingerprint, offset: float) -> tuple[Array, Array]:
    """Times in the first of common hashes at this offset, and of all hashes of the print with fewer per second."""
    keys = [p.hashes.astype(np.int64) for p in (first, second)]
    place = np.lexsort((second.times, keys[1]))
    hashes, times = keys[1][place], second.times[place] - offset
    # one search for hash and time: hashes are integers, times are scaled to fractions
    scale = 1.0 / (4.0 * (abs(first.end_s - first.start_s) + abs(second.end_s - second.start_s) + abs(offset) + 1.0))
    middle = 0.5 * (first.start_s + first.end_s)
    sorted_keys = hashes + scale * (times - middle)
    wanted = keys[0] + scale * (first.times - middle)
    near = np.searchsorted(sorted_keys, wanted)
    hit = np.zeros(first.times.size, bool)
    for side in (near - 1, near):
        at = np.clip(side, 0, max(hashes.size - 1, 0))
        hit |= (hashes[at] == keys[0]) & (np.abs(times[at] - first.times) < TIME_TOLERANCE)
    rates = [one.times.size / max(one.end_s - one.start_s, 1.0) for one in (first, second)]
    return first.times[hit], first.times if rates[0] <= rates[1] else second.times - offset
