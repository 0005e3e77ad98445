"""Beliefs: values of mass, inertia, lag or drag that a controller or the onboard filter uses, and their parameters."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from crazyem.control.command_units import effectiveness_torque, lag_of, lag_share, mass_thrust, rotor_reaction_factor
from crazyem.physics.effects.rotors import ROTOR_INERTIA
from crazyem.vehicle import GRAVITY, Vehicle

Form = Literal["proportional", "reciprocal", "lag"]
NOMINAL_VOLTS = 3.7  # V; without effect if the firmware compensates the voltage
INERTIA_NAMES = ("Ixx", "Iyy", "Izz")
DRAG_NAMES = ("drag_x", "drag_y")


@dataclass(frozen=True)
class Slot:
    """A firmware parameter and its relation to an estimate.

    Attributes:
        parameter: its name.
        form, scale: the parameter is estimate / scale (proportional), scale / estimate (reciprocal), or the filter
            coefficient of a time constant in one period of INDI's loop (lag).
    """

    parameter: str
    form: Form = "proportional"
    scale: float = 1.0

    def value(self, estimate: float) -> float:
        """The parameter's value for an estimate [SI]."""
        if self.form == "lag":
            return lag_share(estimate)
        if self.form == "reciprocal":
            return self.scale / estimate if estimate else math.inf
        return estimate / self.scale

    def estimate(self, value: float) -> float:
        """The estimate [SI] for a parameter's value."""
        if self.form == "lag":
            return lag_of(value)
        if self.form == "reciprocal":
            return self.scale / value if value else math.inf
        return value * self.scale


@dataclass(frozen=True)
class Belief:
    """One estimate and all parameters that depend on it; the estimate is read from the first one."""

    name: str
    slots: tuple[Slot, ...]

    def read(self, values: Mapping[str, float]) -> float:
        """The believed value [SI], from parameter values."""
        first = self.slots[0]
        return first.estimate(values[first.parameter])

    def writes(self, estimate: float) -> tuple[tuple[str, float], ...]:
        """Parameters and their values for an estimate [SI]."""
        return tuple((slot.parameter, slot.value(estimate)) for slot in self.slots)


def indi_beliefs(vehicle: Vehicle) -> tuple[Belief, ...]:
    """Beliefs of INDI: g1 = torque of a command unit / inertia, g2 if the rotors' inertia is known, and the lag.

    Raises: ValueError: one sentence about the missing entry of the vehicle file.
    """
    torque = effectiveness_torque(vehicle)
    slots = [[Slot(f"ctrlINDI.g1_{axis}", "reciprocal", t)] for axis, t in zip("pqr", torque)]
    rotor_inertia = float(vehicle.effects.get(ROTOR_INERTIA.name, {}).get("inertia", 0.0))
    if rotor_inertia > 0.0:
        slots[2].append(Slot("ctrlINDI.g2", "reciprocal", rotor_reaction_factor(vehicle, rotor_inertia)))
    lag = Belief("motor_time_constant", tuple(Slot(f"ctrlINDI.act_dyn_{axis}", "lag") for axis in "pqr"))
    return (*(Belief(name, tuple(s)) for name, s in zip(INERTIA_NAMES, slots)), lag)


def mass_thrust_belief(vehicle: Vehicle) -> tuple[Belief, float]:
    """Mellinger's massThrust, and its value [1/N] with which ctrlMel.mass is the mass in kg.

    Raises: ValueError: one sentence about the missing entry of the vehicle file.
    """
    value = mass_thrust(vehicle, force=vehicle.mass * GRAVITY, volts=NOMINAL_VOLTS)
    return Belief("mass_thrust", (Slot("ctrlMel.massThrust"),)), value


def drag_beliefs() -> tuple[Belief, ...]:
    """Drag over mass [1/s] of the onboard filter, along body x and y."""
    return tuple(Belief(name, (Slot(f"kalman.dragB_{name[-1]}"),)) for name in DRAG_NAMES)
