"""Commands that are faster than their sampling: those of real drones that shake, and the error that they cause."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import TRIM
from crazyem.diagnosis.fitting.days import TRIM_SD
from crazyem.diagnosis.flights.flight import Flight
from crazyem.diagnosis.settings import FITTING, RECORDINGS
from crazyem.physics.effects.timing import LOOP
from crazyem.physics.rotors import wrench
from crazyem.vehicle import Vehicle


def unlogged_share(flights: Sequence[Flight], vehicle: Vehicle) -> float:
    """Relative error of torques (0 to 1) that commands between the logged ones may cause; 0 if negligible.

    White commands have half of their power above half of the Nyquist frequency. So the white part is twice the fast
    share. Only one in period / `LOOP` of these commands is logged. An error in the input biases a fit by its power
    times the weight of this power in the fit (Fuller, Measurement Error Models, 1987, 1.1), hence the square.
    """
    shares = [0.0]
    for flight in flights:
        if not flight.inputs.measured:
            missed = max(0.0, 1.0 - LOOP / interval(flight))
            shares.append(min(1.0, 4.0 * missed * fast_share(flight, vehicle) ** 2))
    return max(shares) if max(shares) > FITTING.min_sampled_torque else 0.0


def interval(flight: Flight) -> float:
    """Seconds between commands that the model uses: the longer interval of commands and of rows (`physics/lag.py`)."""
    return float(max(np.median(np.diff(flight.inputs.time)), np.median(np.diff(flight.time))))


def with_zero_trim(flights: Sequence[Flight], vehicle: Vehicle) -> Vehicle:
    """The vehicle with a trim of 0, if its file has no trim, its commands shake like those of a real drone, and they
    have a steady torque.

    Such commands show little but their mean. The trim lets this mean differ as it does from drone to drone and from
    day to day. Otherwise the mean looks like a weak rotor, a load or a wind.
    """
    shares = [fast_share(f, vehicle) for f in flights if not f.inputs.measured]
    if TRIM in vehicle.effects or not shares or float(np.median(shares)) <= FITTING.coarse_share:
        return vehicle
    if not any(np.any(np.abs(mean_torque(f, vehicle)) > TRIM_SD) for f in flights):
        return vehicle
    return replace(vehicle, effects={**vehicle.effects, TRIM: dict.fromkeys("xyz", 0.0)})


def mean_torque(flight: Flight, vehicle: Vehicle) -> NDArray:
    """(3,) mean torque of the commands in the air over their mean thrust [m], body axes; it balances the trim."""
    inside = (flight.inputs.time > flight.time[0]) & (flight.inputs.time < flight.time[-1])
    mean = wrench(flight.inputs.thrust[inside], arm=vehicle.arm, torque_per_thrust=vehicle.torque_per_thrust).mean(0)
    return mean[1:] / mean[0] if mean[0] > 0 else np.zeros(3)


def fast_share(flight: Flight, vehicle: Vehicle) -> float:
    """The larger share of power above half of the Nyquist frequency, of the commanded roll and pitch torques."""
    return _fast_share(flight, vehicle.arm, vehicle.torque_per_thrust)


@lru_cache(maxsize=64)
def _fast_share(flight: Flight, arm: tuple[float, float], torque_per_thrust: float) -> float:
    time = flight.inputs.time
    inside = (time > flight.time[0] + RECORDINGS.edge) & (time < flight.time[-1] - RECORDINGS.edge)
    if inside.sum() < 100:
        return 0.0
    period = interval(flight)
    torque = wrench(flight.inputs.thrust[inside], arm=arm, torque_per_thrust=torque_per_thrust)[:, 1:3]
    grid = np.arange(time[inside][0], time[inside][-1], period)
    even = np.stack([np.interp(grid, time[inside], c) for c in torque.T])
    window = np.hanning(grid.size)
    power = np.abs(np.fft.rfft((even - even.mean(axis=1, keepdims=True)) * window)) ** 2
    frequency = np.fft.rfftfreq(grid.size, period)
    fast, all_of_it = (
        power[:, frequency > 0.25 / period].sum(1),
        power[:, frequency > FITTING.min_torque_frequency].sum(1),
    )
    return float(np.divide(fast, all_of_it, out=np.zeros(2), where=all_of_it > 0).max())
