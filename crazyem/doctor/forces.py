"""Check: specific force and acceleration against attitude and motion: unit, gravity, sign, frame, scale, bias."""

import math
from collections.abc import Mapping

import numpy as np

from crazyem.doctor import hypotheses
from crazyem.doctor.kinematics import (
    GRAVITY,
    GRID_STEP,
    UP,
    Grid,
    Track,
    Window,
    difference,
    grid_of,
    measurements,
    poses,
    track,
    width_for,
)
from crazyem.physics.rotations import rotate
from crazyem.recordings.finding import Finding, Fix, Grade
from crazyem.recordings.recording import Recording, SignalArray

FORCE_WINDOW = 0.3  # s, smoothing window: an accelerometer in flight is noisy
LEAST_FORCE_RMS = 0.25  # m/s^2 rms along an axis; with less motion, frames and signs are not judged
LEAST_EXPLAINED_SHARE = 0.5  # share of the variance about the mean that a hypothesis must explain
SCALE_FAULT = 0.05
VELOCITY_TOLERANCE = 0.04  # relative; largest error of the scale of a velocity that counts as the derivative
HOVER_SPEED_RMS = 0.03  # m/s rms
_WITHOUT_GRAVITY = "it is the acceleration in the {} frame without gravity, not the specific force"
_AS_ACCELERATION = "Read it as acceleration; add gravity to get the specific force."
_FORCE_MISREAD = {
    "world": ("it is in the world frame, not the body frame", "Rotate it into the body frame by the attitude."),
    "body, gravity removed": (_WITHOUT_GRAVITY.format("body"), _AS_ACCELERATION),
    "world, gravity removed": (_WITHOUT_GRAVITY.format("world"), _AS_ACCELERATION),
    "turned twice": (
        "it was turned from world to body although it was in the body frame already",
        "Read it as a specific force, not as one of the world.",
    ),
}
_ACCELERATION_MISREAD = {
    "specific force": (
        "it is the specific force in the body frame, not the acceleration in the world frame",
        "Correct it where it is read.",
    ),
    "body, gravity removed": ("it is in the body frame, not the world frame", "Correct it where it is read."),
}
FORCE_UNITS = {"g": 1.0 / GRAVITY, "mg": 1e3 / GRAVITY, "cm/s^2": 1e2, "mm/s^2": 1e3, "g taken twice": GRAVITY}


def check(recording: Recording) -> list[Finding]:
    """Findings about every specific force and every acceleration."""
    found: list[Finding] = []
    attitudes = poses(recording)
    moving = _moving(recording)
    for name, array in measurements(recording, "specific_force").items():
        found += _specific_force(name, array, moving, attitudes)
    for name, array in measurements(recording, "acceleration").items():
        if moving is not None:
            found += _acceleration(name, array, moving, list(attitudes.values())[:1])
    return found


def _moving(recording: Recording) -> SignalArray | None:
    """The signal that gives the acceleration.

    A single velocity without a position, or the first velocity that is the derivative of a position; else the first
    position, else the first velocity.
    """
    velocities = measurements(recording, "velocity")
    positions = measurements(recording, "position")
    if len(velocities) == 1 and not positions:
        return next(iter(velocities.values()))
    for velocity in velocities.values():
        if any(_derived(velocity, position) for position in positions.values()):
            return velocity
    return next(iter([*positions.values(), *velocities.values()]), None)


def _derived(velocity: SignalArray, position: SignalArray) -> bool:
    """True if the slope of a velocity against the derivative of a position is 1 within `VELOCITY_TOLERANCE`."""
    grid = grid_of(velocity, position)
    window = Window(max(FORCE_WINDOW, width_for(velocity, position)))
    x, y = window.mean(difference(track(position, grid))), window.mean(track(velocity, grid))
    rows = np.flatnonzero(x.valid & y.valid)[::3]
    if rows.size < 100:
        return False
    a, b = x.value[rows], y.value[rows]
    xx, xy, yy = (float((p * q).sum()) for p, q in ((a, a), (a, b), (b, b)))
    hovers = xx / a.size < HOVER_SPEED_RMS**2 and yy / b.size < HOVER_SPEED_RMS**2
    return hovers or (
        xy > 0.0 and abs(math.sqrt(yy / max(xx, 1e-12)) - 1.0) < VELOCITY_TOLERANCE and xy**2 > 0.8 * xx * yy
    )


def _acceleration_of(moving: SignalArray, grid: Grid) -> Track:
    """Acceleration (m, 3) in the world, gravity removed."""
    first = difference(track(moving, grid))
    return first if moving.quantity == "velocity" else difference(first)


