"""When a recorded drone is in the air, and by which signals; all commands use this module.

Evidence is the thrust of the rotors, the flying flag of the firmware, the height and impacts, as far as recorded. The
live gate of the estimator (`estimation/contact.py`) cannot look ahead, so it may differ by fractions of a second.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from crazyem.recordings.finding import intervals_of, runs_of
from crazyem.recordings.ordering import Array, Flags, Intervals, all_time, common, inside, ordered, thinned
from crazyem.recordings.recording import Recording

SHORTEST_FLIGHT = 0.4  # s of lift; a shorter one is a hop or a test of the rotors
LONGEST_FALL = 0.6  # s without lift that a manoeuvre may have
LONGEST_SILENCE = 1.0  # s; a gap longer than this and than five periods ends an interval of flight
LIFTED_HEIGHT, CLEAR_HEIGHT = 0.03, 0.1  # m above the ground: in the air; higher than a bounce
BOUNCE_SHARE = 0.25  # of the greatest height; higher is no bounce. A hard landing from 1 m bounces 0.12 m.
# s at rest before and after a flight that give the height of the floor: the height of an onboard filter drifts
FLOOR_SECONDS = 1.0
LEAST_CLIMB = 0.15  # m; least climb of a flight where the height is the only evidence
# A drone rests where means of 0.25 s stay within 2 mm for 1 s. In 43 recorded flights they stay within 1 mm on the
# ground (motion capture, Lighthouse, onboard filters) and move by 3 mm or more in hover. Three standard errors of a
# mean are allowed where the position is noisy (flow deck: 14 mm), and one step where its resolution is coarse.
MEAN_SECONDS, REST_SECONDS, STILL_HEIGHT, STILL_STANDARD_ERRORS = 0.25, 1.0, 0.002, 3.0  # s, s, m, standard errors
IMPACT_FORCE = 40.0  # m/s^2; specific force of an impact, twice the largest that rotors cause
AFTER_IMPACT, AROUND_IMPACT = 1.5, 0.25  # s; an impact so near the end is the end; left out around it
# Largest values (SI; the fastest rotors reach 6e3 rad/s); a larger sample is an error of transmission.
LARGEST_COMMAND = {"rotor_speed": 8000.0, "motor_command": 1.5, "motor_request": 1.5}
# Rotors are off below this thrust, approximated by the square of duty or speed, else by the signal itself.
_OFF_COMMAND = {"motor_command": 0.03, "motor_request": 0.1, "rotor_speed": 200.0**2, "mixer_command": 3000.0}
_ROTOR_SIGNALS = ("motor_command", "motor_request", "rotor_speed", "wrench_command", "mixer_command")
_RAW_MOTORS = ("motor.m1", "motor.m2", "motor.m3", "motor.m4")
_FEWEST_SAMPLES = 10  # a signal with no more samples is not used


@dataclass(frozen=True, slots=True)
class Airtime:
    """When the drone flew."""

    airborne: Intervals  # as `flown`, with bounces before the climb and after the descent, in which the floor may push
    flown: Intervals  # intervals in the air [s]; the whole recording if no signal shows a flight (`known` is False)
    # intervals in which the rotors carried about the weight; as `airborne` without a signal of the rotors
    lifting: Intervals
    judged_by: tuple[str, ...]  # names of the signals that were used; () without any
    reason: str = ""  # why the drone never flew, one clause; "" if it flew
    ground: float = math.nan  # height of the ground in the frame of the position [m]; NaN where unknown
    climbed: float = math.nan  # m, range of height; NaN without a position
    begin: float = math.nan  # begin, end: s; first and last sample of the signal that was used first
    end: float = math.nan

    @property
    def known(self) -> bool:
        """Whether any signal shows when the drone flew."""
        return bool(self.judged_by)

    @property
    def by_height_alone(self) -> bool:
        """Whether no signal of the rotors was used."""
        return not set(self.judged_by) - {"flying", "position"}

    @property
    def seconds(self) -> float:
        """Time in the air [s]."""
        return float(sum(end - start for start, end in self.flown))

    def covers(self, time: Array) -> Flags:
        """(n,) whether each time is in the air."""
        return inside(time, self.flown)


def airtime(recording: Recording) -> Airtime:
    """When a recording is in the air. Never raises; without a usable signal: the whole recording."""
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
    return _flagged(found, recording) or Airtime(all_time(recording), all_time(recording), (), ())


# -- rotors -----------------------------------------------------------------------------------------------------------


def _rotors(recording: Recording, *, moved: bool) -> tuple[str, Array, Array] | None:
    """Name, times (n,) and values (n, c) of the first signal that shows the thrust of the rotors.

    A speed sensor that reads 0 throughout may be unconnected: it is not used if a position (`moved`) or a flag exists.
    """
    for name in _ROTOR_SIGNALS:
        if name in recording.signals:
            time, value = ordered(thinned(recording.signals[name]))
            dead = name == "rotor_speed" and not value.any()
            if time.size > _FEWEST_SAMPLES and not (dead and (moved or "flying" in recording.signals)):
                return name, time, value
    raw = [recording.signals[name] for name in _RAW_MOTORS if name in recording.signals]
    if len(raw) == len(_RAW_MOTORS) and len({array.time.size for array in raw}) == 1:
        # duty or request: either one shows when the rotors carried the weight
        value = np.column_stack([array.value[:, 0] for array in raw]) / 65535.0
        sound = np.isfinite(value).all(axis=1) & np.isfinite(raw[0].time)
        if sound.sum() > _FEWEST_SAMPLES and (np.diff(raw[0].time[sound]) >= 0).all():
            return "motor_command", raw[0].time[sound], value[sound]
    return None


def _from_rotors(name: str, time: Array, value: Array) -> Airtime:
    possible = np.abs(value).max(axis=1) <= LARGEST_COMMAND.get(name, math.inf)
    if possible.sum() > _FEWEST_SAMPLES:  # without errors of transmission
        time, value = time[possible], value[possible]
    thrust = value[:, 0] if name in ("wrench_command", "mixer_command") else value.mean(axis=1)
    thrust = np.maximum(thrust, 0.0)
    if name in ("motor_command", "rotor_speed"):
        thrust = thrust * thrust  # thrust is about proportional to the square of duty and of speed
    peak = float(np.percentile(thrust, 99))
    lifting: Intervals = ()
    if peak > _OFF_COMMAND.get(name, 1e-3):
        high = thrust[thrust > 0.4 * peak]
        level = float(np.median(high)) if high.size else peak  # near hover, as most of a flight is
        lifting = _closed(time, thrust > 0.3 * level)
    why = "" if lifting else "its rotors never carried it"
    return Airtime(lifting, lifting, lifting, (name,), why, begin=float(time[0]), end=float(time[-1]))


def _above_ground(found: Airtime, when: Array, z: Array) -> Airtime:
    """Without the time on the ground, by the heights (n,), if rests of the rotors show the height of the ground."""
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
        # the floor has one height before the flight and another after it: the height may drift
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
    """With flight before the first and after the last sample of the rotors, by the height, if they carried there."""
    ahead = bool(found.flown) and found.flown[0][0] <= found.begin + SHORTEST_FLIGHT
    behind = bool(found.flown) and found.flown[-1][1] >= found.end - SHORTEST_FLIGHT
    alone = _from_height(time, position).flown
    starts = [a for a, b in alone if ahead and a < found.begin - LONGEST_SILENCE and b > found.begin]
    ends = [b for a, b in alone if behind and a < found.end and b > found.end + LONGEST_SILENCE]
    if not starts and not ends:
        return found

    def wider(spans: Intervals) -> Intervals:
        edges = [list(span) for span in spans]
        edges[0][0] = next(iter(starts), edges[0][0])
        edges[-1][1] = next(iter(ends), edges[-1][1])
        return tuple((a, b) for a, b in edges)

    judged = tuple(dict.fromkeys((*found.judged_by, "position")))
    return replace(found, airborne=wider(found.airborne), flown=wider(found.flown), judged_by=judged)


def _off_the_ground(height: Array) -> Flags:
    """Rows (n,) in the air, from heights above the ground [m]; bounces before climb and after descent are left out."""
    lifted = height > LIFTED_HEIGHT
    high = np.flatnonzero(height > max(CLEAR_HEIGHT, BOUNCE_SHARE * float(height.max(initial=0.0))))
    if high.size:
        down = np.flatnonzero(~lifted)
        first, last = np.searchsorted(down, high[0]) - 1, np.searchsorted(down, high[-1])
        lifted[: down[first] if first >= 0 else 0] = False
        lifted[down[last] if last < down.size else height.size :] = False
    return lifted


def _closed(time: Array, flags: Flags) -> Intervals:
    """Runs of True; short breaks are closed, short runs dropped, and a long gap in the samples ends a run."""
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
    """Times (n,) and positions (n, 3) of the first signal that measures the position."""
    for name, array in recording.signals.items():
        if (array.quantity == "position" or name == "position") and array.value.shape[1] == 3:
            time, value = ordered(thinned(array))
            if time.size > _FEWEST_SAMPLES:
                return time, value
    return None


def _from_height(time: Array, position: Array) -> Airtime:
    """By the position alone: a drone flies above the place on which it rested before it rose.

    A rest higher than the last support is a hover; any other rest is a new support. So a drone that is carried from
    its table to a lower place, without being lifted, did not fly.
    """
    z = position[:, 2]
    rests = _rests(time, position)
    if not rests and float(np.ptp(z)) > LEAST_CLIMB:  # it may drift sideways at rest: height alone, near its least
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
    if not supports:  # no rest on a support: the drone rises from its first height
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
    return [(int(first[a]), int(first[b]) if b < first.size else time.size) for a, b in runs_of(flags)]


def _allowed(position: Array, count: float) -> Array:
    """(c,) m: largest range of means of `count` samples at rest, from noise and resolution of each component."""
    noise = np.sqrt(np.median(np.diff(position, 2, axis=0) ** 2, axis=0) / (6.0 * 0.455))  # 0.455: median of chi-square
    steps = np.abs(np.diff(position, axis=0))
    step = np.array([float(s[s > 1e-9].min(initial=math.inf)) for s in steps.T])
    coarse = np.where(np.isfinite(step) & (step < 0.1), step, 0.0)
    return np.maximum.reduce(
        [np.full(noise.size, STILL_HEIGHT), STILL_STANDARD_ERRORS * noise / math.sqrt(max(count, 1.0)), 1.01 * coarse]
    )


# -- flag, impacts ----------------------------------------------------------------------------------------------------


def _flagged(found: Airtime | None, recording: Recording) -> Airtime | None:
    """Flight only while the flying flag of the firmware is set, if there is such a flag.

    The first value of the flag holds from the start of the recording, the last value to its end.
    """
    array = recording.signals.get("flying")
    time, value = ordered(array) if array is not None else (np.zeros(0), np.zeros((0, 1)))
    if not time.size:
        return found
    says = value[:, 0] > 0.5
    spans = [list(span) for span in intervals_of(time, says)]
    ((begin, end),) = all_time(recording)
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
    """Without the time around impacts, for recordings without a height; a late impact ends the flight."""
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
