"""The attitudes of a recording as the other checks use them: quaternions first, else from Euler angles."""

from dataclasses import dataclass, replace

import numpy as np

from crazyem.doctor.kinematics import Grid, Track, measurements, quaternion_of_euler, track
from crazyem.recordings.recording import Recording, SignalArray


@dataclass(frozen=True, eq=False)
class Pose:
    """An attitude under its signal's name. `array` holds quaternions x y z w, body to world."""

    name: str
    array: SignalArray

    def track(self, grid: Grid, *, shift: float = 0.0) -> Track:
        """(m, 4) unit quaternions on a grid; `shift` as in `kinematics.track`."""
        return track(self.array, grid, shift=shift)


def poses(recording: Recording) -> list[Pose]:
    """Every attitude that is a rotation; Euler angles only where there is no quaternion at all."""
    found = [Pose(name, array) for name, array in measurements(recording, "attitude").items()]
    if found:
        return found
    angles = measurements(recording, "euler")
    return [
        Pose(name, replace(array, value=quaternion_of_euler(array.value), quantity="attitude"))
        for name, array in angles.items()
        if np.nanmax(np.abs(array.value)) <= 7.0
    ]
