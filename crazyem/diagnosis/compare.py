"""Comparison of a recording with a simulated one of the same mission, signal by signal."""

from typing import Any

import numpy as np

from crazyem.errors import DataError
from crazyem.recordings.airborne import airtime
from crazyem.recordings.ordering import ordered
from crazyem.recordings.recording import Recording
from crazyem.signals.sample import SIGNALS

COMPARED = ("position", "velocity", "attitude", "body_rate", "motor_command", "rotor_speed", "voltage")


def compare(recording: Recording, simulated: Recording) -> dict[str, Any]:
    """Differences of the signals that both recordings have, aligned at take-off.

    Raises:
        DataError: one of them holds no flight.
    """
    begins, lasts = [], []
    for one in (recording, simulated):
        air = airtime(one)
        if not air.flown:
            raise DataError(f"{one.path}: nothing was flown in this recording, so there is nothing to compare")
        begins.append(air.flown[0][0])
        lasts.append(air.flown[-1][1] - air.flown[0][0])
    seconds = min(lasts)
    found: dict[str, Any] = {"simulated": simulated.path, "seconds": seconds, "signals": {}}
    for name in COMPARED:
        if name not in recording.signals or name not in simulated.signals:
            continue
        (t, value), (t_sim, value_sim) = ordered(recording.signals[name]), ordered(simulated.signals[name])
        t, t_sim = t - begins[0], t_sim - begins[1]
        rows = (t >= 0) & (t <= seconds)
        if not rows.any() or t_sim.size < 2:
            continue
        theirs = np.stack([np.interp(t[rows], t_sim, column) for column in value_sim.T], 1)
        mine = value[rows]
        if name == "attitude":
            dot = np.abs(np.sum(mine * theirs, axis=1)) / np.linalg.norm(theirs, axis=1)
            size, unit = 2 * np.arccos(np.clip(dot, 0.0, 1.0)), "rad"
        else:
            size, unit = np.linalg.norm(mine - theirs, axis=1), SIGNALS[name][1]
        found["signals"][name] = {
            "rms": float(np.sqrt(np.mean(size**2))), "largest": float(size.max()),
            "when": float(t[rows][int(np.argmax(size))]), "unit": unit,
        }  # fmt: skip
    return found
