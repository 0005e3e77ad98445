"""Check: rotors at their upper or lower limit in flight."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor.streams import longest, runs
from crazyem.recordings.airborne import Airtime, airtime
from crazyem.recordings.finding import Finding, Grade, intervals_of, percent
from crazyem.recordings.ordering import Intervals, inside, ordered
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


def _upper(
    recording: Recording, name: str, time: NDArray[np.float64], value: NDArray[np.float64], rows: NDArray[np.bool_]
) -> Iterator[Finding]:
    flags = np.zeros(value.shape, bool)
    ceilings = []
    for rotor, column in enumerate(value.T):
        top = float(column[rows].max())
        if top >= FULL_DUTY:
            flags[:, rotor] = (column >= FULL_DUTY) & rows
        elif top > 0.5 and _is_ceiling(column, top, rows):
            flags[:, rotor] = (column == top) & rows
            ceilings.append(top)
    shares = flags[rows].mean(axis=0)
    if not flags.any():
        return
    any_rotor: NDArray[np.bool_] = np.logical_or.reduce(flags, axis=1)
    share = float(any_rotor[rows].mean())
    spans = intervals_of(time, any_rotor)
    lasting = max(b - a for a, b in spans)
    evidence: dict[str, float] = {"share": share, "longest_s": lasting}
    evidence |= {f"share_m{i + 1}": float(s) for i, s in enumerate(shares)}
    if ceilings:
        evidence["ceiling"] = min(ceilings)
    words = ", ".join(f"m{i + 1} {percent(s)}" for i, s in enumerate(shares) if s > 0)
    text = f"The {_COMMAND_WORDS[name]} of a rotor is at its upper limit in {percent(share)} of the flight ({words})"
    volts = _voltage(recording, time[any_rotor])
    if np.isfinite(volts):
        evidence["voltage_V"] = volts
        if volts / max(1, round(volts / 3.8)) < LOW_CELL:
            text += f", on a low battery ({volts:.2f} V)"
    grade = Grade.DEGRADES if share >= DEGRADING_SATURATED_SHARE else Grade.HARMLESS
    advice = (
        "The controller did not get what it asked for: the firmware takes the excess of one rotor from all "
        "four. Use the duty that was sent, not the thrust asked for, and charge the battery or fly gentler."
    )
    yield Finding("saturation", grade, text + ".", name, longest(spans), evidence, advice)


def _is_ceiling(column: NDArray[np.float64], top: float, rows: NDArray[np.bool_]) -> bool:
    """True if the largest value is a limit: too frequent, and too long at a time, for a maximum of a coarse signal."""
    at_top = (column == top) & rows
    count = int(at_top.sum())
    spans = runs(at_top)
    below = int(((column < top) & (column >= 0.97 * top) & rows).sum())
    often = count >= max(10, 0.002 * rows.sum()) and count > 0.5 * below
    return often and bool((spans[:, 1] - spans[:, 0]).max() >= _CEILING_RUN)


def _lower(
    name: str, time: NDArray[np.float64], value: NDArray[np.float64], rows: NDArray[np.bool_], flight: Airtime
) -> Iterator[Finding]:
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
    any_rotor: NDArray[np.bool_] = np.logical_or.reduce(flags, axis=1)
    share = float(any_rotor[rows].mean())
    if any_rotor.sum() < 3 or share < 5e-4:
        return
    shares = flags[rows].mean(axis=0)
    spans = intervals_of(time, any_rotor)
    words = ", ".join(f"m{i + 1} {percent(s)}" for i, s in enumerate(shares) if s > 0)
    yield Finding(
        "saturation",
        Grade.DEGRADES if share >= 4.0 * DEGRADING_SATURATED_SHARE else Grade.HARMLESS,
        f"The {_COMMAND_WORDS[name]} of a rotor is at its lower limit in {percent(share)} of the flight ({words}).",
        signal=name,
        intervals=longest(spans),
        evidence={
            "share": share,
            "longest_s": max(b - a for a, b in spans),
            "floor": float(value[any_rotor].min()),
            **{f"share_m{i + 1}": float(s) for i, s in enumerate(shares)},
        },
        advice="At idle the thrust law is least certain; leave these stretches out of fits of the thrust curve.",
    )


def _voltage(recording: Recording, times: NDArray[np.float64]) -> float:
    """Median voltage at these times; NaN without a voltage on the same clock."""
    array = recording.signals.get("voltage")
    if array is None or array.time.size < 2:
        return float("nan")
    time, value = ordered(array)
    if time.size < 2:
        return float("nan")
    return float(np.median(np.interp(times, time, value[:, 0])))
