"""Check: was there a flight, how did it begin and end, did the drone tip over or crash.

A landing is rough: 50 to 120 m/s^2 and 20 rad/s at touchdown are normal. So signs of a crash are: a fast fall or slide
into the ground, a drone that lies on its side at the end, rotors that stop at height.
"""

import math
from collections.abc import Iterator

import numpy as np

from crazyem.doctor.kinematics import upright
from crazyem.doctor.streams import longest
from crazyem.recordings.airborne import Airtime, airtime
from crazyem.recordings.finding import Finding, Grade, intervals_of, runs_of
from crazyem.recordings.ordering import Array, Intervals, inside, ordered
from crazyem.recordings.recording import Recording
from crazyem.recordings.thrust import is_rotorcraft, kind_objection

UPSET_TILT = 90.0  # degrees of tilt
LYING_TILT = 60.0  # degrees of tilt at rest
HARD_LANDING_SPEED = 1.5  # m/s into the ground; a controller lands at up to 0.8, a drop from 10 cm ends at 1.4
IMPOSSIBLE_SPEED = 50.0  # m/s; a larger speed comes from a wrong position, not from a fall
APPROACH_SECONDS = 0.05  # s before touchdown, over which the speed is computed
CARRIED_HEIGHT = 0.3  # m; a larger change of height without turning rotors means that somebody carried the drone
DROP_HEIGHT = 0.4  # m above ground; rotors that stop higher than this mean a drop


def check(recording: Recording) -> list[Finding]:
    """Findings about a missing flight, a recording that begins or ends in the air, upsets and crashes."""
    flight = airtime(recording)
    kind = _kind(recording)
    if not flight.known:
        return kind
    if not flight.airborne:
        return [*kind, _no_flight(flight)]
    tilt = _tilt(recording)
    found = [*kind, *_upsets(flight, tilt)]
    lying = _lying(recording, flight, tilt)
    found += lying
    path = _path(recording)
    if not lying and path is not None and math.isfinite(flight.ground):
        found += _impacts(recording, flight, *path)
        found += _drops(recording, flight, *path)
    return [*found, *_course(flight)]


def _kind(recording: Recording) -> list[Finding]:
    """Finding if the models do not describe this kind of vehicle."""
    why = kind_objection(recording)
    if not why:
        return []
    text = f"{why[:1].upper()}{why[1:]}."
    grade = Grade.DEGRADES if is_rotorcraft(recording) else Grade.UNUSABLE
    advice = "No mass, inertia or effect can be told by these models; the checks of the streams hold all the same."
    return [Finding("flight", grade, text, advice=advice)]


def _no_flight(flight: Airtime) -> Finding:
    evidence = {"climbed_m": flight.climbed} if math.isfinite(flight.climbed) else {}
    text = f"The drone never flew: {flight.reason}."
    if not flight.lifting and flight.climbed > CARRIED_HEIGHT and not flight.by_height_alone:
        text += " Somebody carried it, or the motor signal is not what it says."
    advice = "There is nothing to estimate from; use another recording."
    return Finding("flight", Grade.UNUSABLE, text, "", (), evidence, advice)


def _course(flight: Airtime) -> Iterator[Finding]:
    """Times in the air, if a recording begins or ends in the air or holds several flights."""
    at_work = flight.airborne if flight.by_height_alone else flight.lifting
    starts, ends = at_work[0][0] <= flight.begin, at_work[-1][1] >= flight.end
    count = len(flight.flown)
    where = "in the air" if flight.by_height_alone else "with rotors at work"
    known = {f"holds {count} flights": count > 1, f"begins {where}": starts, f"ends {where}": ends}
    remarks = [remark for remark, true in known.items() if true]
    if not remarks:
        return
    total = flight.seconds
    evidence = {"airborne_s": total, "flights": float(count)}
    if not starts:
        evidence["take_off_s"] = flight.flown[0][0]
    if not ends:
        evidence["landing_s"] = flight.flown[-1][1]
    text = f"The recording {' and '.join(remarks)}; {total:.1f} s in the air."
    yield Finding("flight", Grade.HARMLESS, text, "", longest(flight.flown), evidence, "Nothing to do.")


# -- attitude ---------------------------------------------------------------------------------------------------------


def _tilt(recording: Recording) -> tuple[Array, Array] | None:
    """(n,) times and angles between the body's and the world's vertical in degrees, from the attitude."""
    array = recording.signals.get("attitude")
    if array is None:
        return None
    time, q = ordered(array)
    sound = np.einsum("ij,ij->i", q, q) > 0.5
    time, q = time[sound], q[sound]
    if time.size < 10:
        return None
    return time, np.degrees(np.arccos(np.clip(upright(q), -1.0, 1.0)))


def _upsets(flight: Airtime, tilt: tuple[Array, Array] | None) -> Iterator[Finding]:
    if tilt is None:
        return
    time, angle = tilt
    rows = inside(time, flight.airborne) & (angle > UPSET_TILT)
    # one or two samples are bad numbers, not a roll-over
    for first, last in runs_of(rows):
        if last - first < 3:
            rows[first:last] = False
    if not rows.any():
        return
    spans = intervals_of(time, rows)
    text = f"The drone is upside down in the air {len(spans)} times (tilt up to {angle[rows].max():.0f} degrees)."
    evidence = {"tilt_deg": float(angle[rows].max()), "times": len(spans), "lasting_s": sum(b - a for a, b in spans)}
    advice = "If that was no flip on purpose, use the flight before it only."
    yield Finding("flight", Grade.DEGRADES, text, "", longest(spans), evidence, advice)


