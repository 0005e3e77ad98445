"""When a recording is in the air, judged from whatever signals it has, and how hard it flew while it was."""

from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.finding import intervals_of
from crazyem.recordings.recording import Recording, SignalArray

Array = NDArray[np.float64]

CLEARANCE = 0.08  # m above the last resting height before a sample counts as flying, as the estimator has it
CONTACT = 0.05  # m above it below which a sample counts as contact again
SPLIT = 1.0  # s without a sample after which nobody knows whether it still flew
SHORTEST = 0.3  # s; a hop shorter than this is no flight
PAUSE = 0.5  # s; rotors slowed for less than this (a quick descent) have not stopped
SATURATED = 0.999  # duty from which a rotor is at its limit
IMPACT = 40.0  # m/s^2 of specific force, twice what rotors can do: the drone hit something
_AFTER_IMPACT = 1.5  # s before the end of a flight from which an impact is its end
_AROUND_IMPACT = 0.25  # s
_SPEED_SPAN = 0.1  # s over which position is differenced where there is no velocity

# Signals that say how hard the rotors turn, best first, and the share of a typical value in flight below which they
# count as off or idling. Half of the duty or speed in hover is a quarter of its thrust.
_ROTORS = {"motor_command": 0.5, "rotor_speed": 0.5, "motor_request": 0.5, "wrench_command": 0.25, "mixer_command": 0.4}


@dataclass(frozen=True, slots=True)
class Airborne:
    """Stretches in the air.

    Attributes:
        intervals: (start, end) in s on the recording's time axis.
        judged_by: names of the signals that were used; () if none could tell, then it is the whole recording.
    """

    intervals: tuple[tuple[float, float], ...]
    judged_by: tuple[str, ...]

    @property
    def seconds(self) -> float:
        """Time in the air [s]."""
        return float(sum(end - start for start, end in self.intervals))

    def covers(self, time: Array) -> NDArray[np.bool_]:
        """(n,) whether each time is in the air."""
        inside = np.zeros(time.shape, bool)
        for start, end in self.intervals:
            inside |= (time >= start) & (time <= end)
        return inside


@dataclass(frozen=True, slots=True)
class Envelope:
    """Extremes of the airborne part; None where the recording cannot say. SI, world z up, body FLU."""

    airborne_s: float
    judged_by: tuple[str, ...]
    speed_max_m_s: float | None = None
    speed_rms_m_s: float | None = None
    speed_from: str = ""
    tilt_max_deg: float | None = None
    tilt_from: str = ""
    body_rate_max_rad_s: tuple[float, float, float] | None = None
    altitude_min_m: float | None = None
    altitude_max_m: float | None = None
    vertical_speed_min_m_s: float | None = None
    vertical_speed_max_m_s: float | None = None
    acceleration_max_m_s2: float | None = None
    specific_force_min_m_s2: float | None = None
    specific_force_max_m_s2: float | None = None
    voltage_start_V: float | None = None
    voltage_end_V: float | None = None
    voltage_min_V: float | None = None
    motor_command_max: float | None = None
    motor_saturated_share: float | None = None
    airborne_intervals_s: tuple[tuple[float, float], ...] = field(default=())

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def airborne(recording: Recording) -> Airborne:
    """When the recording is in the air, from rotors, height and the firmware's flag, as far as it has them.

    Rotors that turn are needed; above that a height of 8 cm over where the drone last rested with its rotors off, until
    it is below 5 cm again. Where no signal tells, all of it counts and `judged_by` is empty.
    """
    rotors, flag = rotor_effort(recording), _sound(recording, "flying")
    height = _sound(recording, "position")
    used = [name for name, _, _ in ([rotors] if rotors else [])]
    if height is None and rotors is None and flag is None:
        return Airborne(_whole(recording), ())
    time = height[0] if height is not None else rotors[1] if rotors is not None else flag[0]  # type: ignore[index]
    turning = np.ones(time.size, bool)
    if rotors is not None:
        turning = held(rotors[1], rotors[2], time) > 0.0
    if flag is not None:
        used.append("flying")
        turning &= held(flag[0], flag[1][:, 0], time) > 0.5
    turning = _without_pauses(time, turning)
    inside = turning
    if height is not None:
        used.append("position")
        inside = _off_the_ground(height[1][:, 2], turning, known=rotors is not None or flag is not None)
    runs = intervals_of(time, inside)
    impacts = _impacts(recording)
    if any(start <= t <= end for t in impacts for start, end in runs):
        used.append("specific_force")
    parts = [p for start, end in runs for part in _split(time, start, end) for p in _without_impacts(*part, impacts)]
    return Airborne(tuple((a, b) for a, b in parts if b - a >= SHORTEST), tuple(used))


