"""Check: rotors at their upper or lower limit in flight."""

import math
from collections.abc import Iterator

import numpy as np

from crazyem.doctor.streams import longest
from crazyem.recordings.airborne import Airtime, airtime
from crazyem.recordings.finding import Finding, Grade, intervals_of, percent, runs_of
from crazyem.recordings.ordering import Array, Flags, Intervals, inside, ordered, sound_signal
from crazyem.recordings.recording import Recording

FULL_DUTY = 0.999  # share of the largest duty that counts as full
DEGRADING_SATURATED_SHARE = 0.005  # share of the flight that degrades results: actual and commanded wrench differ
LOW_CELL = 3.3  # V per cell under load, below which a battery is low
_CEILING_RUN = 3  # samples in a row at the same largest value that show a limit
_COMMAND_WORDS = {"motor_command": "duty", "motor_request": "thrust request"}


def check(recording: Recording) -> list[Finding]:
    """Findings about rotors at the upper or lower limit of commanded duty or requested thrust while airborne."""
    flight = airtime(recording)
    found: list[Finding] = []
    for name in ("motor_command", "motor_request"):
        array = recording.signals.get(name)
        if array is None or array.time.size < 20:
            continue
        time, value = ordered(array)
        if not time.size or not np.mean((value >= 0.0) & (value <= 1.0 + 1e-6)) > 0.8:
            continue  # another unit: `numbers` says so
        airborne = flight.airborne if flight.known else ()
        rows = inside(time, airborne)
        if rows.sum() >= 20:
            found += _upper(recording, name, time, value, rows)
            found += _lower(name, time, value, rows, flight)
    return found


def _upper(recording: Recording, name: str, time: Array, value: Array, rows: Flags) -> Iterator[Finding]:
    flags = np.zeros(value.shape, bool)
    ceilings = []
    for rotor, column in enumerate(value.T):
        top = float(column[rows].max())
        if top >= FULL_DUTY:
            flags[:, rotor] = (column >= FULL_DUTY) & rows
        elif top > 0.5 and _is_ceiling(column, top, rows):
            flags[:, rotor] = (column == top) & rows
            ceilings.append(top)
    if not flags.any():
        return
    any_rotor: Flags = np.logical_or.reduce(flags, axis=1)
    share, shares, words = _shares(flags[rows])
    spans = intervals_of(time, any_rotor)
    evidence = {"share": share, "longest_s": max(b - a for a, b in spans), **shares}
    if ceilings:
        evidence["ceiling"] = min(ceilings)
    text = f"The {_COMMAND_WORDS[name]} of a rotor is at its upper limit in {percent(share)} of the flight ({words})"
    volts = _voltage(recording, time[any_rotor])
    if math.isfinite(volts):
        evidence["voltage_V"] = volts
        if volts / max(1, round(volts / 3.8)) < LOW_CELL:
            text += f", on a low battery ({volts:.2f} V)"
    grade = Grade.DEGRADES if share >= DEGRADING_SATURATED_SHARE else Grade.HARMLESS
    advice = (
        "The controller did not get what it asked for: the firmware takes the excess of one rotor from all "
        "four. Use the duty that was sent, not the thrust asked for, and charge the battery or fly gentler."
    )
    yield Finding("saturation", grade, text + ".", name, longest(spans), evidence, advice)


def _shares(flags: Flags) -> tuple[float, dict[str, float], str]:
    """Share of the samples (n, c) with any rotor at a limit, share of each rotor, and the latter in words."""
    shares = {f"m{i + 1}": float(share) for i, share in enumerate(flags.mean(axis=0))}
    words = ", ".join(f"{rotor} {percent(share)}" for rotor, share in shares.items() if share > 0)
    return float(flags.any(axis=1).mean()), {f"share_{rotor}": share for rotor, share in shares.items()}, words


def _is_ceiling(column: Array, top: float, rows: Flags) -> bool:
    """True if the largest value is a limit: too frequent, and too long at a time, for a maximum of a coarse signal."""
    at_top = (column == top) & rows
    count = int(at_top.sum())
    spans = runs_of(at_top)
    below = int(((column < top) & (column >= 0.97 * top) & rows).sum())
    often = count >= max(10, 0.002 * rows.sum()) and count > 0.5 * below
    return often and bool((spans[:, 1] - spans[:, 0]).max() >= _CEILING_RUN)


def _lower(name: str, time: Array, value: Array, rows: Flags, flight: Airtime) -> Iterator[Finding]:
    """Finding about rotors at idle or off while airborne, without the first and last 0.5 s (start and stop)."""
    inner: Intervals = tuple((a + 0.5, b - 0.5) for a, b in flight.airborne if b - a > 1.5)
    rows = rows & inside(time, inner)
    if rows.sum() < 20:
        return
    flags = np.zeros(value.shape, bool)
    floor = float(value.min())
    running = value[value > 0.02]
    idle = float(running.min()) if running.size else floor
    for rotor, column in enumerate(value.T):
        low = column[rows].min()
        # the lower limit is common to all four rotors: idle or zero
        if low <= max(idle, floor) * (1.0 + 1e-6) and low < 0.35:
            flags[:, rotor] = (column <= low * (1.0 + 1e-6)) & rows
    any_rotor: Flags = np.logical_or.reduce(flags, axis=1)
    share, shares, words = _shares(flags[rows])
    if any_rotor.sum() < 3 or share < 5e-4:
        return
    spans = intervals_of(time, any_rotor)
    grade = Grade.DEGRADES if share >= 4.0 * DEGRADING_SATURATED_SHARE else Grade.HARMLESS
    text = f"The {_COMMAND_WORDS[name]} of a rotor is at its lower limit in {percent(share)} of the flight ({words})."
    lasting = max(b - a for a, b in spans)
    evidence = {"share": share, "longest_s": lasting, "floor": float(value[any_rotor].min()), **shares}
    advice = "At idle the thrust law is least certain; leave these stretches out of fits of the thrust curve."
    yield Finding("saturation", grade, text, name, longest(spans), evidence, advice)


def _voltage(recording: Recording, times: Array) -> float:
    """Median voltage at these times; NaN without a voltage."""
    found = sound_signal(recording, "voltage")
    if found is None or found[0].size < 2:
        return math.nan
    return float(np.median(np.interp(times, found[0], found[1][:, 0])))