def _specific_force(
    name: str, array: SignalArray, moving: SignalArray | None, attitudes: Mapping[str, SignalArray]
) -> list[Finding]:
    looks = [] if moving is None else [_compare(array, *pose, moving) for pose in attitudes.items()]
    seen = max((one for one in looks if one is not None), key=lambda one: one.explained, default=None)
    if seen is None or seen.explained < LEAST_EXPLAINED_SHARE:
        return _by_weight(name, array, list(attitudes.values())[:1])
    return [_structure(name, seen)] if seen.choice.denied else _judge_level(name, *_level(seen), seen)


def _compare(array: SignalArray, pose: str, turning: SignalArray, moving: SignalArray) -> hypotheses.Comparison | None:
    grid = grid_of(array, turning, moving)
    acceleration = _acceleration_of(moving, grid)
    attitude = track(turning, grid)
    valid = acceleration.valid & attitude.valid
    kinematic = acceleration.value
    force = kinematic + GRAVITY * UP
    turned = rotate(attitude.value, force, inverse=True)
    candidates = {
        "body": (0, Track(turned, valid)),
        "world": (1, Track(force, valid)),
        "body, gravity removed": (1, Track(rotate(attitude.value, kinematic, inverse=True), valid)),
        "turned twice": (2, Track(rotate(attitude.value, turned, inverse=True), valid)),
        "world, gravity removed": (2, Track(kinematic, valid)),
    }
    width = max(FORCE_WINDOW, width_for(array, turning, moving))
    return hypotheses.compare_hypotheses(
        array, grid, f"{pose} and motion", candidates, width=width, least=LEAST_FORCE_RMS
    )


def _level(seen: hypotheses.Comparison) -> tuple[float, float]:
    """Mean of the measurement along the predicted mean, divided by the size of that mean; and its standard error."""
    size = float(np.linalg.norm(seen.predicted))
    return float(seen.mean @ seen.predicted) / size**2, float(np.linalg.norm(seen.mean_error)) / size


def _by_weight(name: str, array: SignalArray, attitudes: list[SignalArray]) -> list[Finding]:
    """Findings without motion to compare: over a flight that begins and ends at rest the mean force is the weight."""
    for turning in attitudes:
        grid = grid_of(array, turning)
        attitude, force = track(turning, grid), track(array, grid)
        turned = Track(rotate(attitude.value, force.value), attitude.valid & force.valid)
        world = Window(FORCE_WINDOW).mean(turned)
        if world.valid.sum() * GRID_STEP >= 5.0:
            value = world.value[world.valid]
            return _judge_level(name, float(value[:, 2].mean()) / GRAVITY, 0.05, None)
    good = np.isfinite(array.value).all(axis=1)
    norm = np.linalg.norm(array.value[good], axis=1)
    return _judge_level(name, float(np.median(norm)) / GRAVITY, 0.2, None, signed=False)


def _judge_level(
    name: str, level: float, error: float, seen: hypotheses.Comparison | None, *, signed: bool = True
) -> list[Finding]:
    """Findings about unit, gravity, sign and scale of a specific force, from its mean over the weight (`level`)."""
    evidence = {"gravity_level": level, "gravity_level_error": error, **(seen.evidence() if seen else {})}
    head = f"The mean of {name} is {level:.4g} times the weight it must carry: "
    advice = "Correct its unit where it is read."
    for unit, factor in FORCE_UNITS.items():
        if abs(math.log(max(abs(level), 1e-9) / factor)) < math.log(1.3) and (level > 0 or not signed):
            text = f"{head}{_unit_said(unit)}, not m/s^2."
            return [hypotheses.wrong_unit("forces", name, text, factor, evidence, advice)]
    if seen is None and not signed:
        return []
    if abs(level) < 0.3:
        told = seen is not None and seen.whole is not None
        text = f"{head}gravity was removed from it."
        if told or abs(level) < 0.03:
            return [Finding("forces", Grade.UNUSABLE, text, name, (), evidence, "Add gravity again, or read it so.")]
        return []
    if level < -0.7:
        return [hypotheses.wrong_unit("forces", name, f"{head}its sign is inverted.", -1.0, evidence, advice)]
    if seen is not None and abs(level - 1.0) >= SCALE_FAULT and abs(level - 1.0) > 4.0 * error:
        return [_scale(name, level, error, seen, evidence)]
    return []


def _unit_said(unit: str) -> str:
    return "it was converted from g once too often" if unit == "g taken twice" else f"it is in {unit}"


