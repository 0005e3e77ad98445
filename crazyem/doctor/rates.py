"""Check: body rate against the derivative of the attitude: unit, frame, sign, scale, bias."""

import math

import numpy as np

from crazyem.doctor.hypotheses import Comparison, compare_hypotheses, known_factor, misread, wrong_scale, wrong_unit
from crazyem.doctor.kinematics import Track, grid_of, measurements, poses, rate_of_attitude, track, width_for
from crazyem.physics.rotations import rotate
from crazyem.recordings.finding import Finding, Fix, Grade
from crazyem.recordings.recording import Recording, SignalArray

DEGREES = 180.0 / math.pi
LEAST_RATE_RMS = 0.04  # rad/s rms about an axis; slower rotation is not judged
LEAST_EXPLAINED_SHARE = 0.6  # least share of the variance that a hypothesis explains
SCALE_FAULT = 0.05  # relative; smallest reported scale fault if attitudes of two origins agree
SCALE_FAULT_ONE_ORIGIN = 0.10  # the same with one origin: an onboard attitude follows the gyro through a filter
REPORTED_BIAS = 0.05  # rad/s, smallest reported bias
RATE_WINDOW = 0.24  # s, smoothing window: a gyro in flight is noisy
_UNITS = {
    "deg/s": "it is in deg/s, not rad/s",
    "converted": "it was in rad/s and was converted from deg/s once too often",
}
_MISREAD = {
    "world": ("it is in the world frame, not the body frame", "Rotate it into the body frame by the attitude."),
    "turned twice": (
        "it was turned from world to body although it was in the body frame already",
        "Read it as a body rate, not as one of the world.",
    ),
}


def check(recording: Recording) -> list[Finding]:
    """Findings about every measurement of the body rate, against every attitude."""
    found: list[Finding] = []
    attitudes = poses(recording)
    for name, array in measurements(recording, "body_rate").items():
        looks = [one for pose in attitudes.items() if (one := _compare(array, *pose)) is not None]
        if looks:
            found += _judge(name, looks)
    return found


def _compare(array: SignalArray, pose: str, turning: SignalArray) -> Comparison | None:
    grid = grid_of(array, turning)
    attitude = track(turning, grid)
    body = rate_of_attitude(attitude)
    world = rotate(attitude.value, body.value)
    candidates = {
        "body": (0, body),
        "world": (1, Track(world, body.valid)),
        "turned twice": (1, Track(rotate(attitude.value, body.value, inverse=True), body.valid)),
        "world, negated": (3, Track(-world, body.valid)),
    }
    width = max(RATE_WINDOW, width_for(array, turning))
    return compare_hypotheses(array, grid, pose, candidates, width=width, least=LEAST_RATE_RMS)


def _judge(name: str, looks: list[Comparison]) -> list[Finding]:
    best = max(looks, key=lambda one: one.explained)
    whole = best.whole
    if whole is None or best.explained < LEAST_EXPLAINED_SHARE:
        return []
    if best.choice.denied:
        return [misread("rates", name, best, _MISREAD, noun="body rate", fix=Fix("world_to_body", (name,)))]
    unit = known_factor(whole, {"deg/s": DEGREES, "converted": 1.0 / DEGREES})
    if unit:
        text = f"{name} is {whole.value:.4g} times the derivative of {best.against}: {_UNITS[unit[0]]}."
        advice = "Multiply it by the factor of the fix, or correct its unit where it is read."
        return [wrong_unit("rates", name, text, unit[1], best.evidence(), advice)]
    scale = wrong_scale(
        "rates", name, looks, SCALE_FAULT if len(looks) > 1 else SCALE_FAULT_ONE_ORIGIN,
        alone="One of the two is wrong; a third measurement, or the range of the gyro, must say which.",
        agreed="Attitudes of two origins agree against it: divide the rate by the factor.",
    )  # fmt: skip
    return [*scale, *_bias(name, best)]


def _bias(name: str, seen: Comparison) -> list[Finding]:
    # in a steady turn, an uncertain scale looks like a bias
    unknown = np.abs(seen.predicted) * (seen.whole.far_high - seen.whole.far_low if seen.whole else 1.0)
    if not (np.abs(seen.offset) > np.maximum(REPORTED_BIAS, 5.0 * seen.offset_error) + unknown).any():
        return []
    evidence = {f"bias_{axis}_rad_s": float(b) for axis, b in zip("xyz", seen.offset, strict=True)}
    worst = float(np.abs(seen.offset).max())
    text = f"{name} has a constant bias of up to {worst:.3f} rad/s against the derivative of {seen.against}."
    return [Finding("rates", Grade.HARMLESS, text, name, (), evidence, "Estimate it along, or take it off.")]