def rotor_effort(recording: Recording) -> tuple[str, Array, Array] | None:
    """(signal, times (n,), effort (n,)) of the best signal about the rotors: positive where they carry the drone.

    The effort is the mean over the rotors, less the share of its 80th percentile below which rotors count as idling.
    """
    for name, share in _ROTORS.items():
        found = _sound(recording, name)
        if found is None:
            continue
        time, value = found
        effort = value[:, 0] if name in ("wrench_command", "mixer_command") else value.mean(axis=1)
        largest = float(effort.max())
        if largest <= 0.0:
            continue
        typical = float(np.quantile(effort[effort > 0.05 * largest], 0.8))
        return name, time, effort - share * typical
    return None


def envelope(recording: Recording, air: Airborne) -> Envelope:
    """Extremes of the airborne part, of samples as they were measured: one wild sample shows."""
    found: dict[str, Any] = {}
    speed = _speed(recording, air)
    if speed is not None:
        found["speed_from"], velocity = speed
        norm = np.linalg.norm(velocity, axis=1)
        found["speed_max_m_s"], found["speed_rms_m_s"] = float(norm.max()), float(np.sqrt(np.mean(norm**2)))
        found["vertical_speed_min_m_s"] = float(velocity[:, 2].min())
        found["vertical_speed_max_m_s"] = float(velocity[:, 2].max())
        del velocity, norm  # of a long flight, one signal at a time
    del speed
    for name, upright in (("attitude", _upright_of_quaternion), ("euler", _upright_of_euler)):
        value = inside_of(recording, name, air)
        if value is not None:
            found["tilt_from"] = name
            found["tilt_max_deg"] = float(np.degrees(np.arccos(np.clip(upright(value).min(), -1.0, 1.0))))
            break
    value = None
    rate = inside_of(recording, "body_rate", air)
    if rate is not None:
        found["body_rate_max_rad_s"] = tuple(float(r) for r in np.abs(rate).max(axis=0))
    del rate
    position = inside_of(recording, "position", air)
    if position is not None:
        found["altitude_min_m"], found["altitude_max_m"] = float(position[:, 2].min()), float(position[:, 2].max())
    del position
    acceleration = inside_of(recording, "acceleration", air)
    if acceleration is not None:
        found["acceleration_max_m_s2"] = float(np.linalg.norm(acceleration, axis=1).max())
    del acceleration
    force = inside_of(recording, "specific_force", air)
    if force is not None:
        norm = np.linalg.norm(force, axis=1)
        found["specific_force_min_m_s2"], found["specific_force_max_m_s2"] = float(norm.min()), float(norm.max())
        del norm
    del force
    voltage = inside_of(recording, "voltage", air)
    if voltage is not None:
        found["voltage_start_V"], found["voltage_end_V"] = float(voltage[0, 0]), float(voltage[-1, 0])
        found["voltage_min_V"] = float(voltage.min())
    command = inside_of(recording, "motor_command", air)
    if command is not None:
        found["motor_command_max"] = float(command.max())
        found["motor_saturated_share"] = float((command >= SATURATED).any(axis=1).mean())
    return Envelope(air.seconds, air.judged_by, airborne_intervals_s=air.intervals, **found)


def inside_of(recording: Recording, name: str, air: Airborne) -> Array | None:
    """(n, c) sound samples of a signal in the air, None if there are none."""
    found = _sound(recording, name)
    if found is None:
        return None
    value = found[1][air.covers(found[0])]
    return value if value.size else None


def held(time: Array, value: Array, at: Array) -> Array:
    """The newest value (n,) at or before each of the times `at`; the first one before that."""
    return value[np.maximum(np.searchsorted(time, at, side="right") - 1, 0)]


def _sound(recording: Recording, name: str) -> tuple[Array, Array] | None:
    """Times (n,) and values (n, c) of the samples that are numbers, in order of time; None if there are none."""
    array = recording.signals.get(name)
    return None if array is None else sound_samples(array)


def sound_samples(array: SignalArray) -> tuple[Array, Array] | None:
    """Times (n,) and values (n, c) of the samples that are numbers, in order of time; None if there are none."""
    if not array.time.size or array.value.ndim != 2 or not array.value.shape[1]:
        return None
    good = sound_rows(array.value) & np.isfinite(array.time)
    time, value = (array.time, array.value) if good.all() else (array.time[good], array.value[good])
    if not time.size:
        return None
    if np.any(time[1:] < time[:-1]):
        place = np.argsort(time, kind="stable")
        time, value = time[place], value[place]
    return time, value


