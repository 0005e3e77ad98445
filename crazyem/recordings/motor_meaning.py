"""The meaning of motor.m1..4 in a firmware log, decided from evidence: the requested thrust, or the PWM sent.

Until 2022-11-09 (crazyflie-firmware #1147, commit 96a23724) motor.m1..4 is the request of the mixer, before battery
compensation. Since then motor.m1..4 is the PWM ratio that is sent, after compensation. A file does not say which.
The evidence, strongest first:

* pwm.m1..4_pwm, always the PWM sent (#83, 2015): equal to motor.m1..4 or not.
* The age of the firmware, from a version in the metadata, from variables that old firmware did not have, and from the
  type of motor.m1: int32 until 2020-02-28 (#554), uint32 then, uint16 since 2024-05-29 (#1380, e5eafd5c).
* The arithmetic of the mixer. Without compensation m1..4 = T -+ r +- p +- y, with whole numbers r, p, y and truncated
  T. So m1+m3-m2-m4, m1+m2-m3-m4 and m1+m4-m2-m3 are multiples of 4 in every row. After compensation, which is not
  linear, they are so by chance only, in one row of 16. On real logs: 99.9 to 100 % of rows of known requests, 5 to 7 %
  of known PWM (docs/reference/formats/usd.md).
* controller.cmd_*, from which the output of the mixer can be computed and compared.

The relation of commands and battery voltage is no evidence: the slope of log(request) over log(voltage) should be 0,
but is -1.07 +- 0.42 on real flights with known requests. Air and propellers change the slope as much.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import UsageError
from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.tables import MOTOR_MEANINGS, Table

MOTOR_VARIABLES = ("motor.m1", "motor.m2", "motor.m3", "motor.m4")
_PWM_VARIABLES = tuple(f"pwm.m{i}_pwm" for i in (1, 2, 3, 4))
_MIXER_VARIABLES = tuple(f"controller.cmd_{name}" for name in ("thrust", "roll", "pitch", "yaw"))
_FULL_PWM = 65535.0

# Variables that crazyflie-firmware has since the change or later, with pull request and date.
_NEWER_VARIABLES: tuple[tuple[str, str], ...] = (
    (r"motor\.m[1-4]req", "#1147, 2022-11"),  # part of the change: "requested, including compensation"
    (r"supervisor\.(info|accNorm)", "#1272 and #1281, 2023-05"),
    (r"ctrlLee\.(thrustSi|torque[xyz]|error_\w+)", "#1343, 2024-01"),
    (r"motor\.m[1-4]_e?rpm", "#1556, 2025-11"),
)
_FIRST_NEW_RELEASE, _LAST_OLD_RELEASE = (2023, 2), (2022, 9)  # year and month of the releases next to the change
_RELEASE_PATTERN = re.compile(r"\b(20\d\d)\.(\d{1,2})\b")
_FEWEST_ROWS = 30  # fewer rows are no evidence; 30 rows agree by chance with probability 0.1**30 or 0.5**30
_MEANING_NAMES = {"duty": "the PWM sent, after battery compensation", "request": "the thrust asked for, before it"}


@dataclass(frozen=True, slots=True, eq=False)
class Meaning:
    """The meaning of motor.m1..4."""

    # "duty" (PWM sent, after battery compensation), "request" (thrust asked for, before compensation), or None without
    # evidence or without motor.m1..4
    meaning: str | None
    reason: str = ""  # why, one sentence; "" without motor.m1..4
    evidence: Mapping[str, float] = field(default_factory=dict)  # the numbers that support it
    # for the `findings` of the recording: the decision, a question to the user, or a contradiction
    findings: tuple[Finding, ...] = ()

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Section "motor" for the recording's `metadata`; none without motor.m1..4."""
        return {"motor": {"meaning": self.meaning or "unknown", "reason": self.reason}} if self.reason else {}


# "duty" or "request", and the reason
_Vote = tuple[str, str]


