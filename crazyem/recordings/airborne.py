"""When a recorded drone is in the air, what says so, and why: the one function that every command asks.

Rotors that carry, the firmware's flying flag, the height and impacts are used as far as the recording has them. The
live gate of the estimator (`estimation/contact.py`) cannot look ahead, so it may differ by fractions of a second.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from crazyem.recordings.finding import intervals_of
from crazyem.recordings.ordering import Array, Flags, Intervals, common, inside, ordered, thinned
from crazyem.recordings.recording import Recording

SHORTEST_FLIGHT = 0.4  # s of lift; less is a hop or a test of the rotors
LONGEST_FALL = 0.6  # s without lift that a manoeuvre may have
LONGEST_SILENCE = 1.0  # s without a sample (or five periods) after which nobody knows whether the drone still flew
LIFTED_HEIGHT, CLEAR_HEIGHT = 0.03, 0.1  # m above the ground: in the air; and surely so,
BOUNCE_SHARE = 0.25  # or this share of the greatest height: a hard landing throws a drone up by 0.12 m, from 1 m
# s at rest, just before and after a flight, that show the floor: the height of an onboard filter drifts
FLOOR_SECONDS = 1.0
LEAST_CLIMB = 0.15  # m of height that a flight told by its height alone must show
# A drone rests where means of 0.25 s stay within 2 mm for 1 s. In 43 recorded flights they stay within 1 mm on the
# ground (motion capture, Lighthouse, onboard filters) and move by 3 mm or more in hover. Three standard errors of a
# mean are allowed where the position is noisy (flow deck: 14 mm), and its resolution where that is coarse.
MEAN_SECONDS, REST_SECONDS, STILL_HEIGHT, STILL_STANDARD_ERRORS = 0.25, 1.0, 0.002, 3.0  # s, s, m, standard errors
IMPACT_FORCE = 40.0  # m/s^2 of specific force, twice what rotors can do: the drone hit something
AFTER_IMPACT, AROUND_IMPACT = 1.5, 0.25  # s before the end from which an impact is the end; s that it lasts
# No signal of a drone is larger (SI; the fastest rotors reach 6e3 rad/s): a sample beyond is an error of transmission.
LARGEST_COMMAND = {"rotor_speed": 8000.0, "motor_command": 1.5, "motor_request": 1.5}
# Least of (about) thrust, in the square of the signal's unit for duty and speed, below which rotors are off.
_OFF_COMMAND = {"motor_command": 0.03, "motor_request": 0.1, "rotor_speed": 200.0**2, "mixer_command": 3000.0}
_ROTOR_SIGNALS = ("motor_command", "motor_request", "rotor_speed", "wrench_command", "mixer_command")
_RAW_MOTORS = ("motor.m1", "motor.m2", "motor.m3", "motor.m4")
_FEWEST_SAMPLES = 10  # samples of a signal that says something


@dataclass(frozen=True, slots=True)
class Airtime:
    """When the drone flew.

    Attributes:
        flown: intervals in the air [s]; all of the recording where nothing tells (`known` is False).
        airborne: the same with bounces before the climb and after the descent: the floor may push in it.
        lifting: intervals in which the rotors carried about the weight; as `airborne` where no rotors are known.
        judged_by: names of the signals that were used; () if none could tell.
        reason: why nothing was flown, one clause; "" if something was.
        ground: height of the ground in the frame of the position [m]; NaN where unknown.
        climbed: m, range of height; NaN without a position.
        begin, end: s, of what was judged by.
    """

    airborne: Intervals
    flown: Intervals
    lifting: Intervals
    judged_by: tuple[str, ...]
    reason: str = ""
    ground: float = math.nan
    climbed: float = math.nan
    begin: float = math.nan
    end: float = math.nan

    @property
    def known(self) -> bool:
        """Whether any signal tells."""
        return bool(self.judged_by)

    @property
    def by_height_alone(self) -> bool:
        """Whether nothing says what the rotors did."""
        return not set(self.judged_by) - {"flying", "position"}

    @property
    def seconds(self) -> float:
        """Time in the air [s]."""
        return float(sum(end - start for start, end in self.flown))

    def covers(self, time: Array) -> Flags:
        """(n,) whether each time is in the air."""
        return inside(time, self.flown)


def airtime(recording: Recording) -> Airtime:
    """When a recording is in the air. Never raises: where no signal tells, all of the recording counts."""
    place = _position(recording)
    rotors = _rotors(recording, moved=place is not None)
    found = None
    if rotors is not None:
        found = _from_rotors(*rotors)
        if place is None:
            found = _without_impacts(found, recording)
        else:
            found = _beyond_rotors(_above_ground(found, place[0], place[1][:, 2]), *place)
    elif place is not None:
        found = _from_height(*place)
    return _flagged(found, recording) or Airtime(_all_time(recording), _all_time(recording), (), ())


# -- rotors -----------------------------------------------------------------------------------------------------------


def _rotors(recording: Recording, *, moved: bool) -> tuple[str, Array, Array] | None:
    """(signal, times (n,), (n, c)) of the first signal that says how hard the rotors work.

    A speed sensor that reads 0 throughout may not be connected; it is not asked where a position (`moved`) tells.
    """
    for name in _ROTOR_SIGNALS:
        if name in recording.signals:
            time, value = ordered(thinned(recording.signals[name]))
            dead = name == "rotor_speed" and not value.any()
            if time.size > _FEWEST_SAMPLES and not (dead and (moved or "flying" in recording.signals)):
                return name, time, value
    raw = [recording.signals[name] for name in _RAW_MOTORS if name in recording.signals]
    if len(raw) == len(_RAW_MOTORS) and len({array.time.size for array in raw}) == 1:
        # duty or request: nobody knows which, but both say when the rotors carried
        value = np.column_stack([array.value[:, 0] for array in raw]) / 65535.0
        sound = np.isfinite(value).all(axis=1) & np.isfinite(raw[0].time)
        if sound.sum() > _FEWEST_SAMPLES and (np.diff(raw[0].time[sound]) >= 0).all():
            return "motor_command", raw[0].time[sound], value[sound]
    return None


def _from_rotors(name: str, time: Array, value: Array) -> Airtime:
    possible = np.abs(value).max(axis=1) <= LARGEST_COMMAND.get(name, math.inf)
    if possible.sum() > _FEWEST_SAMPLES:  # a wild sample is no flight
        time, value = time[possible], value[possible]
    thrust = value[:, 0] if name in ("wrench_command", "mixer_command") else value.mean(axis=1)
    thrust = np.maximum(thrust, 0.0)
    if name in ("motor_command", "rotor_speed"):
        thrust = thrust * thrust  # about: thrust grows with the square of duty and of speed
    peak = float(np.percentile(thrust, 99))
    lifting: Intervals = ()
    if peak > _OFF_COMMAND.get(name, 1e-3):
        high = thrust[thrust > 0.4 * peak]
        level = float(np.median(high)) if high.size else peak  # near hover: most of a flight is
        lifting = _closed(time, thrust > 0.3 * level)
    why = "" if lifting else "its rotors never carried it"
    return Airtime(lifting, lifting, lifting, (name,), why, begin=float(time[0]), end=float(time[-1]))


def _above_ground(found: Airtime, when: Array, z: Array) -> Airtime:
    """Less the time on the ground, where the rotors rest long enough for the height (n,) of the ground to show."""
    found = replace(found, climbed=float(np.ptp(z)))
    known = (when >= found.begin) & (when <= found.end + 0.5)
    resting = known & ~inside(when, tuple((a - 0.1, b + 0.5) for a, b in found.lifting))
    if resting.sum() < 5:
        return found
    ground = float(np.median(z[resting]))
    airborne: list[tuple[float, float]] = []
    flown: list[tuple[float, float]] = []
    for start, end in found.lifting:
        within = np.flatnonzero((when >= start) & (when <= end))
        if not within.size:
            airborne.append((start, end))
            flown.append((start, end))
            continue
        # each flight rises from the floor as it was just before, and comes down to that just after
        top = when[within[np.argmax(z[within])]]
        sides = [
            resting & (when >= start - FLOOR_SECONDS) & (when < start),
            resting & (when > end) & (when <= end + 0.5 + FLOOR_SECONDS),
        ]
        before, after = (float(np.median(z[rows])) if rows.sum() >= 5 else ground for rows in sides)
        above = z[within] - np.where(when[within] <= top, before, after)
        for spans, up in ((airborne, above > LIFTED_HEIGHT), (flown, _off_the_ground(above))):
            if up.any():
                spans.append((float(when[within[up][0]]), float(when[within[up][-1]])))
    why = found.reason or ("" if airborne else "its rotors turned, but it did not leave the ground")
    if not found.lifting:
        why += f" (its height changes by {found.climbed:.2f} m)"
    judged = (*found.judged_by, "position")
    return replace(found, airborne=tuple(airborne), flown=tuple(flown), ground=ground, judged_by=judged, reason=why)


def _beyond_rotors(found: Airtime, time: Array, position: Array) -> Airtime:
    """With the flight before and after what is known of the rotors, by the height, where they were at work there."""
    ahead = bool(found.flown) and found.flown[0][0] <= found.begin + SHORTEST_FLIGHT
    behind = bool(found.flown) and found.flown[-1][1] >= found.end - SHORTEST_FLIGHT
    alone = _from_height(time, position).flown
    first = (
        next((a for a, b in alone if a < found.begin - LONGEST_SILENCE and b > found.begin), None) if ahead else None
    )
    last = next((b for a, b in alone if a < found.end and b > found.end + LONGEST_SILENCE), None) if behind else None

    def wider(spans: Intervals) -> Intervals:
        edges = [list(span) for span in spans]
        edges[0][0] = edges[0][0] if first is None else first
        edges[-1][1] = edges[-1][1] if last is None else last
        return tuple((a, b) for a, b in edges)

    if first is None and last is None:
        return found
    judged = tuple(dict.fromkeys((*found.judged_by, "position")))
    return replace(found, airborne=wider(found.airborne), flown=wider(found.flown), judged_by=judged)


def _off_the_ground(height: Array) -> Flags:
    """Rows (n,) in the air, of heights above the ground [m]: without bounces before the climb and after the descent."""
    lifted = height > LIFTED_HEIGHT
    high = np.flatnonzero(height > max(CLEAR_HEIGHT, BOUNCE_SHARE * float(height.max(initial=0.0))))
    if high.size:
        down = np.flatnonzero(~lifted)
        first, last = np.searchsorted(down, high[0]) - 1, np.searchsorted(down, high[-1])
        lifted[: down[first] if first >= 0 else 0] = False
        lifted[down[last] if last < down.size else height.size :] = False
    return lifted


def _closed(time: Array, flags: Flags) -> Intervals:
    """Runs of True with short breaks closed and short runs dropped; parted where nothing was recorded."""
    steps = np.diff(time)
    silent = np.flatnonzero(steps > max(LONGEST_SILENCE, 5.0 * float(np.median(steps)))) if steps.size else steps
    merged: list[tuple[float, float]] = []
    for first, last in zip([0, *(silent + 1)], [*(silent + 1), time.size]):
        for number, (start, end) in enumerate(intervals_of(time[first:last], flags[first:last])):
            if number and start - merged[-1][1] <= LONGEST_FALL:
                merged[-1] = (merged[-1][0], end)
            else:
                merged.append((start, end))
    return tuple(span for span in merged if span[1] - span[0] >= SHORTEST_FLIGHT)


# -- height alone -----------------------------------------------------------------------------------------------------


def _position(recording: Recording) -> tuple[Array, Array] | None:
    """Times (n,) and positions (n, 3) of the first signal that measures it."""
    for name, array in recording.signals.items():
        if (array.quantity == "position" or name == "position") and array.value.shape[1] == 3:
            time, value = ordered(thinned(array))
            if time.size > _FEWEST_SAMPLES:
                return time, value
    return None


def _from_height(time: Array, position: Array) -> Airtime:
    """By the position alone: a drone flies above the place on which it rested before it rose.

    A rest above the place from which the drone rose is a hover, one below or beside it is a new support. So a drone
    that is taken off its table and carried away without being lifted never flew on that way.
    """
    z = position[:, 2]
    rests = _rests(time, position)
    if not rests and float(np.ptp(z)) > LEAST_CLIMB:  # it may drift sideways on its floor, but no lower than that
        rests = [(a, b) for a, b in _rests(time, position[:, 2:]) if float(np.median(z[a:b])) < z.min() + LIFTED_HEIGHT]
    bare = Airtime((), (), (), ("position",), "", math.nan, float(np.ptp(z)), float(time[0]), float(time[-1]))
    if not rests:
        whole = ((float(time[0]), float(time[-1])),)
        return replace(bare, airborne=whole, flown=whole, lifting=whole)
    start = float(np.median(z[time < time[0] + MEAN_SECONDS]))
    supports: list[tuple[int, int, float]] = []
    for first, last in rests:
        level = float(np.median(z[first:last]))
        if level < (supports[-1][2] if supports else start) + LIFTED_HEIGHT:
            supports.append((first, last, level))
    if not supports:  # it rises from where the recording begins, and rests no more
        supports = [(0, 1, start)]
    found: list[tuple[float, float]] = []
    edges = [(0, supports[0][0], supports[0][2], supports[0][2])]
    edges += [(a[1], b[0], a[2], b[2]) for a, b in pairwise(supports)]
    edges += [(supports[-1][1], z.size, supports[-1][2], supports[-1][2])]
    for first, last, before, after in edges:
        rows = np.arange(max(first - 1, 0), last)
        up, still_up = rows[z[rows] > before + LIFTED_HEIGHT], rows[z[rows] > after + LIFTED_HEIGHT]
        if up.size and float(z[up].max()) > before + LEAST_CLIMB:
            flags = np.zeros(z.size, bool)
            flags[up[0] : still_up[-1] + 1] = True
            found += _closed(time, flags)
    why = "" if found else f"it never rose {LEAST_CLIMB:g} m above the place on which it rested"
    spans = tuple(found)
    return replace(bare, airborne=spans, flown=spans, lifting=spans, reason=why, ground=supports[0][2])


def _rests(time: Array, position: Array) -> list[tuple[int, int]]:
    """(first row, row after the last) of stretches at rest, by all c columns of the position (n, c)."""
    number = np.floor((time - time[0]) / MEAN_SECONDS).astype(np.int64)
    first = np.flatnonzero(np.diff(number, prepend=-1))
    count = np.diff(np.append(first, time.size))
    mean = np.add.reduceat(position, first, axis=0) / count[:, None]
    width = round(REST_SECONDS / MEAN_SECONDS)
    if first.size < width:
        return []
    windows = np.lib.stride_tricks.sliding_window_view(mean, width, axis=0)
    numbers = number[first]
    still = (np.ptp(windows, axis=2) < _allowed(position, float(np.median(count)))).all(axis=1)
    still &= numbers[width - 1 :] - numbers[: numbers.size - width + 1] == width - 1
    flags = np.zeros(first.size, bool)
    for shift in range(width):
        flags[shift : shift + still.size] |= still
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(first[a]), int(first[b]) if b < first.size else time.size) for a, b in zip(edges[::2], edges[1::2])]


def _allowed(position: Array, count: float) -> Array:
    """(c,) m: the range within which means of `count` samples are still, by noise and resolution of each component."""
    noise = np.sqrt(np.median(np.diff(position, 2, axis=0) ** 2, axis=0) / (6.0 * 0.455))  # 0.455: median of chi-square
    steps = np.abs(np.diff(position, axis=0))
    step = np.array([float(s[s > 1e-9].min(initial=math.inf)) for s in steps.T])
    coarse = np.where(np.isfinite(step) & (step < 0.1), step, 0.0)
    return np.maximum.reduce(
        [np.full(noise.size, STILL_HEIGHT), STILL_STANDARD_ERRORS * noise / math.sqrt(max(count, 1.0)), 1.01 * coarse]
    )


# -- flag, impacts ----------------------------------------------------------------------------------------------------


def _flagged(found: Airtime | None, recording: Recording) -> Airtime | None:
    """Only while the firmware's flag says so, where there is one: from its first to its last sample that does.

    The first and the last value of the recording hold before and after it.
    """
    array = recording.signals.get("flying")
    time, value = ordered(array) if array is not None else (np.zeros(0), np.zeros((0, 1)))
    if not time.size:
        return found
    says = value[:, 0] > 0.5
    spans = [list(span) for span in intervals_of(time, says)]
    ((begin, end),) = _all_time(recording)
    if says[0]:
        spans[0][0] = begin
    if says[-1]:
        spans[-1][1] = end
    flag = tuple((a, b) for a, b in spans)
    why = "" if spans else "the flying flag never says so"
    if found is None:
        return Airtime(flag, flag, flag, ("flying",), why, begin=begin, end=end)
    air, flown = common(found.airborne, flag), common(found.flown, flag)
    if found.airborne and spans and not air:
        why = "the flying flag and its height or rotors never say so together"
    order = ("flying", *found.judged_by) if found.judged_by == ("position",) else None
    judged = order or (found.judged_by[0], "flying", *found.judged_by[1:])
    return replace(found, airborne=air, flown=flown, judged_by=judged, reason=found.reason or why)


def _without_impacts(found: Airtime, recording: Recording) -> Airtime:
    """Less what is near an impact, where no height tells; one shortly before the end of a flight is its end."""
    array = recording.signals.get("specific_force")
    if array is None:
        return found
    time, force = ordered(array)
    hits = time[np.einsum("ij,ij->i", force, force) > IMPACT_FORCE**2]
    if not inside(hits, found.airborne).any():
        return found
    parts = tuple(part for start, end in found.airborne for part in _parted(start, end, hits))
    return replace(found, airborne=parts, flown=parts, judged_by=(*found.judged_by, "specific_force"))


def _parted(start: float, end: float, hits: Array) -> list[tuple[float, float]]:
    within = hits[(hits >= start) & (hits <= end)]
    final = within[within > end - AFTER_IMPACT]
    if final.size:
        end = float(final[0]) - AROUND_IMPACT
    parts = []
    for t in within[within <= end]:
        if t - AROUND_IMPACT > start:
            parts.append((start, float(t) - AROUND_IMPACT))
        start = float(t) + AROUND_IMPACT
    return [(a, b) for a, b in [*parts, (start, end)] if b - a >= SHORTEST_FLIGHT]


def _all_time(recording: Recording) -> Intervals:
    finite = [array.time[np.isfinite(array.time)] for array in recording.signals.values()]
    times = [t for t in finite if t.size]
    return ((float(min(t.min() for t in times)), float(max(t.max() for t in times))),) if times else ()
