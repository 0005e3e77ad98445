"""Check: rows and values stored again without a new measurement, and the true rate of the measurements.

A coarse signal of a hovering drone repeats by chance. So only fine signals are evidence: their steps are rarely as
small as a few resolutions. Coarse signals that repeat together with a fine one come in the same packet.
"""

import numpy as np

from crazyem.doctor.streams import COMMAND_SIGNALS, Stream, cadence, listed, places, same_as_before, sole, streams
from crazyem.recordings.airborne import Airtime, airtime
from crazyem.recordings.finding import Finding, Fix, Grade, percent, runs_of
from crazyem.recordings.ordering import Array, Flags, inside, sound_rows
from crazyem.recordings.recording import Recording, SignalArray

# signals that may come from a slower firmware task than the rest of their table; the table then holds the last value
_SLOW_SIGNALS = frozenset({"voltage", "motor_command", "motor_request", "rotor_speed"})

REPORTED_REPEAT_SHARE = 0.01  # smallest reported share of repeated rows
DEGRADING_REPEAT_SHARE = 0.05  # share that degrades results: a repeat is a value that is one sample old
FINE_STEP_SHARE = 0.05  # largest share of steps within four resolutions, for a fine component
ONE_PACKET_SHARE = 0.9  # least share of common repeats of signals in one packet


def check(recording: Recording) -> list[Finding]:
    """Findings about repeated rows of each stream, and about signals that are held between slower measurements."""
    flight = airtime(recording)  # signals may repeat while the drone stands on the ground
    return [finding for stream in streams(recording) for finding in _stream(stream, flight)] if flight.airborne else []


def _stream(stream: Stream, flight: Airtime) -> list[Finding]:
    time = stream.time
    stored = cadence(time).period
    considered = inside(time, flight.airborne)
    if considered.sum() < 50 or not stored > 0:
        return []
    considered[0] = False
    same: dict[str, Flags] = {}
    fine: list[str] = []
    found = []
    for name, array in zip(stream.names, stream.arrays, strict=True):
        if not array.quantity or array.quantity in COMMAND_SIGNALS:
            continue
        flags = same_as_before(array.value) & considered & ~_resting(array)
        beat = _hold(flags, considered & sound_rows(array.value)) if array.quantity in _SLOW_SIGNALS else None
        if beat is not None and flags.sum() >= 0.3 * considered.sum() and not _creeps(array):
            rate = 1.0 / stored / beat
            text = f"{name} is measured at about {rate:.0f} Hz and held in between (stored at {1.0 / stored:.0f} Hz)."
            evidence = {"share": float(flags[considered].mean()), "rate_hz": rate, "stored_hz": 1.0 / stored}
            advice = "Count it at its real rate."
            found.append(Finding("repeated", Grade.HARMLESS, text, name, (), evidence, advice))
            continue
        same[name] = flags
        if _is_fine(array, considered):
            fine.append(name)
    whole = np.logical_and.reduce([same[name] for name in fine]) if fine else np.zeros(time.size, bool)
    rest = {name: same[name] & ~whole for name in fine}
    if whole.sum() >= REPORTED_REPEAT_SHARE * considered.sum():
        names = [name for name in same if name in fine or _follows(same[name], whole)]
        found.append(_finding(names, time, whole, considered, 1.0 / stored, whole_table=len(fine) > 1))
    while rest:
        first, rows = rest.popitem()
        group = [first, *(name for name in rest if _follows(rest[name], rows) and _follows(rows, rest[name]))]
        for name in group[1:]:
            rest.pop(name)
        if rows.sum() >= 2.0 * REPORTED_REPEAT_SHARE * considered.sum():
            names = [n for n in same if n in group or (n not in fine and _follows(same[n], rows))]
            found.append(_finding(names, time, rows, considered, 1.0 / stored, whole_table=False))
    return found


def _follows(flags: Flags, rows: Flags) -> bool:
    """True if a signal repeats in (nearly) all of the rows."""
    return bool((flags & rows).sum() >= ONE_PACKET_SHARE * rows.sum())


def _resting(array: SignalArray) -> Flags:
    """(n,) True where all commands are at their least or greatest value, at which they may stay."""
    sound = array.value[np.isfinite(array.value)]
    if array.quantity not in ("motor_command", "motor_request") or sound.size == 0:
        return np.zeros(array.time.size, bool)
    return ((array.value == sound.min()) | (array.value == sound.max())).all(axis=1)


def _is_fine(array: SignalArray, considered: Flags) -> bool:
    """True if the signal cannot repeat by chance: almost none of its steps is as small as its resolution.

    A compressed quaternion has three coarse components, and the fourth follows from them. So three must be fine.
    """
    rows = np.flatnonzero(considered)
    rows = rows[:: max(1, rows.size // 20_000)]
    fine = 0
    for column in array.value.T:
        steps = np.abs(column[rows] - column[rows - 1])
        steps = steps[steps > 1e-9 * max(float(np.nanmax(np.abs(column[rows]), initial=0.0)), 1e-12)]
        if steps.size > 20:
            fine += bool((steps <= 4.0 * steps.min()).mean() <= FINE_STEP_SHARE)
    return fine >= (3 if array.quantity == "attitude" else 1)


def _hold(same: Flags, considered: Flags) -> float | None:
    """Period of the changes [rows] if it is regular and at least 1.5, else None."""
    changes = np.flatnonzero(~same & considered)
    if changes.size < 10:
        return None
    beats = np.diff(changes)
    for beat in sorted({float(np.percentile(beats, 10)), float(np.median(beats))}):
        if beat < 1.5:
            continue
        # a value that stays equal by chance makes an interval of two rows
        tolerance = max(1.0 if beat > 4 else 0.1, 0.2 * beat)
        single = np.abs(beats - beat) <= tolerance
        if not single.any():
            continue
        exact = float(beats[single].mean())
        multiple = np.maximum(np.round(beats / exact), 1.0)
        good = np.abs(beats - multiple * exact) <= tolerance * multiple
        if good.mean() >= 0.8 and single.mean() >= 0.3:
            return exact
    return None


def _creeps(array: SignalArray) -> bool:
    """True if a signal changes by single resolutions: then its slope causes the period, not the sensor."""
    steps = np.abs(np.diff(array.value[:, 0]))
    steps = steps[steps > 0]
    return steps.size < 10 or bool((steps <= 1.5 * steps.min()).mean() > 0.6)


def _finding(
    names: list[str], time: Array, rows: Flags, considered: Flags, stored: float, *, whole_table: bool
) -> Finding:
    share = float(rows[considered].mean())
    rate = stored * (1.0 - share)
    lengths = np.diff(runs_of(rows), axis=1)
    what = "whole rows" if whole_table else "values"
    text = (
        f"{percent(share)} of the {what} of {listed(names)} in flight repeat the one before: "
        f"stored at {stored:.0f} Hz, measured at about {rate:.0f} Hz."
    )
    evidence = {"samples": int(rows.sum()), "share": share, "rate_hz": rate, "stored_hz": stored}
    evidence["longest_samples"] = float(lengths.max())
    advice = "Mark the repeats as missing (--fix); they are old values with a new stamp."
    fix = Fix("mark", tuple(names), rows=np.flatnonzero(rows))
    grade = Grade.DEGRADES if share > DEGRADING_REPEAT_SHARE else Grade.HARMLESS
    return Finding("repeated", grade, text, sole(names), places(time, rows), evidence, advice, fix)
