"""Check: channels that stay constant in flight, always or for a while, although they should change; unused columns."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor.streams import COMMAND_SIGNALS, listed, longest, same_as_before
from crazyem.recordings.airborne import Airtime, airtime
from crazyem.recordings.finding import Finding, Fix, Grade, percent, runs_of
from crazyem.recordings.ordering import Flags, inside
from crazyem.recordings.recording import Recording, SignalArray
from crazyem.recordings.thrust import UNKNOWN_VOLTAGE_ERROR, flat_voltage

# Shortest stretch without any change that counts as stuck [s]. Noise changes inertial sensors at every sample; a pose
# in steps of a millimetre, or a quaternion in steps of 0.16 degrees, may stay constant for a while in a hover.
SHORTEST_STILLNESS: dict[str, float] = {
    "body_rate": 0.2,
    "specific_force": 0.2,
    "acceleration": 0.2,
    "rotor_speed": 0.3,
    "motor_command": 0.5,
    "position": 0.3,
    "velocity": 0.3,
    "attitude": 0.3,
    "euler": 0.3,
}
FEWEST_STILL_SAMPLES = 10
STILLNESS_RATIO = 6.0  # least length of a stuck stretch, over the 99th percentile of the channel's other still ones
_INERTIAL_SIGNALS = frozenset({"body_rate", "specific_force", "acceleration"})
# m, m/s, rad; least motion during the stretch by other signals
_LEAST_MOTION = {"position": 0.03, "velocity": 0.15, "attitude": 0.03, "euler": 0.03}


def check(recording: Recording) -> list[Finding]:
    """Findings about signals and single components that stay constant in flight, and one about unused columns."""
    flight = airtime(recording)
    found = []
    stuck: list[_Stuck] = []
    idle: list[str] = []
    for name, array in recording.signals.items():
        if array.time.size < 20:
            continue
        if not array.quantity:
            if _constant(array.value):
                idle.append(name)
        elif array.quantity in SHORTEST_STILLNESS:
            stuck += _signal(recording, name, array, flight)
        elif name == "voltage" and flat_voltage(recording, flight):
            found.append(_flat_voltage(recording, array))
    while stuck:
        first, *stuck = stuck
        alike = [other for other in stuck if _alike(first, other)]
        stuck = [other for other in stuck if other not in alike]
        company = _company_of(recording, first, alike) if alike else []
        found.append(_finding(first, [first.name, *(other.name for other in alike), *company]))
    if idle:
        found.append(_idle(idle))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Stuck:
    """A signal or a component, and the stretches (first row, row after the last) in which it stays constant."""

    name: str
    array: SignalArray
    component: str
    stretches: list[tuple[int, int]]
    flying: Flags

    @property
    def spans(self) -> list[tuple[float, float]]:
        return [(float(self.array.time[a]), float(self.array.time[b - 1])) for a, b in self.stretches]


def _company_of(recording: Recording, first: _Stuck, alike: list[_Stuck]) -> list[str]:
    """Further signals of the table that are constant in the same stretches; no other evidence says they should move."""
    known = {first.name, *(other.name for other in alike)}
    found = []
    for name, array in recording.signals.items():
        if name in known or not array.quantity or array.quantity in COMMAND_SIGNALS:
            continue
        if array.stream != first.array.stream or array.time.size != first.array.time.size:
            continue
        if all((array.value[a + 1 : b] == array.value[a]).all() for a, b in first.stretches):
            found.append(name)
    return found


def _alike(one: _Stuck, other: _Stuck) -> bool:
    """True if two signals of one table stay constant at the same time: then the log stopped, not a sensor."""
    if one.array.stream != other.array.stream or not one.array.stream or one.component or other.component:
        return False
    a, b = (max(x.spans, key=lambda span: span[1] - span[0]) for x in (one, other))
    common = min(a[1], b[1]) - max(a[0], b[0])
    return one.array.time.size == other.array.time.size and common > 0.8 * max(a[1] - a[0], b[1] - b[0])


def _constant(value: NDArray[np.float64]) -> bool:
    """True if all finite values of each component are equal."""
    sound = (column[np.isfinite(column)] for column in value.T)
    return all(column.size and (column == column[0]).all() for column in sound)


def _idle(names: list[str]) -> Finding:
    text = f"{listed(names)}: never {'changes' if len(names) == 1 else 'change'}; not in use in this flight."
    advice = "Nothing to do, unless you expected them to change."
    return Finding("frozen", Grade.HARMLESS, text, "", (), {"columns": len(names)}, advice)


def _flat_voltage(recording: Recording, array: SignalArray) -> Finding:
    volts = float(np.nanmedian(array.value))
    grade, cost = Grade.HARMLESS, "Nothing here needs it."
    if "motor_command" in recording.signals or "motor_request" in recording.signals:
        off = percent(UNKNOWN_VOLTAGE_ERROR)
        grade, cost = Grade.DEGRADES, f"Thrust from duty goes with its square, so the mass may be {off} off."
    text = f"voltage is {volts:.3f} V throughout the flight, though rotors load a battery. {cost}"
    advice = "Look at what writes it. A supply or a simulation may hold its voltage; a battery does not."
    return Finding("frozen", grade, text, "voltage", (), {"voltage_V": volts}, advice)


def _signal(recording: Recording, name: str, array: SignalArray, flight: Airtime) -> list[_Stuck]:
    """Stuck stretches of all components together, then of single ones of sensors."""
    if not flight.known or not flight.airborne:
        return []
    flying = inside(array.time, flight.airborne)
    if flying.sum() < FEWEST_STILL_SAMPLES:
        return []
    still = [same_as_before(column[:, None]) & flying for column in array.value.T]
    together = np.logical_and.reduce(still)
    least = SHORTEST_STILLNESS[array.quantity]
    found = []
    stuck = [s for s in _stretches(array, together, least) if _others_moved(recording, name, array, s)]
    if stuck:
        found.append(_Stuck(name, array, "", stuck, flying))
    if array.quantity in _INERTIAL_SIGNALS or array.quantity == "rotor_speed":
        whole = np.zeros(array.time.size, bool)
        for first, last in stuck:
            whole[first:last] = True
        for component, flags in zip(array.components, still, strict=True) if array.components else ():
            alone = _stretches(array, flags & ~whole, least)
            alone = [s for s in alone if _company(array, s) and _others_moved(recording, name, array, s)]
            if alone:
                found.append(_Stuck(name, array, component, alone, flying))
    return found


def _stretches(array: SignalArray, flags: Flags, least: float) -> list[tuple[int, int]]:
    """(first row, row after the last) of unusually long still stretches; the first row is the last true sample."""
    spans = runs_of(flags)
    if not spans.size:
        return []
    lengths = spans[:, 1] - spans[:, 0]
    enough = (array.time[spans[:, 1] - 1] - array.time[spans[:, 0] - 1] >= least) & (lengths >= FEWEST_STILL_SAMPLES)
    if not enough.any():
        return []
    # usual length, from the other still stretches of the channel: a coarse channel stays constant often and long
    others = lengths[~enough]
    habit = float(np.percentile(others, 99)) if others.size else 0.0
    enough &= lengths >= STILLNESS_RATIO * habit
    return [(int(a) - 1, int(b)) for a, b in spans[enough]]


def _company(array: SignalArray, span: tuple[int, int]) -> bool:
    """True if the other components change often in the stretch, so new samples arrived."""
    part = array.value[span[0] : span[1]]
    return int((part[1:] != part[:-1]).any(axis=1).sum()) >= FEWEST_STILL_SAMPLES


def _others_moved(recording: Recording, name: str, array: SignalArray, span: tuple[int, int]) -> bool:
    """True if other signals show that this signal should change; inertial sensors should always change."""
    start, end = float(array.time[span[0]]), float(array.time[span[1] - 1])
    quantity = array.quantity
    if quantity in _INERTIAL_SIGNALS:
        return True
    if quantity in ("motor_command", "rotor_speed"):
        other = "rotor_speed" if quantity == "motor_command" else "motor_command"
        spread = _spread(recording, other, start, end)
        if math.isnan(spread):
            return quantity == "motor_command"
        return spread > (30.0 if other == "rotor_speed" else 0.03)
    if quantity == "position":
        moved = _travelled(recording, "velocity", start, end)
    elif quantity == "velocity":
        moved = _spread(recording, "acceleration", start, end) * (end - start) * 0.25
        if math.isnan(moved):
            moved = _bent(recording, start, end)
    else:
        moved = _travelled(recording, "body_rate", start, end)
    if math.isnan(moved):
        # no related signal: use another measurement of the same quantity
        others = [other for other, a in recording.signals.items() if other != name and a.quantity == quantity]
        moved = _spread(recording, others[0], start, end) if others else math.nan
    return end - start > 1.0 if math.isnan(moved) else moved > _LEAST_MOTION[quantity]


def _between(recording: Recording, name: str, start: float, end: float) -> NDArray[np.float64]:
    """(n, c) finite samples of a signal within an interval; empty without the signal."""
    array = recording.signals.get(name)
    if array is None:
        return np.empty((0, 1))
    value = array.value[(array.time >= start) & (array.time <= end)]
    return value[np.isfinite(value).all(axis=1)]


def _spread(recording: Recording, name: str, start: float, end: float) -> float:
    """Largest range of a component within an interval; NaN without samples."""
    value = _between(recording, name, start, end)
    return float(np.ptp(value, axis=0).max()) if value.shape[0] > 2 else math.nan


def _travelled(recording: Recording, name: str, start: float, end: float) -> float:
    """Length of the integral of a rate over an interval; NaN without samples."""
    value = _between(recording, name, start, end)
    return float(np.linalg.norm(value.mean(axis=0))) * (end - start) if value.shape[0] > 2 else math.nan


def _bent(recording: Recording, start: float, end: float) -> float:
    """Change of the mean velocity between the halves of an interval, from the position; NaN without samples."""
    value = _between(recording, "position", start, end)
    if value.shape[0] < 6:
        return math.nan
    half = value.shape[0] // 2
    change = (value[-1] - value[half]) - (value[half] - value[0])
    return float(np.linalg.norm(change)) / max(0.5 * (end - start), 1e-6)


def _finding(first: _Stuck, names: list[str]) -> Finding:
    rows = np.zeros(first.array.time.size, bool)
    for start, end in first.stretches:
        rows[start + 1 : end] = True
    share = float((rows & first.flying).sum()) / float(first.flying.sum())
    lasting = max(b - a for a, b in first.spans)
    count = len(first.stretches)
    times = "once" if count == 1 else f"{count} times"
    together = len(names) > 1
    label = listed(names) if together else f"{first.name} {first.component}".strip()
    return Finding(
        "frozen",
        Grade.UNUSABLE if share > 0.5 else Grade.DEGRADES,
        f"{label} {'stand' if together else 'stands'} still {times} in flight, for {percent(share)} of it "
        f"(the longest {lasting:.2f} s)" + (": the log stood still, not the drone." if together else "."),
        signal="" if together else first.name,
        intervals=longest(first.spans),
        evidence={"stretches": count, "share": share, "longest_s": lasting, "samples": int(rows.sum())},
        advice="Mark the repeats as missing (--fix) and look at the sensor or the log.",
        fix=Fix("mark", tuple(names), rows=np.flatnonzero(rows)),
    )