def _lying(recording: Recording, flight: Airtime, tilt: tuple[Array, Array] | None) -> list[Finding]:
    """Finding if the drone lies on its side or back after the rotors stopped, by the attitude or by gravity at rest."""
    end = flight.lifting[-1][1]
    angles = [] if tilt is None else [(*tilt, "attitude")]
    array = recording.signals.get("specific_force")
    if array is not None:
        time, force = ordered(array)
        size = np.sqrt(np.einsum("ij,ij->i", force, force))
        rest = (size > 8.0) & (size < 11.6)
        with np.errstate(divide="ignore", invalid="ignore"):
            angle = np.degrees(np.arccos(np.clip(force[:, 2] / size, -1.0, 1.0)))
        angles.append((time[rest], angle[rest], "specific force"))
    for time, angle, words in angles:
        after = angle[time > end + 0.3]
        # the drone must stay tilted: at least ten samples, and the second half of the remaining time
        if after.size >= 10 and float(np.median(after)) > LYING_TILT:
            last = float(np.median(after[after.size // 2 :]))
            if last < LYING_TILT:
                continue
            moment = float(time[np.searchsorted(time, end)])
            text = f"The drone crashed: after the rotors stopped it lies tilted by {last:.0f} degrees."
            evidence = {"rest_tilt_deg": last, "rotors_stop_s": end, **_violence(recording, end)}
            advice = f"Use the flight up to about {end - 1.0:.1f} s (told by the {words})."
            spans = ((max(end - 1.0, flight.begin), moment),)
            return [Finding("flight", Grade.DEGRADES, text, "", spans, evidence, advice)]
    return []


def _violence(recording: Recording, end: float) -> dict[str, float]:
    """Largest specific force and body rate within a second of the end."""
    numbers = {}
    for name, key in (("specific_force", "peak_m_s2"), ("body_rate", "peak_rad_s")):
        array = recording.signals.get(name)
        if array is not None:
            rows = (array.time > end - 1.0) & (array.time < end + 1.0)
            size = np.linalg.norm(array.value[rows], axis=1)
            size = size[np.isfinite(size)]
            if size.size:
                numbers[key] = float(size.max())
    return numbers


# -- ground -----------------------------------------------------------------------------------------------------------


def _path(recording: Recording) -> tuple[Array, Array] | None:
    for name, array in recording.signals.items():
        if name == "position" or array.quantity == "position":
            time, value = ordered(array)
            if time.size > 20:
                return time, value
    return None


def _impacts(recording: Recording, flight: Airtime, time: Array, position: Array) -> Iterator[Finding]:
    """Hard impacts: speed of the approach over the last `APPROACH_SECONDS` before the ground."""
    hits: list[tuple[float, float]] = []
    for start, end in flight.airborne:
        rows = np.flatnonzero((time > start + 0.5) & (time < end + 0.5))
        if rows.size < 20:
            continue
        z = position[rows, 2] - flight.ground
        low = np.flatnonzero((z[1:] < 0.06) & (z[:-1] >= 0.06))
        for k in low:
            i = rows[k]
            j = min(int(np.searchsorted(time, time[i] - APPROACH_SECONDS)), int(i) - 1)
            lasting = float(time[i] - time[j])
            if 0.0 < lasting < 3.0 * APPROACH_SECONDS:
                speed = float(np.linalg.norm(position[i] - position[j])) / lasting
                down = float(position[j, 2] - position[i, 2]) / lasting
                if HARD_LANDING_SPEED < speed < IMPOSSIBLE_SPEED and down > 0.5 * HARD_LANDING_SPEED:
                    hits.append((float(time[i]), speed))
    if not hits:
        return
    when, speed = max(hits, key=lambda hit: hit[1])
    spans: Intervals = tuple((t - 0.1, t + 0.5) for t, _ in hits)
    over = all(end < hits[0][0] for _, end in flight.lifting)
    text = f"The drone hits the ground at {speed:.1f} m/s{', its rotors already stopped' if over else ''}."
    evidence = {"speed_m_s": speed, "time_s": when, **_violence(recording, when)}
    advice = f"Use the flight up to about {when - 0.1:.1f} s; the onboard filter suffers from such a shock."
    yield Finding("flight", Grade.HARMLESS if over else Grade.DEGRADES, text, "", longest(spans), evidence, advice)


def _drops(recording: Recording, flight: Airtime, time: Array, position: Array) -> Iterator[Finding]:
    """Rotors that stop at height: cut by hand, by the supervisor, or by an empty battery."""
    for _, end in flight.lifting:
        if flight.end - end < 0.3:
            continue
        i = int(np.searchsorted(time, end))
        if i >= time.size or abs(float(time[i]) - end) > 0.1:
            continue
        height = float(position[i, 2]) - flight.ground
        before = position[(time > end - 0.2) & (time <= end)]
        if before.shape[0] < 3 or not (before[1:] != before[:-1]).any():
            continue  # the log stood still, so the time at which the rotors stopped is unknown
        later = position[(time > end) & (time < end + 1.0), 2]
        fell = height - (float(later.min()) - flight.ground) if later.size else 0.0
        if height > DROP_HEIGHT and fell > 0.5 * height:
            text = f"The rotors stop {height:.2f} m above the ground, and the drone falls."
            evidence = {"height_m": height, "time_s": end, **_violence(recording, end)}
            advice = f"Use the flight up to {end:.1f} s."
            spans = ((end, min(end + 1.0, flight.end)),)
            yield Finding("flight", Grade.DEGRADES, text, "", spans, evidence, advice)