def decide(
    tables: Sequence[Table], *, given: str | None = None, metadata: Mapping[str, Mapping[str, str]] | None = None
) -> Meaning:
    """Decide the meaning of motor.m1..4 of a recording.

    Args:
        tables: firmware variables as logged, not interpolated; `ctypes` only if they are the types in the firmware (a
            host may fetch a variable as another type).
        given: the meaning by the user ("duty" or "request"); overrides the evidence, and a finding reports a
            contradiction.
        metadata: of the recording: a firmware version, or names of the drone's log variables in ["drone"].

    Raises: UsageError if `given` is something else.
    """
    if given is not None and given not in MOTOR_MEANINGS:
        raise UsageError(f'motor.m1..4 is "duty" or "request", not "{given}".')
    table = next((t for t in tables if set(MOTOR_VARIABLES) <= t.columns.keys()), None)
    if table is None:
        return Meaning(None)
    evidence: dict[str, float] = {}
    sent = _compare_with_sent(table, evidence)
    ages, mixer = _judge_age(tables, metadata or {}), _judge_mixer(table, evidence)
    return _answer(*(sent or _weigh(ages, mixer)), given, evidence)


def _weigh(ages: Sequence[_Vote], mixer: _Vote | None) -> tuple[str | None, str]:
    """The verdict of the votes of age and mixer, with its reason."""
    meanings, words = {meaning for meaning, _ in ages}, "; ".join(text for _, text in ages)
    if len(meanings) > 1:
        return None, f"the log contradicts itself: {words}"
    if not meanings:
        return mixer or (None, "nothing in the log tells")
    (age,) = meanings
    if mixer is None or mixer[0] == age:
        return age, "; ".join([words] + ([mixer[1]] if mixer else []))
    if age == "duty":  # new firmware sends the mixer's output as it is where compensation is switched off
        return age, f"{words}; {mixer[1]}, so the battery compensation was off"
    return None, f"the log contradicts itself: {words}; {mixer[1]}"


def _answer(decided: str | None, reason: str, given: str | None, evidence: dict[str, float]) -> Meaning:
    meaning, grade, advice = given or decided, Grade.DEGRADES, ""
    if meaning is None:
        either = f"{_MEANING_NAMES['duty']}, or {_MEANING_NAMES['request']}"
        text = f"What motor.m1..4 is cannot be told ({reason}): it may be {either}."
        advice = "Say --motor duty or --motor request."
    elif decided not in (None, meaning):
        contrary = f"{_MEANING_NAMES[str(decided)]} ({reason})"
        text = f"motor.m1..4 is taken as {_MEANING_NAMES[meaning]}, as told, but the log says: {contrary}."
        advice = f"Leave --motor out, or say --motor {decided}."
        reason = f"said by the user, against the log ({reason})"
    else:
        reason = reason if decided else f"said by the user; {reason}"
        grade, text = Grade.HARMLESS, f"motor.m1..4 is {_MEANING_NAMES[meaning]}: {reason}."
    finding = Finding("motor_meaning", grade, text, evidence=evidence, advice=advice)
    return Meaning(meaning, reason, evidence, (finding,))


def _matrix(table: Table, names: Sequence[str]) -> NDArray[np.float64]:
    """(len(names), n) of columns."""
    return np.stack([np.asarray(table.columns[name], float) for name in names])


def _compare_with_sent(table: Table, evidence: dict[str, float]) -> _Vote | None:
    if not set(_PWM_VARIABLES) <= table.columns.keys():
        return None
    motor, sent = _matrix(table, MOTOR_VARIABLES), _matrix(table, _PWM_VARIABLES)
    turning = (sent > 0) & (sent < _FULL_PWM)
    if turning.sum() < _FEWEST_ROWS:
        return None
    equal = float((motor == sent)[turning].mean())
    evidence["pwm_equal_share"] = equal
    if equal > 0.5:
        return "duty", f"it equals pwm.m1..4_pwm in {100 * equal:.0f} % of samples"
    text = f"it equals pwm.m1..4_pwm in only {100 * equal:.1f} % of samples"
    voltage = _voltage(table)
    if voltage is not None:
        error = float(np.median(np.abs(_compensated(motor, voltage) - sent)[turning]))
        evidence["compensation_error_counts"] = error
        text += f", the old battery compensation turns one into the other within {error:.0f} counts (median)"
    return "request", text


def _voltage(table: Table) -> NDArray[np.float64] | None:
    for name, scale in (("pm.vbat", 1.0), ("pm.vbatMV", 1000.0)):
        if name in table.columns:
            return np.asarray(table.columns[name], float) / scale
    return None


