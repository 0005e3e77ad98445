"""Check: values that are not numbers or not possible, impossible jumps of the position, coarse positions."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor.streams import listed, longest, places, same_as_before
from crazyem.recordings.finding import Finding, Fix, Grade
from crazyem.recordings.ordering import Array, Flags, sound_rows
from crazyem.recordings.recording import Recording, SignalArray

Rows = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Limit:
    """Bounds of a quantity."""

    measure: Callable[[Array], Array]  # (n, c) values -> (n,) numbers to compare with the bounds
    low: float  # values outside are impossible
    high: float
    words: str  # description of an impossible value


def _norm(value: Array) -> Array:
    return np.sqrt(np.einsum("ij,ij->i", value, value))


def _largest(value: Array) -> Array:
    return np.abs(value).max(axis=1)


def _extreme(value: Array) -> Array:
    """(n,) the component furthest from 0.5."""
    low, high = value.min(axis=1), value.max(axis=1)
    return np.where(high - 0.5 > 0.5 - low, high, low)


# Wide limits: values outside are impossible. Gyros measure up to 35 (70) rad/s, accelerometers up to 24 (32) g an axis;
# the fastest small rotors turn at 6000 rad/s; one to six cells give 2 to 26 V; the norm of smallest-three quaternions
# is 1 within 0.002.
VALUE_LIMITS: dict[str, Limit] = {
    "position": Limit(_largest, 0.0, 1e4, "further than 10 km from the origin"),
    "velocity": Limit(_largest, 0.0, 150.0, "faster than 150 m/s"),
    "attitude": Limit(_norm, 0.98, 1.02, "not of unit length"),
    "body_rate": Limit(_largest, 0.0, 100.0, "faster than 100 rad/s"),
    "specific_force": Limit(_largest, 0.0, 400.0, "more than 400 m/s^2"),
    "acceleration": Limit(_largest, 0.0, 400.0, "more than 400 m/s^2"),
    "motor_command": Limit(_extreme, -1e-6, 1.0 + 1e-6, "outside 0..1"),
    "motor_request": Limit(_extreme, -1e-6, 1.0 + 1e-6, "outside 0..1"),
    "rotor_speed": Limit(_largest, 0.0, 8000.0, "faster than 8000 rad/s"),
    "voltage": Limit(lambda value: value[:, 0], 2.0, 26.0, "outside 2..26 V"),
}


# quantities that read 0 without their sensor
ZERO_WITHOUT_SENSOR = {"voltage": "battery monitor", "rotor_speed": "rotor speed sensor"}
# Other units of motor commands: (words, unit in a mapping, lowest and highest typical value).
_MOTOR_UNITS = (
    ("pulse lengths in us", "us", 900.0, 2100.0),
    ("percent", "%", 2.0, 100.0),
    ("counts", "pwm", 3000.0, 65535.0),
)


def _unit_of_motors(array: SignalArray, values: Array) -> str:
    """Advice about the likely unit of motor commands; "" for other quantities and unknown units."""
    if array.quantity not in ("motor_command", "motor_request"):
        return ""
    typical = float(np.median(values))
    for words, unit, low, high in _MOTOR_UNITS:
        if low <= typical <= high:
            return f'The numbers look like {words}: unit = "{unit}" in a mapping reads them as 0..1.'
    return ""


def check(recording: Recording) -> list[Finding]:
    """Findings about NaN and infinities of the file itself, impossible values and jumps, stamps that are no numbers."""
    found: list[Finding] = []
    unmapped: dict[str, int] = {}
    for name, array in recording.signals.items():
        if array.time.size == 0:
            continue
        lost = ~np.isfinite(array.time)
        if lost.any():
            text = f"{name} has {int(lost.sum())} samples whose stamp is not a number."
            evidence = {"samples": int(lost.sum()), "share": float(lost.mean())}
            advice = "Remove these rows from the source; a sample without a time says nothing."
            found.append(Finding("numbers", Grade.UNUSABLE, text, name, (), evidence, advice))
        sound = sound_rows(array.value)
        bad = ~sound & ~array.marked
        if bad.any():
            if array.quantity or "@" in name:
                found.append(_not_numbers(name, array, bad))
            else:
                unmapped[name] = int(bad.sum())
        limit = VALUE_LIMITS.get(array.quantity)
        if limit is not None:
            found += _impossible(name, array, limit, sound)
        if array.quantity == "position" and "velocity" not in recording.signals:
            found += _position(name, array)
    if unmapped:
        text = f"{listed([*unmapped])} hold values that are no numbers; nothing here uses these columns."
        evidence = {"columns": len(unmapped), "samples": sum(unmapped.values())}
        found.append(Finding("numbers", Grade.HARMLESS, text, "", (), evidence))
    return found


def _not_numbers(name: str, array: SignalArray, bad: Flags) -> Finding:
    share = float(bad.mean())
    text = f"{name} is not a number in {int(bad.sum())} of {bad.size} samples, and the file does not say why."
    evidence = {"samples": int(bad.sum()), "share": share}
    advice = "Mark them as missing (--fix); a replay refuses them otherwise."
    spans = places(array.time, bad)
    fix = Fix("mark", (name,), rows=np.flatnonzero(bad))
    grade = Grade.UNUSABLE if share > 0.5 else Grade.DEGRADES
    return Finding("numbers", grade, text, name, spans, evidence, advice, fix)


def _impossible(name: str, array: SignalArray, limit: Limit, sound: Flags) -> Iterator[Finding]:
    if limit.measure is not _norm:
        low, high = float(array.value.min()), float(array.value.max())  # NaN fails both comparisons
        if low >= (limit.low if limit.low != 0.0 else -limit.high) and high <= limit.high:
            return
    with np.errstate(invalid="ignore", over="ignore"):
        measure = limit.measure(array.value)
        bad = ((measure < limit.low) | (measure > limit.high)) & sound
    if not bad.any():
        return
    if array.quantity in ZERO_WITHOUT_SENSOR and not array.value[sound].any():
        sensor, samples = ZERO_WITHOUT_SENSOR[array.quantity], array.time.size
        text = f"{name} reads 0 in all of its {samples} samples: no {sensor} is connected, {name} is not measured."
        advice = "Nothing to do, unless you expected it."
        yield Finding("numbers", Grade.HARMLESS, text, name, (), {"samples": samples}, advice)
        return
    share = float(bad.mean())
    good = measure[sound & ~bad]
    worst = measure[bad]
    worst_value = float(worst[int(np.argmax(np.abs(worst - 0.5 * (limit.low + limit.high))))])
    advice = "Mark them as missing (--fix); look at what wrote them."
    fix: Fix | None = Fix("mark", (name,), rows=np.flatnonzero(bad))
    if share > 0.2:
        advice, fix = "Check the unit and what the column means; do not use the signal as it is.", None
        advice = _unit_of_motors(array, measure[sound]) or advice
        if array.quantity == "voltage" and 2.0 <= float(np.median(measure[sound])) / 1000.0 <= 26.0:
            advice = "The numbers are millivolts; scale by 0.001 (--fix)."
            fix = Fix("scale", (name,), factor=(0.001,))
    evidence = {"samples": int(bad.sum()), "share": share, "worst": worst_value}
    if good.size:
        evidence["largest_possible"] = float(good.max())
    text = f"{name} is {limit.words} in {int(bad.sum())} of {bad.size} samples (worst {worst_value:.6g})."
    spans = places(array.time, bad)
    grade = Grade.UNUSABLE if share > 0.2 else Grade.DEGRADES
    yield Finding("numbers", grade, text, name, spans, evidence, advice, fix)


LEAST_JUMP = 0.1  # m, least deviation of a step from the motion around it: ten times a step at 100 Hz and 1 m/s
CRASH_ACCELERATION = 100.0  # m/s^2 of a crash: limits the deviation of a step that is still possible
JUMP_NOISE_RATIO = 12.0  # least deviation of a step, over the median deviation
MEDIAN_STEPS = 5  # steps on each side
RETURN_SECONDS = 0.5  # s, longest time until a jump back
COARSE_RESOLUTION = 0.005  # m; a coarser one gives a velocity over 0.1 s to no better than 5 cm/s
_FEWEST_SAMPLES = 50


def _position(name: str, array: SignalArray) -> list[Finding]:
    """Findings about one position, from its possible samples; held values do not count as new samples."""
    with np.errstate(invalid="ignore"):
        near = (np.abs(array.value) <= VALUE_LIMITS["position"].high).all(axis=1)
        good = np.isfinite(array.time) & near & ~same_as_before(array.value)
    sound = np.flatnonzero(good)
    time, value = array.time[sound], array.value[sound]
    if sound.size < _FEWEST_SAMPLES or (np.diff(time) <= 0.0).any():
        return []
    steps = np.diff(time)
    velocity = np.diff(value, axis=0) / steps[:, None]
    # the motion: the median velocity of each step and `MEDIAN_STEPS` steps on either side
    padded = np.pad(velocity, ((MEDIAN_STEPS, MEDIAN_STEPS), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * MEDIAN_STEPS + 1, axis=0)
    off = np.linalg.norm(velocity - np.median(windows, axis=2), axis=1) * steps
    usual = float(np.median(off))
    limit = np.maximum(np.maximum(LEAST_JUMP, JUMP_NOISE_RATIO * usual), 0.5 * CRASH_ACCELERATION * steps**2)
    rows = np.flatnonzero((off > limit) & (steps < RETURN_SECONDS))
    return [*_found(name, array, sound, time, value, rows, off), *_coarse(name, array, value)]


def _found(
    name: str, array: SignalArray, sound: Rows, time: Array, value: Array, rows: Rows, off: Array
) -> Iterator[Finding]:
    """One finding for all jumps; samples between a jump and the jump back can be marked."""
    if not rows.size:
        return
    flags = np.zeros(array.time.size, bool)
    spans: list[tuple[float, float]] = []
    away = 0
    k = 0
    while k < rows.size:
        first = int(rows[k])
        size = float(off[first])
        later = rows[k + 1 :][time[rows[k + 1 :]] - time[first] < RETURN_SECONDS]
        # back near the position before, within half of the jump
        back = next((int(r) for r in later if np.linalg.norm(value[r + 1] - value[first]) < 0.5 * size), None)
        if back is None:
            away += 1
            spans.append((float(time[first]), float(time[first + 1])))
            k += 1
        else:
            flags[sound[first + 1] : sound[back + 1]] = True  # including held values
            spans.append((float(time[first + 1]), float(array.time[sound[back + 1] - 1])))
            k = int(np.searchsorted(rows, back, "right"))
    worst = int(rows[np.argmax(off[rows])])
    lasting = float(time[worst + 1] - time[worst])
    speed = float(off[worst]) / lasting
    marked = int(flags.sum())
    times = "once" if len(spans) == 1 else f"{len(spans)} times"
    back_again = "" if not marked else " and back" if not away else f", {len(spans) - away} of them back"
    text = (
        f"{name} leaps {times}{back_again}, by up to {off[worst]:.2f} m in {1e3 * lasting:.0f} ms "
        f"({speed:.0f} m/s): no drone moves like that."
    )
    evidence = {"leaps": len(spans), "size_m": float(off[worst]), "speed_m_s": speed, "samples": marked}
    advice, fix = "Another frame from there on, or a jump of the filter on board: use the parts before and after.", None
    if marked:
        advice = "Mark the samples away from the path as missing (--fix)."
        fix = Fix("mark", (name,), rows=np.flatnonzero(flags))
    yield Finding("numbers", Grade.DEGRADES, text, name, longest(spans), evidence, advice, fix)


def _coarse(name: str, array: SignalArray, value: Array) -> Iterator[Finding]:
    """Finding if the position is stored in coarse steps."""
    grains = [_grain(column) for column in value.T]
    grain = min((g for g in grains if math.isfinite(g)), default=0.0)
    if grain < COARSE_RESOLUTION:
        return
    text = f"{name} is stored in steps of {100.0 * grain:.2g} cm."
    advice = f"Log it with more digits: a velocity over 0.1 s is known to no better than {grain / 0.1:.2g} m/s from it."
    yield Finding("numbers", Grade.HARMLESS, text, name, (), {"resolution_m": grain}, advice)


def _grain(column: Array) -> float:
    """The step of which all changes of (n,) are multiples; NaN with too few changes, 0 without such a step."""
    steps = np.abs(np.diff(column))
    steps = steps[steps > 1e-9]
    if steps.size < 20:
        return math.nan
    least = float(steps.min())
    multiple = steps / least
    return least if float((np.abs(multiple - np.round(multiple)) < 0.02).mean()) > 0.98 else 0.0
