"""Flights without packets: parameters written as a client would, places held, log variables read by name."""

import numpy as np

from firmware_sim.commander import setpoint as sp
from firmware_sim.flight import Flight
from firmware_sim.scenario import parse_scenario


def boot(table: dict | None = None, seed: int = 0, **parameters: float) -> Flight:
    """An armed flight; names of parameters have __ for the dot."""
    flight = Flight(parse_scenario(table or {}, "test"), seed)
    flight.armed = True
    for name, value in parameters.items():
        write(flight, name.replace("__", "."), value)
    return flight


def write(flight: Flight, name: str, value: float) -> None:
    array, index = flight.param[name]
    array[index] = value
    flight.parameter_written(name)


def read(flight: Flight, name: str) -> float:
    array, index = flight.log[name]
    return float(array[index])


def hold(flight: Flight, position: tuple[float, float, float], seconds: float, ramp: float = 2.0) -> np.ndarray:
    """Go to a position (m, rising over `ramp` s) and stay; returns the true state every 10 ms."""
    s = flight.setpoint
    s[sp.MODE_X : sp.MODE_Z + 1] = s[sp.MODE_YAW] = sp.ABSOLUTE
    start = s[sp.Z]
    states = []
    for n in range(round(1000 * seconds)):
        s[sp.X], s[sp.Y] = position[:2]
        s[sp.Z] = start + (position[2] - start) * min(1.0, n / (1000 * ramp))
        flight.step()
        if n % 10 == 0:
            states.append(flight.state.copy())
    return np.array(states)
