"""Where a vehicle goes by its model: open-loop predictions from every recorded state, by the recorded inputs."""

import math
from collections.abc import Callable

from crazyem.api.inputs import RecordingLike, VehicleLike, recording_of, vehicle_of
from crazyem.diagnosis.prediction import predict as prediction
from crazyem.diagnosis.prediction.predict import Prediction, recorded
from crazyem.errors import UsageError
from crazyem.recordings.contents import ReadOptions

LARGEST_PREDICTION = 4e9  # bytes of the arrays


def predict(
    recording: RecordingLike,
    vehicle: VehicleLike | None = None,
    *,
    horizon: int,
    step: float | None = None,
    every: int = 1,
    plain: bool = False,
    options: ReadOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Prediction:
    """Predict `horizon` steps from every `every`-th recorded state, without any measurement after the start.

    Args:
        recording: a recording, or the path of one of any known format.
        vehicle: the model with its effects: a Vehicle, a preset's name or a file; None: the one that was flown.
        horizon: N, steps from each start.
        step: s between predicted states; None: the recorded samples.
        every: samples from one start to the next.
        plain: the model alone, however wrong its turning was before a start.
        options: how a path is read.
        progress: told how many starts of how many are done.

    Raises:
        UsageError: no such file or vehicle, or more predictions than fit into memory. FileFormatError: no recording.
        DataError: a part of the state is missing, or no start has its whole horizon in the recording.
    """
    if horizon < 1 or every < 1:
        raise UsageError(f"horizon ({horizon}) and every ({every}) must be 1 or more.")
    recording = recording_of(recording, options)
    shown = recorded(recording, vehicle_of(vehicle, recording))
    size = 14 * 8 * horizon * (shown.time.size / every)
    if size > LARGEST_PREDICTION:
        raise UsageError(
            f"{shown.time.size} samples with {horizon} steps each are {size / 1e9:.0f} GB of predictions; "
            f"use --every {math.ceil(every * size / LARGEST_PREDICTION)} or more."
        )
    return prediction.predict(shown, horizon=horizon, step=step, every=every, plain=plain, progress=progress)
