"""Check: angles against the quaternion, and the quaternion against gyro and gravity: unit, sign, order, direction."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor import kinematics
from crazyem.doctor.hypotheses import sign_factor, signed
from crazyem.doctor.regression import Choice, blocks, choose, slope
from crazyem.physics.rotations import euler_from_quaternion, rotate
from crazyem.recordings.finding import Finding, Fix, Grade, runs_of
from crazyem.recordings.ordering import Array
from crazyem.recordings.recording import Recording, SignalArray

DEGREES = 180.0 / math.pi
ANGLE_UNITS = {"degrees": DEGREES, "converted": 1.0 / DEGREES}
LEAST_ANGLE_RMS = math.radians(0.1)  # rad rms; an angle that moves less is not judged
LEAST_CORRELATION = 0.8  # least correlation of an angle with an angle of the quaternion for a judgement
LARGEST_ANGLES = (math.radians(80.0), math.radians(65.0))  # roll and pitch up to which Euler angles are judged
ANGLE_NAMES = ("roll", "pitch", "yaw")
# Ways to read four numbers as an attitude: name -> (cost: the lower, the simpler; columns in the order x y z w;
# whether conjugated).
READINGS: dict[str, tuple[int, tuple[int, ...], bool]] = {
    "x y z w, body to world": (0, (0, 1, 2, 3), False),
    "w x y z, body to world": (1, (1, 2, 3, 0), False),
    "x y z w, world to body": (1, (0, 1, 2, 3), True),
    "w x y z, world to body": (2, (1, 2, 3, 0), True),
}


def check(recording: Recording) -> list[Finding]:
    """Findings about every quaternion (against gyro and gravity) and all Euler angles (against quaternions)."""
    found: list[Finding] = []
    wrong: set[str] = set()
    attitudes = kinematics.measurements(recording, "attitude")
    for name, array in attitudes.items():
        finding = _quaternion(name, array, recording)
        if finding is not None:
            found.append(finding)
            wrong.add(name)
    sound = {name: array for name, array in attitudes.items() if name not in wrong}
    for name, array in kinematics.measurements(recording, "euler").items():
        # a quaternion of the same origin first: one of another origin may have another heading, and a lag
        ordered = sorted(sound, key=lambda other: kinematics.origin_of(other) != kinematics.origin_of(name))
        for other in ordered:
            findings = _euler(name, array, other, sound[other])
            if findings is not None:
                found += findings
                break
    return found


def reading(array: SignalArray, name: str) -> SignalArray:
    """The array read in one of the `READINGS`."""
    _, columns, conjugated = READINGS[name]
    value = array.value[:, columns]
    return replace(array, value=value * np.array([-1.0, -1.0, -1.0, 1.0]) if conjugated else value)


def _quaternion(name: str, array: SignalArray, recording: Recording) -> Finding | None:
    """Finding if another reading of a quaternion than the declared one agrees with the gyro and with gravity."""
    upright = _by_gravity(array, recording)
    declared = next(iter(READINGS))
    chosen, evidence = _by_rate(array, recording)
    if chosen and upright and upright[chosen] < 0.9 and upright[declared] > 0.95:
        return None  # gravity supports the declared reading; the gyro may be wrong
    if not chosen and upright and upright[declared] < 0.5:
        # too little rotation: gravity does not depend on the heading, so it shows the order only
        chosen = max(upright, key=lambda key: (round(upright[key], 3), -READINGS[key][0]))
        if upright[chosen] < 0.9:
            return None
    if chosen in ("", declared):
        return None
    if upright:
        evidence |= {"upright_as_declared": upright[declared], "upright": upright[chosen]}
    text = f"{name} is {chosen}, not {declared}: only so does it agree with the gyro and with gravity."
    advice = "Correct the order or the direction of the quaternion where it is read."
    conjugate = chosen == "x y z w, world to body"
    fix = Fix("scale", (name,), (-1.0, -1.0, -1.0, 1.0)) if conjugate else None
    return Finding("angles", Grade.UNUSABLE, text, name, (), evidence, advice, fix)


def _by_rate(array: SignalArray, recording: Recording) -> tuple[str, dict[str, float]]:
    """The reading whose derivative agrees with the gyro ("" if the data do not decide), and evidence."""
    for gyro in kinematics.measurements(recording, "body_rate").values():
        grid = kinematics.grid_of(array, gyro)
        window = kinematics.Window(max(0.24, kinematics.width_for(array, gyro)))
        smooth = {
            key: window.mean(kinematics.rate_of_attitude(kinematics.track(reading(array, key), grid)))
            for key in READINGS
        }
        raw = kinematics.track(gyro, grid)
        # a conjugate turns the other way about nearly the same axes: one reading of each order suffices for the lag
        lags = [kinematics.delay(one, window.mean(raw)) for one in list(smooth.values())[:2]]
        good = [one for one in lags if one is not None and not one.at_edge]
        if not good:
            continue
        late = max(good, key=lambda one: one.explained)
        measured = window.mean(kinematics.track(gyro, grid, shift=late.value))
        valid = measured.valid & np.logical_and.reduce([one.valid for one in smooth.values()])
        rows = np.flatnonzero(valid)[::3]
        if rows.size < 100 or float(measured.value[rows].std()) < 0.04:
            continue
        candidates = {key: (READINGS[key][0], one.value[rows]) for key, one in smooth.items()}
        choice = choose(measured.value[rows], candidates, blocks(grid.time[rows]))
        if choice is None or not choice.name or choice.explained[choice.best] < 0.6:
            continue
        return choice.name, _explained(choice)
    return "", {}


def _explained(choice: Choice) -> dict[str, float]:
    return {
        "explained": choice.explained[choice.name or choice.best],
        "explained_as_declared": next(iter(choice.explained.values())),
        "unexplained_ratio": choice.ratio,
    }


def _by_gravity(array: SignalArray, recording: Recording) -> dict[str, float] | None:
    """For each reading, the cosine between up and the mean specific force in the world frame."""
    for force in kinematics.measurements(recording, "specific_force").values():
        grid = kinematics.grid_of(array, force)
        if grid.size == 0:
            continue
        felt = kinematics.track(force, grid)
        out = {}
        for key in READINGS:
            attitude = kinematics.track(reading(array, key), grid)
            valid = felt.valid & attitude.valid
            if valid.sum() < 200:
                return None
            world = rotate(attitude.value[valid], felt.value[valid]).mean(axis=0)
            out[key] = float(world[2] / max(np.linalg.norm(world), 1e-9))
        return out
    return None


def _euler(name: str, array: SignalArray, other: str, quaternion: SignalArray) -> list[Finding] | None:
    """Findings; None if the data allow no judgement."""
    grid = kinematics.grid_of(array, quaternion)
    window = kinematics.Window(max(0.1, kinematics.width_for(array, quaternion) / 2))
    truth = kinematics.track(_unwrapped(quaternion), grid)
    straight = _continuous_angles(array)
    late = kinematics.delay(window.mean(truth), window.mean(kinematics.track(straight, grid)), reach=0.15)
    lag = late.value if late is not None and not late.at_edge and late.explained > 0.5 else 0.0
    x, y = window.mean(truth), window.mean(kinematics.track(straight, grid, shift=lag))
    rows = np.flatnonzero(_upright(kinematics.track(quaternion, grid), x.valid & y.valid))[::3]
    if rows.size < 100:
        return None
    block = blocks(grid.time[rows])
    straight_x, straight_y = _unit_variance(x.value[rows]), _unit_variance(y.value[rows])
    # an angle that hardly moves is noise, so it is no evidence
    excited = x.value[rows].std(axis=0) >= LEAST_ANGLE_RMS
    alike = np.abs(straight_x.T @ straight_y) / rows.size
    known: NDArray[np.bool_] = np.any(alike > LEAST_CORRELATION, axis=0)
    if not (excited & known).any():
        return None
    ways = _orders(straight_x, known)
    choice = choose(straight_y * known, ways, block)
    if choice is None or choice.explained[choice.best] < 0.8:
        return None
    if choice.denied and choice.name:
        # each angle must agree by itself: noise has a sign, too
        match = (ways[choice.name][1] * straight_y).mean(axis=0)
        if not (match[known] > LEAST_CORRELATION).all():
            return None
    columns = np.flatnonzero(excited & known)
    slopes = {ANGLE_NAMES[i]: slope(x.value[rows, i], y.value[rows, i], block) for i in columns}
    parts = {key: s.value for key, s in slopes.items() if s is not None}
    evidence = {**_explained(choice), "lag_ms": 1e3 * lag, **{f"slope_{key}": s for key, s in parts.items()}}
    return _euler_findings(name, f"{name} against {other}: ", choice, parts, evidence)


def _euler_findings(
    name: str, head: str, choice: Choice, parts: Mapping[str, float], evidence: dict[str, float]
) -> list[Finding]:
    """Finding by the best reading of Euler angles: an inverted sign, another order or unit."""
    if choice.denied:
        what = choice.name.removeprefix("as declared ")
        factor = sign_factor(what, ANGLE_NAMES) if choice.name else None
        if factor is not None:
            turned = " and ".join(ANGLE_NAMES[i] for i in range(3) if factor[i] < 0)
            text = f"{head}the sign of {turned} is inverted."
            unit = _unit_of([s * factor[ANGLE_NAMES.index(key)] for key, s in parts.items()])
            scale = 1.0 / ANGLE_UNITS[unit] if unit else 1.0
            text = text if not unit else text[:-1] + f", and it is {_unit_said(unit)}."
            fix = Fix("scale", (name,), tuple(f * scale for f in factor))
            return [Finding("angles", Grade.UNUSABLE, text, name, (), evidence, "Correct its sign.", fix)]
        said = f"its components are {what}" if choice.name else "it does not agree, and why cannot be told"
        advice = "Correct the order of its components where it is read."
        return [Finding("angles", Grade.UNUSABLE, f"{head}{said}.", name, (), evidence, advice)]
    unit = _unit_of(list(parts.values()))
    if not unit:
        return []
    text = f"{head}it is {_unit_said(unit)}."
    fix = Fix("scale", (name,), (1.0 / ANGLE_UNITS[unit],) * 3)
    return [Finding("angles", Grade.UNUSABLE, text, name, (), evidence, "Correct its unit.", fix)]


def _upright(attitude: kinematics.Track, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(m,) True in the longest stretch in which roll and pitch are far from the jumps of Euler angles."""
    angles = np.abs(euler_from_quaternion(attitude.value))
    far = (angles[:, 0] < LARGEST_ANGLES[0]) & (angles[:, 1] < LARGEST_ANGLES[1]) | ~attitude.valid
    out = np.zeros(valid.size, bool)
    first, last = max(runs_of(far), key=np.ptp, default=(0, 0))
    out[first:last] = True
    return out & valid


