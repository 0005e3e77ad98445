"""Check: velocity against the derivative of position, and positions of two origins: unit, frame, sign, scale."""

from crazyem.doctor import hypotheses
from crazyem.doctor.kinematics import Track, difference, grid_of, measurements, poses, track, width_for
from crazyem.physics.rotations import rotate
from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.recording import Recording, SignalArray

LEAST_VELOCITY_RMS = 0.04  # m/s rms along an axis; slower motion is not judged
LEAST_POSITION_RMS = 0.1  # m rms along an axis, the same for positions
VELOCITY_WINDOW = 0.2  # s
LEAST_EXPLAINED_SHARE = 0.6
SCALE_FAULT = 0.05
# unit of the velocity or of the position -> slope of the velocity against the derivative of the position
VELOCITY_UNITS = {"mm/s": 1e3, "cm/s": 1e2}
POSITION_UNITS = {"mm": 1e-3, "cm": 1e-2}
_MISREAD = {"body": ("it is in the body frame, not the world frame", "Rotate it into the world frame by the attitude.")}


def check(recording: Recording) -> list[Finding]:
    """Findings about every velocity (against every position), and about every position but the first."""
    positions = measurements(recording, "position")
    attitudes = list(poses(recording).values())[:1]
    found: list[Finding] = []
    blamed: set[str] = set()
    for name, array in measurements(recording, "velocity").items():
        looks = [_compare(array, *position, attitudes) for position in positions.items()]
        found += _judge(name, [one for one in looks if one is not None], blamed)
    first = next(iter(positions), "")
    for name, array in positions.items():
        if name not in (first, *blamed) and first not in blamed:
            # positions, not their derivatives: late packets distort the scale of a derivative
            grid = grid_of(array, positions[first])
            candidates = {"world": (0, track(positions[first], grid))}
            width = max(VELOCITY_WINDOW, width_for(array, positions[first]))
            seen = hypotheses.compare_hypotheses(array, grid, first, candidates, width=width, least=LEAST_POSITION_RMS)
            if seen is not None:
                found += _judge(name, [seen], blamed, derived=False)
    return found


def _compare(
    array: SignalArray, other: str, reference: SignalArray, attitudes: list[SignalArray]
) -> hypotheses.Comparison | None:
    grid = grid_of(array, reference, *attitudes)
    world = difference(track(reference, grid))
    candidates: dict[str, tuple[int, Track]] = {"world": (0, world)}
    for turning in attitudes:
        attitude = track(turning, grid)
        turned = rotate(attitude.value, world.value, inverse=True)
        candidates["body"] = (1, Track(turned, world.valid & attitude.valid))
    width = max(VELOCITY_WINDOW, width_for(array, reference))
    return hypotheses.compare_hypotheses(
        array, grid, other, candidates, width=width, least=LEAST_VELOCITY_RMS, offset=False
    )


def _judge(name: str, looks: list[hypotheses.Comparison], blamed: set[str], *, derived: bool = True) -> list[Finding]:
    """Findings about a velocity against derivatives of positions, or about a position (not `derived`) against another.

    Positions in a wrong unit are added to `blamed`.
    """
    best = max(looks, key=lambda one: one.explained, default=None)
    if best is None or best.whole is None or best.explained < LEAST_EXPLAINED_SHARE:
        return []
    what, other, slope = "the derivative of " if derived else "", best.against, best.whole.value
    if best.choice.denied:
        return [hypotheses.misread("velocities", name, best, _MISREAD, noun="world", what=what)]
    inverse = {key: 1.0 / factor for key, factor in POSITION_UNITS.items()}
    unit = hypotheses.known_factor(best.whole, VELOCITY_UNITS if derived else inverse)
    if unit:
        text = f"{name} against {what}{other}: it is {slope:.4g} times as large: it is in {unit[0]}, not m"
        text += "/s." if derived else "."
        return [hypotheses.wrong_unit("velocities", name, text, unit[1], best.evidence())]
    unit = hypotheses.known_factor(best.whole, POSITION_UNITS)
    if unit:
        if other in blamed:
            return []
        blamed.add(other)
        text = f"{other} against {name}: it is {1.0 / slope:.4g} times as large: it is in {unit[0]}, not m."
        if derived:
            text = f"The derivative of {other} is {1.0 / slope:.4g} times {name}: it is in {unit[0]}, not m."
        return [hypotheses.wrong_unit("velocities", other, text, 1.0 / unit[1], best.evidence())]
    if derived:
        return hypotheses.wrong_scale(
            "velocities", name, looks, SCALE_FAULT,
            alone="One of the two is wrong, and a third measurement must say which.",
            agreed="Positions of two origins agree against it: divide the velocity by the factor.",
        )  # fmt: skip
    agreed = hypotheses.agreed_scale(looks, SCALE_FAULT)
    if agreed is None:
        return []
    numbers = {**best.evidence(), **hypotheses.slope_numbers(best.single)}
    text = f"{name} and {other} differ in scale: {agreed[1].text}, if {other} is right."
    advice = "Find out which of the two is calibrated."
    return [Finding("velocities", Grade.DEGRADES, text, name, (), numbers, advice)]
