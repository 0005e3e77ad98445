"""What a controller or the onboard filter believes about the drone, and how its parameters hold that."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from crazyem.control.command_units import effectiveness_torque, lag_of, lag_share, mass_thrust, rotor_reaction_factor
from crazyem.physics.effects.rotors import ROTOR_INERTIA
from crazyem.vehicle import GRAVITY, Vehicle

Form = Literal["proportional", "reciprocal", "lag"]
NOMINAL_VOLTS = 3.7  # V; nothing here depends on it where the firmware compensates the voltage
INERTIA_NAMES = ("Ixx", "Iyy", "Izz")
DRAG_NAMES = ("drag_x", "drag_y")


@dataclass(frozen=True)
class Slot:
    """A firmware parameter and the estimate that it holds.

    Attributes:
        parameter: its name. form, scale: the parameter is estimate / scale (proportional), scale / estimate
            (reciprocal), or the share of a time constant's way in one period of INDI's loop (lag).
    """

    parameter: str
    form: Form = "proportional"
    scale: float = 1.0

    def value(self, estimate: float) -> float:
        """The parameter's value that holds an estimate [SI]."""
        if self.form == "lag":
            return lag_share(estimate)
        if self.form == "reciprocal":
            return self.scale / estimate if estimate else math.inf
        return estimate / self.scale

    def estimate(self, value: float) -> float:
        """The estimate [SI] that a parameter's value holds."""
        if self.form == "lag":
            return lag_of(value)
        if self.form == "reciprocal":
            return self.scale / value if value else math.inf
        return value * self.scale


@dataclass(frozen=True)
class Belief:
    """One estimate and every parameter that follows it, the one it is read from first."""

    name: str
    slots: tuple[Slot, ...]

    def read(self, values: Mapping[str, float]) -> float:
        """What is believed [SI], from parameter values."""
        first = self.slots[0]
        return first.estimate(values[first.parameter])

    def writes(self, estimate: float) -> tuple[tuple[str, float], ...]:
        """Parameters and values that hold an estimate [SI]."""
        return tuple((slot.parameter, slot.value(estimate)) for slot in self.slots)


def indi_beliefs(vehicle: Vehicle) -> tuple[Belief, ...]:
    """Inertia as control effectiveness g1 = torque of a unit / inertia, g2 where the rotors' inertia is known, lag.

    Raises: ValueError: one sentence on what the vehicle file lacks.
    """
    torque = effectiveness_torque(vehicle)
    slots = [[Slot(f"ctrlINDI.g1_{axis}", "reciprocal", t)] for axis, t in zip("pqr", torque)]
    rotor_inertia = float(vehicle.effects.get(ROTOR_INERTIA.name, {}).get("inertia", 0.0))
    if rotor_inertia > 0.0:
        slots[2].append(Slot("ctrlINDI.g2", "reciprocal", rotor_reaction_factor(vehicle, rotor_inertia)))
    lag = Belief("motor_time_constant", tuple(Slot(f"ctrlINDI.act_dyn_{axis}", "lag") for axis in "pqr"))
    return (*(Belief(name, tuple(s)) for name, s in zip(INERTIA_NAMES, slots)), lag)


def mass_thrust_belief(vehicle: Vehicle) -> tuple[Belief, float]:
    """Mellinger's massThrust and the value [1/N] that makes ctrlMel.mass a mass.

    Raises: ValueError: one sentence on what the vehicle file lacks.
    """
    value = mass_thrust(vehicle, force=vehicle.mass * GRAVITY, volts=NOMINAL_VOLTS)
    return Belief("mass_thrust", (Slot("ctrlMel.massThrust"),)), value


def drag_beliefs() -> tuple[Belief, ...]:
    """Drag over mass [1/s] of the onboard filter, along body x and y."""
    return tuple(Belief(name, (Slot(f"kalman.dragB_{name[-1]}"),)) for name in DRAG_NAMES)