def _unit_variance(value: Array) -> Array:
    spread = value.std(axis=0)
    return np.asarray((value - value.mean(axis=0)) / np.where(spread > 1e-12, spread, np.inf), float)


def _orders(x: Array, known: NDArray[np.bool_]) -> dict[str, tuple[int, Array]]:
    """Hypotheses of signs, and of the order yaw, pitch, roll; components that are not `known` are zero."""
    out = {}
    for key, (cost, value) in signed("as declared", x, ANGLE_NAMES).items():
        if cost <= 2 or [part.lstrip("-") for part in key.split(" ")[-3:]] == ["yaw,", "pitch,", "roll"]:
            out[key] = (cost, value * known)
    return out


def _unit_of(slopes: list[float]) -> str:
    """Key of `ANGLE_UNITS` nearest to the slopes; "" for radians, or if no unit is near."""
    if not slopes or min(slopes) <= 0.0:
        return ""
    middle = math.exp(float(np.mean(np.log(slopes))))
    return next((name for name, factor in ANGLE_UNITS.items() if abs(math.log(middle / factor)) < 0.3), "")


def _unit_said(unit: str) -> str:
    if unit == "degrees":
        return "in degrees, not radians"
    return "57.3 times too small: it was in radians, and was converted from degrees once too often"


def _unwrapped(quaternion: SignalArray) -> SignalArray:
    """Roll, pitch, yaw [rad] of a quaternion signal, without jumps."""
    norm = np.linalg.norm(quaternion.value, axis=1, keepdims=True)
    angles = np.unwrap(euler_from_quaternion(quaternion.value / np.where(norm > 0, norm, 1.0)), axis=0)
    return replace(quaternion, value=angles, quantity="euler")


def _continuous_angles(array: SignalArray) -> SignalArray:
    """The array without jumps of a whole turn, in any unit: the range of yaw suggests the size of a turn."""
    largest, turn = float(np.abs(array.value).max()), 360.0
    if largest <= 1.001 * math.pi / DEGREES:
        turn = 2.0 * math.pi / DEGREES
    elif largest <= 1.001 * 2.0 * math.pi:
        turn = 2.0 * math.pi
    return replace(array, value=np.unwrap(array.value, axis=0, period=turn))
