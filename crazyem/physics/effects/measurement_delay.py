"""measurement_delay: a stream of measurements shows the past."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.effect import Effect, Offset, Parameter, Situation
from crazyem.physics.effects.fused_attitude import attitude_error
from crazyem.physics.effects.prior import Prior
from crazyem.physics.effects.stretches import stretches
from crazyem.physics.rotations import rotation_between

SHOWN = {  # which of position, velocity, attitude, rate, specific force a stream shows
    "state": ("position", "velocity", "attitude"),
    "pose": ("position", "attitude"),
    "gyro": ("body_rate",),
    "accelerometer": ("specific_force",),
}


def late(situation: Situation, *, delay: float, streams: str | Sequence[str]) -> Offset:
    """What was `delay` [s] ago, less what is now, for the streams "state", "pose", "gyro", "accelerometer".

    Interpolates between rows, which are one path broken where a step is 0 or longer than 0.1 s. Before the first row of
    a stretch the drone moved and turned as in that row. An attitude that was made on board of a late gyro is off where
    the drone turns fast (`fused_attitude.py`). Of a filter's rates differences over some ms are half the noise
    of the gyro, that of the very sample which is to be explained; `Situation.turned` has none.
    """
    offset = Offset(np.zeros((situation.size, 12)), np.zeros((situation.size, 3)))
    if delay == 0.0 or not situation.size:
        return offset
    names = [streams] if isinstance(streams, str) else streams
    shown = {quantity for name in names for quantity in SHOWN[name]}
    row, part, before = _looked_up(situation, delay)
    path = situation.integrated or situation
    if "position" in shown:
        offset.state[:, 0:3] = _past(path.position, row, part) - path.position
        offset.state[:, 0:3] -= before * situation.velocity.take(row, axis=0)
    if "velocity" in shown:
        offset.state[:, 3:6] = _past(path.velocity, row, part) - path.velocity
    if "attitude" in shown:
        offset.state[:, 6:9] = _past_attitude(path.rotation, row, part)
        offset.state[:, 6:9] -= before * situation.body_rate.take(row, axis=0)
    if "body_rate" in shown:
        offset.state[:, 9:12] = _past(path.body_rate, row, part) - path.body_rate
        offset.state[:, 6:9] += attitude_error(situation, offset.state[:, 9:12], delay=delay)
    if "specific_force" in shown:
        offset.specific_force[:] = _past(situation.specific_force, row, part) - situation.specific_force
    return offset


def _looked_up(situation: Situation, delay: float) -> tuple[NDArray, NDArray, NDArray]:
    """For each moment: the last row before t - delay, the part of the way to the next, and s before the first row."""
    gap, broken = stretches(situation)
    clock = np.cumsum(np.where(broken, 1.0, gap))  # stretches further apart than any delay
    first = np.maximum.accumulate(np.where(broken, np.arange(situation.size), 0))
    wanted = clock - delay
    row = np.maximum(np.searchsorted(clock, wanted, "right") - 1, first)
    before = np.maximum(clock[first] - wanted, 0.0)
    following = np.minimum(row + 1, situation.size - 1)
    length = clock[following] - clock[row]
    part = np.where((length > 0) & (before == 0.0), (wanted - clock[row]) / np.where(length > 0, length, 1.0), 0.0)
    return row, np.clip(part, 0.0, 1.0)[:, None], before[:, None]


def _past(values: NDArray, row: NDArray, part: NDArray) -> NDArray:
    shown = values.take(row, axis=0)
    return shown + part * (values.take(np.minimum(row + 1, len(values) - 1), axis=0) - shown)


def _past_attitude(rotation: NDArray, row: NDArray, part: NDArray) -> NDArray:
    """(n, 3) rad: rotation from the attitude now to the one shown, body axes; between rows along the chord."""
    shown = _past(rotation.reshape(-1, 9), row, part).reshape(-1, 3, 3)
    return rotation_between(rotation, shown)


MEASUREMENT_DELAY = Effect(
    "measurement_delay",
    (
        Parameter("delay", "s", 0.0, 0.0, 0.1, 1e-3),
        Parameter(
            "streams",
            "",
            ("state",),
            0,
            0,
            0,
            chosen=(("state",), ("gyro",), ("accelerometer",)),
            among=tuple(SHOWN),
            phrase="of the {}",
            spoken={"state": "state estimate"},
        ),
    ),
    order=84,
    measured=late,
    prior=Prior(own={"delay": 0.012}),  # usual: see `onboard_filter`
    needs=("position", "velocity", "attitude", "body_rate", "specific_force"),
    belongs_to="recording",
    separates="log the gyro and the pose at 100 Hz or more, and turn and stop sharply several times",
)