def _scale(
    name: str, level: float, error: float, seen: hypotheses.Comparison, evidence: Mapping[str, float]
) -> Finding:
    """Finding about a level wrong by some per cent: a scale fault or a vertical bias, by the changes of the force."""
    whole = seen.whole
    interval = f"{level:.3f} ({level - 2 * error:.3f} to {level + 2 * error:.3f})"
    text = f"The mean of {name} is {interval} times the weight it must carry"
    bias = (level - 1.0) * float(np.linalg.norm(seen.predicted))
    advice = "Calibrate it at rest, or divide it by the factor."
    fix: Fix | None = None
    numbers = {**evidence, "bias_m_s2": bias, "scale": level, "scale_low": level - 2 * error}
    numbers["scale_high"] = level + 2 * error
    is_scale = whole is not None and whole.far_low <= level <= whole.far_high
    is_bias = whole is not None and whole.far_low <= 1.0 <= whole.far_high
    if is_scale and not is_bias:
        text += ", and its changes are as much too large: a scale fault."
        fix = Fix("scale", (name,), (1.0 / level,) * 3)
    elif is_bias and not is_scale:
        text += f", but its changes have the right size: a bias of {bias:.2f} m/s^2 along the vertical."
    else:
        text += f": a scale fault, or a bias of {bias:.2f} m/s^2; which of them cannot be told from this flight."
    return Finding("forces", Grade.DEGRADES, text, name, (), numbers, advice, fix)


def _structure(name: str, seen: hypotheses.Comparison) -> Finding:
    known = _FORCE_MISREAD
    fix: Fix | None = Fix("world_to_body", (name,))
    if abs(_level(seen)[0]) < 0.3 * abs(seen.whole.value if seen.whole else 1.0):  # a force has gravity in its mean
        known = known | {"world": (_WITHOUT_GRAVITY.format("world"), "Read it as acceleration.")}
        fix = None
    return hypotheses.misread("forces", name, seen, known, noun="specific force", what="", fix=fix)


def _acceleration(name: str, array: SignalArray, moving: SignalArray, attitudes: list[SignalArray]) -> list[Finding]:
    grid = grid_of(array, moving, *attitudes)
    kinematic = _acceleration_of(moving, grid)
    candidates: dict[str, tuple[int, Track]] = {"world": (0, kinematic)}
    for turning in attitudes:
        attitude = track(turning, grid)
        valid = kinematic.valid & attitude.valid
        candidates["body, gravity removed"] = (1, Track(rotate(attitude.value, kinematic.value, inverse=True), valid))
        force = kinematic.value + GRAVITY * UP
        candidates["specific force"] = (1, Track(rotate(attitude.value, force, inverse=True), valid))
    width = max(FORCE_WINDOW, width_for(array, moving))
    seen = hypotheses.compare_hypotheses(
        array, grid, f"the derivative of the {moving.quantity}", candidates, width=width, least=LEAST_FORCE_RMS
    )
    if seen is None or seen.whole is None or seen.explained < LEAST_EXPLAINED_SHARE:
        return []
    evidence = seen.evidence()
    head = f"{name} against {seen.against}: "
    if seen.choice.denied:
        return [hypotheses.misread("forces", name, seen, _ACCELERATION_MISREAD, noun="world's", what="")]
    unit = hypotheses.known_factor(seen.whole, FORCE_UNITS)
    if unit:
        text = f"{head}it is {seen.whole.value:.4g} times as large: {_unit_said(unit[0])}, not m/s^2."
        return [hypotheses.wrong_unit("forces", name, text, unit[1], evidence, "Correct its unit where it is read.")]
    level = float(seen.mean[2] - seen.whole.value * seen.predicted[2]) / (GRAVITY * seen.whole.value)
    if abs(level - 1.0) < 0.3:
        text = f"{head}gravity is still in it (its mean is {seen.mean[2]:.2f} m/s^2 along z)."
        numbers = {**evidence, "gravity_level": level}
        return [Finding("forces", Grade.UNUSABLE, text, name, (), numbers, "Take gravity off its z.")]
    fault = hypotheses.scale_fault(seen.whole, seen.single, SCALE_FAULT) if seen.covered >= 0.5 else None
    if fault is None:
        return []
    text = f"{head}{fault.text}."
    numbers = {**evidence, **hypotheses.slope_numbers(seen.single)}
    advice = (
        "Use the derivative of the velocity; a tilt that its filter takes for larger than it is makes such a factor."
    )
    return [Finding("forces", Grade.DEGRADES, text, name, (), numbers, advice)]