def _compensated(request: NDArray[np.float64], voltage: NDArray[np.float64]) -> NDArray[np.float64]:
    """PWM for a request [counts] in firmware before 2025: a parabola through a measured table (motors.c)."""
    grams = request / 65536.0 * 60.0
    with np.errstate(divide="ignore", invalid="ignore"):
        return _FULL_PWM * (-0.0006239 * grams * grams + 0.088 * grams) / voltage


def _judge_age(tables: Sequence[Table], metadata: Mapping[str, Mapping[str, str]]) -> list[_Vote]:
    votes: list[_Vote] = []
    names = {name for table in tables for name in table.columns}
    names.update(metadata.get("drone", {}).get("log_variables", "").split())
    for pattern, origin in _NEWER_VARIABLES:
        found = sorted(name for name in names if re.fullmatch(pattern, name))
        if found:
            votes.append(("duty", f"the firmware has {found[0]}, which came later ({origin})"))
            break
    types = {table.ctypes[name] for table in tables for name in MOTOR_VARIABLES if name in table.ctypes}
    if types == {"uint16_t"}:
        votes.append(("duty", "it is a uint16, as since 2024-05-29"))
    elif types == {"int32_t"}:
        votes.append(("request", "it is an int32, as until 2020-02-28"))
    version = _version(metadata)
    if version is not None and not _LAST_OLD_RELEASE < version < _FIRST_NEW_RELEASE:
        meaning = "duty" if version >= _FIRST_NEW_RELEASE else "request"
        votes.append((meaning, f"the firmware is of {version[0]}-{version[1]:02d}"))
    return votes


def _version(metadata: Mapping[str, Mapping[str, str]]) -> tuple[int, int] | None:
    """Year and month of the firmware release, from metadata whose section or key contains "firmware"."""
    for section, entries in metadata.items():
        for key, text in entries.items():
            found = _RELEASE_PATTERN.search(text[:200])
            if found and "firmware" in f"{section} {key}".lower():
                return int(found[1]), int(found[2])
    return None


def _judge_mixer(table: Table, evidence: dict[str, float]) -> _Vote | None:
    motor = _matrix(table, MOTOR_VARIABLES)
    # rows with a clipped rotor or four equal ones (idle on the ground) are no evidence about the mixer
    usable = ((motor > 0) & (motor < _FULL_PWM) & (motor == np.floor(motor))).all(axis=0) & (np.ptp(motor, axis=0) > 0)
    rows = int(usable.sum())
    if rows < _FEWEST_ROWS:
        return None
    m1, m2, m3, m4 = motor[:, usable].astype(np.int64)
    whole = [(m1 + m3 - m2 - m4) % 4 == 0, (m1 + m2 - m3 - m4) % 4 == 0, (m1 + m4 - m2 - m3) % 4 == 0]
    share = float(np.logical_and.reduce(whole).mean())
    evidence |= {"mixer_share": share, "mixer_rows": rows}
    equal = _compare_with_mixer(table, motor, usable)
    if equal is not None:
        evidence["mixer_equal_share"] = equal
        if equal > 0.5:
            return "request", f"it is what the mixer makes of controller.cmd_* in {100 * equal:.0f} % of rows"
    text = f"it is on the mixer's whole-number grid in {100 * share:.1f} % of rows"
    if share > 0.9:
        return "request", f"{text}, not compensated"
    return ("duty", f"{text} (by chance: 6 %)") if share < 0.5 else None


def _compare_with_mixer(table: Table, motor: NDArray[np.float64], usable: NDArray[np.bool_]) -> float | None:
    """Share of rows with m = T -+ r +- p +- y from controller.cmd_*, which are 0 unless the controller is the PID."""
    if not set(_MIXER_VARIABLES) <= table.columns.keys():
        return None
    thrust, roll, pitch, yaw = _matrix(table, _MIXER_VARIABLES)
    rows = usable & (thrust > 0)
    if rows.sum() < _FEWEST_ROWS:
        return None
    r, p = np.trunc(roll / 2.0), np.trunc(pitch / 2.0)
    mixed = np.trunc(np.stack([thrust - r + p + yaw, thrust - r - p - yaw, thrust + r - p + yaw, thrust + r + p - yaw]))
    return float((np.abs(mixed - motor) <= 1.0).all(axis=0)[rows].mean())