def _without_pauses(time: Array, turning: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """`turning` (n,), with stops shorter than PAUSE and between two stretches of turning taken back."""
    edges = np.flatnonzero(np.diff(turning.astype(np.int8)))
    result = turning.copy()
    for stop, start in pairwise(edges):
        if turning[stop] and time[start + 1] - time[stop] < PAUSE:
            result[stop + 1 : start + 1] = True
    return result


def sound_rows(value: Array) -> NDArray[np.bool_]:
    """(n,) whether all components of (n, c) are numbers; their sum tells, several times faster than each of them."""
    with np.errstate(all="ignore"):
        return np.isfinite(value @ np.full(value.shape[1], 2.0**-10))


def _off_the_ground(z: Array, turning: NDArray[np.bool_], *, known: bool) -> NDArray[np.bool_]:
    """Whether each sample is in the air, from its height (n,) [m] and whether its rotors turn."""
    off = ~turning
    if off.any():
        last = np.maximum.accumulate(np.where(off, np.arange(z.size), -1))
        rest = z[np.where(last >= 0, last, int(np.argmax(off)))]
    elif known:
        return turning  # it begins and ends in the air: there is no rest to measure heights from
    else:
        rest = np.full(z.size, np.quantile(z, 0.02))
    above = z - rest
    state = np.where(above >= CLEARANCE, 1, np.where(above < CONTACT, -1, 0))
    decided = np.maximum.accumulate(np.where(state != 0, np.arange(z.size), -1))
    up = (decided >= 0) & (state[np.maximum(decided, 0)] > 0)
    return up & turning


def _split(time: Array, start: float, end: float) -> list[tuple[float, float]]:
    """A stretch cut where `time` has a long gap."""
    first, last = np.searchsorted(time, start), np.searchsorted(time, end, side="right")
    stamps = time[first:last]
    cuts = np.flatnonzero(np.diff(stamps) > SPLIT)
    starts, ends = np.append(0, cuts + 1), np.append(cuts, stamps.size - 1)
    return [(float(stamps[a]), float(stamps[b])) for a, b in zip(starts, ends)]


def _impacts(recording: Recording) -> Array:
    """Times (n,) at which the drone hit something."""
    force = _sound(recording, "specific_force")
    if force is None:
        return np.zeros(0)
    return force[0][np.einsum("ij,ij->i", force[1], force[1]) > IMPACT**2]


def _without_impacts(start: float, end: float, impacts: Array) -> list[tuple[float, float]]:
    """A stretch less what is near an impact; one shortly before the end is the end."""
    inside = impacts[(impacts >= start) & (impacts <= end)]
    final = inside[inside > end - _AFTER_IMPACT]
    if final.size:
        end = float(final[0]) - _AROUND_IMPACT
    parts = []
    for t in inside[inside <= end]:
        if t - _AROUND_IMPACT > start:
            parts.append((start, float(t) - _AROUND_IMPACT))
        start = float(t) + _AROUND_IMPACT
    return [(a, b) for a, b in [*parts, (start, end)] if b > a]


def _whole(recording: Recording) -> tuple[tuple[float, float], ...]:
    times = [a.time[np.isfinite(a.time)] for a in recording.signals.values()]
    times = [t for t in times if t.size]
    return ((float(min(t.min() for t in times)), float(max(t.max() for t in times))),) if times else ()


def _speed(recording: Recording, air: Airborne) -> tuple[str, Array] | None:
    """Where velocity comes from, and (n, 3) m/s in the air."""
    velocity = inside_of(recording, "velocity", air)
    if velocity is not None:
        return "velocity", velocity
    found = _sound(recording, "position")
    if found is None:
        return None
    time, position = found
    later = np.searchsorted(time, time + _SPEED_SPAN)
    whole = (later < time.size) & air.covers(time)
    whole &= air.covers(time[np.minimum(later, time.size - 1)])
    whole &= time[np.minimum(later, time.size - 1)] - time < 2.0 * _SPEED_SPAN
    if not whole.any():
        return None
    span = time[later[whole]] - time[whole]
    return "position", (position[later[whole]] - position[whole]) / span[:, None]


def _upright_of_quaternion(q: Array) -> Array:
    """Cosine of the tilt, from (n, 4) x y z w of any length but zero."""
    square = np.sum(q**2, axis=1)
    return 1.0 - 2.0 * (q[:, 0] ** 2 + q[:, 1] ** 2) / np.where(square > 0.0, square, 1.0)


def _upright_of_euler(angles: Array) -> Array:
    """Cosine of the tilt, from (n, 3) roll, pitch, yaw [rad]."""
    return np.cos(angles[:, 0]) * np.cos(angles[:, 1])
