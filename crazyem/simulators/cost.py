"""The cost of an omission: distance between two models after half a second of flight from the same states.

Without a recording the reference flight is synthetic: a hundred starts of brisk flight (up to 1.5 m/s, 15 degrees,
1 rad/s) with rotor commands around hover. With a recording, states and inputs come from the recording.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.flights.inputs import Inputs
from crazyem.diagnosis.prediction.horizon import UNITS, error_lengths, lengths, open_loop, windows
from crazyem.diagnosis.prediction.predict import recorded
from crazyem.diagnosis.prediction.simulate import Simulator
from crazyem.physics.motion import RotorInput
from crazyem.physics.rotations import quaternion_from_rotation_vector
from crazyem.recordings.recording import Recording
from crazyem.vehicle import GRAVITY, Vehicle

Array = NDArray[np.float64]
HORIZON = 0.5  # s
STARTS, SPACING, STEP = 100, 0.1, 0.01  # starts; s from one to the next; s between commands
SPEED, TILT, RATE = 1.5, math.radians(15.0), 1.0  # m/s, rad, rad/s: largest values of the synthetic flight
STIR = 0.04  # amplitude of the rotor commands around hover, relative to hover thrust
NOTHING = 1e-9  # smaller distances are rounding errors and shown as 0
_COLUMNS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 10), "body_rate": slice(10, 13)}


@dataclass(frozen=True, eq=False)
class Reference:
    """Starts and inputs. state (n, 13) as `predict.NAMES`; times (n, k) s."""

    inputs: Inputs
    state: Array
    times: Array


def reference_flight(vehicle: Vehicle) -> Reference:
    """The synthetic flight of a vehicle: thrust commands around hover."""
    count = round((STARTS * SPACING + 2.0 * HORIZON) / STEP)
    time = np.arange(count) * STEP
    # incommensurable frequencies [Hz], so that all starts differ
    waves = [np.sin(2.0 * np.pi * (f * time + k / 4.0)) for k, f in enumerate((0.83, 1.31, 1.97, 2.71))]
    stir = np.stack(waves, axis=1)
    thrust = vehicle.mass * GRAVITY / 4.0 * (1.0 + STIR * stir)
    rotor = RotorInput(time, np.ascontiguousarray(thrust), np.full(count, 3.85), time, measured=False, aged=False)
    begin = HORIZON + SPACING * np.arange(STARTS)
    phase = begin[:, None] * np.array([0.37, 0.53, 0.71])
    velocity = SPEED / math.sqrt(3.0) * np.sin(2.0 * np.pi * phase)
    turn = TILT * np.column_stack([np.sin(2.0 * np.pi * 0.61 * begin), np.cos(2.0 * np.pi * 0.43 * begin), 0.0 * begin])
    rate = RATE * np.sin(2.0 * np.pi * (phase[:, ::-1] + 0.2))
    attitude = quaternion_from_rotation_vector(turn)
    position = np.tile([0.0, 0.0, 2.0], (STARTS, 1))
    state = np.concatenate([position, velocity, attitude, rate], axis=1)
    inputs = Inputs(rotor, "motor_command", vehicle, (), 0.0, 0.0)
    return Reference(inputs, state, begin[:, None] + np.arange(0.0, HORIZON + STEP / 2, STEP))


def flown(reference: Reference, vehicle: Vehicle) -> Array:
    """(n, k, 13) predicted states of a vehicle from every start."""
    return Simulator(reference.inputs, vehicle=vehicle).run(reference.state, reference.times)


def rms_distance(first: Array, second: Array) -> dict[str, float]:
    """Root mean square distance of two predictions at their last moments, by quantity [m, m/s, rad, rad/s]."""
    found = {}
    for name, columns in _COLUMNS.items():
        length = lengths(first[:, -1, columns], second[:, -1, columns], attitude=name == "attitude")
        found[name] = float(np.sqrt(np.mean(np.square(length)))) if np.isfinite(length).all() else math.inf
    return found


def errors_after(recording: Recording, vehicles: Mapping[str, Vehicle]) -> dict[str, dict[str, float]]:
    """Open-loop errors after half a second along a recording, by vehicle and quantity.

    Raises: DataError if the recording has no whole states or no flight that is long enough.
    """
    found: dict[str, dict[str, float]] = {}
    at = None
    for name, vehicle in vehicles.items():
        shown = recorded(recording, vehicle)
        at = windows(shown, horizons=(HORIZON,)) if at is None else at
        length = error_lengths(open_loop(shown, at), at)
        found[name] = {q: float(np.sqrt(np.nanmean(np.square(v[:, -1])))) for q, v in length.items()}
    return found


def said(errors: Mapping[str, float]) -> str:
    """Distances for people."""
    return ", ".join(f"{errors[q] if abs(errors[q]) > NOTHING else 0.0:.2g} {unit}" for q, unit in UNITS.items())
