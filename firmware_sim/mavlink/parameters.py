"""The parameters of the simulated PX4. MPC_THR_HOVER acts on the thrust feed-forward; streams read some others.

PX4 multiplies the desired acceleration, in units of gravity, by MPC_THR_HOVER and sends the product to the mixer. Here
the Lee controller multiplies by its mass parameter instead: mass = hover thrust times the largest total thrust of the
four rotors over gravity. Integers are sent as bits, as in PX4.
"""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

REAL32, INT32 = 9, 6  # MAV_PARAM_TYPE
GRAVITY = 9.81
HOVER = "MPC_THR_HOVER"
LEAST, MOST = 0.1, 0.8  # of MPC_THR_HOVER, as PX4 has them


@dataclass(slots=True)
class Parameter:
    """A value and its type on the wire; `least`, `most`: its limits."""

    name: str
    kind: int
    value: float
    least: float = -1e9
    most: float = 1e9

    def wire(self) -> float:
        """The float in a PARAM_VALUE."""
        if self.kind == REAL32:
            return float(struct.unpack("<f", struct.pack("<f", self.value))[0])
        return float(struct.unpack("<f", struct.pack("<i", int(self.value)))[0])

    def take(self, wire: float, kind: int) -> bool:
        """Set the value from a PARAM_SET, within the limits; False: wrong type, or not a number."""
        if kind != self.kind:
            return False
        value = wire if kind == REAL32 else float(struct.unpack("<i", struct.pack("<f", wire))[0])
        if math.isnan(value):
            return False
        self.value = min(max(value, self.least), self.most)
        return True


class Parameters:
    """The table, in alphabetical order, as PX4 sends it.

    Args:
        mass: kg, of the firmware's controller. thrust: N, largest total thrust of the four rotors by its constants.
        believe: called with the mass [kg] of a new hover thrust.
    """

    def __init__(self, *, mass: float, thrust: float, believe: Callable[[float], None]) -> None:
        self._thrust, self._believe = thrust, believe
        hover = min(max(mass * GRAVITY / thrust, LEAST), MOST)
        table = [
            Parameter(HOVER, REAL32, hover, LEAST, MOST),
            Parameter("MPC_USE_HTE", INT32, 0),
            Parameter("MIS_TAKEOFF_ALT", REAL32, 1.0, 0.1, 10.0),
            Parameter("MAV_SYS_ID", INT32, 1, 1, 250),
            Parameter("COM_OF_LOSS_T", REAL32, 1.0, 0.1, 60.0),
            Parameter("CA_ROTOR_COUNT", INT32, 4, 4, 4),
        ]
        for n, (x, y) in enumerate(((1, 1), (-1, -1), (1, -1), (-1, 1))):  # front right, back left, front left, ...
            table += [
                Parameter(f"CA_ROTOR{n}_PX", REAL32, 0.0325 * x),
                Parameter(f"CA_ROTOR{n}_PY", REAL32, 0.0325 * y),
            ]
        for n in range(1, 5):
            table.append(Parameter(f"PWM_MAIN_FUNC{n}", INT32, 100 + n))
            table.append(Parameter(f"PWM_MAIN_MIN{n}", INT32, 1000, 800, 1400))
            table.append(Parameter(f"PWM_MAIN_MAX{n}", INT32, 2000, 1600, 2200))
        self.items = sorted(table, key=lambda p: p.name)
        self.by_name = {p.name: p for p in self.items}

    def set(self, name: str, wire: float, kind: int) -> Parameter | None:
        """Set a parameter and return it; None if the name is unknown."""
        parameter = self.by_name.get(name)
        if parameter is not None and parameter.take(wire, kind) and name == HOVER:
            value = parameter.wire()  # the value in effect is the one that was echoed
            parameter.value = value
            self._believe(value * self._thrust / GRAVITY)
        return parameter
