"""What tests of the diagnosis share: candidates, models, and recordings as data of the drone of `closed_loop.py`."""

from dataclasses import replace
from typing import Any

from closed_loop import DRONE

from crazyem.diagnosis.fitting.candidates import TRIM, Candidate
from crazyem.diagnosis.fitting.fit import Data, nominal
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle

DRAG, QUADRATIC_DRAG, WIND = (Candidate(n, (), ("x", "y", "z")) for n in ("linear_drag", "quadratic_drag", "wind"))
THRUST, TORQUE = (Candidate(name, (), ("scale",)) for name in ("thrust_scale", "torque_scale"))
LOAD = Candidate("payload", (), ("mass", "x", "y", "z"))
INERTIA = Candidate("inertia", (), ("xx", "yy", "zz"))
LAG = Candidate("motor_lag", (), ("time_constant",))
LATE = Candidate("input_delay", (), ("delay",))
ZERO_TRIM = replace(DRONE, effects={TRIM: dict.fromkeys("xyz", 0.0)})  # a file of one drone: its day is free


def rotor(number: int, onset: float | None = None) -> Candidate:
    """A rotor (1 to 4) that is weak from `onset` [s] on, or always."""
    return Candidate("rotor_fault", (("rotor", number), ("onset_time", onset)), ("scale",))


def start_point(vehicle: Vehicle = DRONE) -> Point:
    """The model that the file of a vehicle describes, with the noise that fits begin with."""
    return Point(vehicle, {n: dict(v) for n, v in vehicle.effects.items()}, start_noise())


def data_of(*recordings: Recording, vehicle: Vehicle = DRONE, **changes: Any) -> Data:
    """Recordings as data; `changes` replace fields of their flights."""
    return Data([replace(flight_of(r, vehicle), **changes) for r in recordings])


def nominal_of(*recordings: Recording, vehicle: Vehicle = DRONE, **changes: Any) -> tuple[Data, Point]:
    """Recordings as data, and the nominal model of them."""
    data = data_of(*recordings, vehicle=vehicle, **changes)
    return data, nominal(data, start_point(vehicle))


def silent(text: str) -> None:
    """Takes what a diagnosis says of its progress."""
