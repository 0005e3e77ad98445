"""Beliefs of each firmware controller about the drone, and the ordered parameter writes that change them.

A belief is a value of mass, inertia, lag or drag that a controller or the onboard filter uses, with its parameters.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Literal

from crazyem.control.command_units import effectiveness_torque, lag_of, lag_share, mass_thrust, rotor_reaction_factor
from crazyem.errors import UsageError
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


AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Controller:
    """A controller of the firmware and the parameters of its mass and inertia.

    Attributes:
        name: as on the command line.
        number: value of the parameter stabilizer.controller.
        mass: parameter of the believed mass [kg], "" if the controller has none.
        inertia: parameters of the believed principal inertia [kg m^2], empty if the controller has none.
        attitude_gains: for each axis, (proportional, derivative) gain parameters in absolute N m/rad and N m s/rad,
            which are scaled with the inertia; empty if gains are per unit of inertia.
        others: other beliefs of the controller or of the onboard filter.
        wrench: log group of its commanded thrust and torque, "" if it logs none in SI units.
        note: for the user, about pushing to this controller.
        known: estimates from the vehicle file, not from the flight, such as mass_thrust [1/N].
        incremental: whether the controller uses control effectiveness, which is the loop gain (INDI).
    """

    name: str
    number: int
    mass: str = ""
    inertia: tuple[str, ...] = ()
    attitude_gains: tuple[tuple[str, str], ...] = ()
    others: tuple[Belief, ...] = ()
    wrench: str = ""
    note: str = ""
    known: tuple[tuple[str, float], ...] = ()
    incremental: bool = False
    mass_scale: float = 1.0  # kg per unit of the mass parameter, if it is not a mass (see crazyem.live.push)
    persistent: bool = False  # whether parameters outlive a restart of the firmware

    @property
    def beliefs(self) -> tuple[Belief, ...]:
        """All beliefs of the controller."""
        mass = (Belief("mass", (Slot(self.mass, scale=self.mass_scale),)),) if self.mass else ()
        inertia = tuple(Belief(name, (Slot(p),)) for name, p in zip(INERTIA_NAMES, self.inertia))
        return (*mass, *inertia, *self.others)

    @property
    def waits(self) -> Mapping[str, tuple[str, ...]]:
        """Estimate -> other estimates that are written with it or before it.

        Attitude gains of roll and pitch have one scale. INDI has a loop gain for each axis, but a lag that is estimated
        with a wrong inertia is wrong, too.
        """
        if self.incremental:
            return {"motor_time_constant": ("Ixx", "Iyy")}
        return {"Ixx": ("Iyy",), "Iyy": ("Ixx",)} if self.attitude_gains else {}

    @property
    def parameters(self) -> tuple[str, ...]:
        """Every parameter a push may write; their values at connect are the reference for scaling."""
        held = tuple(slot.parameter for belief in self.beliefs for slot in belief.slots)
        return held + tuple(g for pair in self.attitude_gains for g in pair)


# ctrlLee.J_* appears only in the small term omega x J omega, and the attitude gains are absolute torques. So a new
# inertia has almost no effect unless the gains are scaled (controller_lee.c).
LEE = Controller(
    "lee",
    5,
    mass="ctrlLee.mass",
    inertia=tuple(f"ctrlLee.J_{a}" for a in AXES),
    attitude_gains=tuple((f"ctrlLee.KR_{a}", f"ctrlLee.Kw_{a}") for a in AXES),
    wrench="ctrlLee",
)
LQG = Controller("lqg", 6, mass="ctrlLqg.mass", inertia=tuple(f"ctrlLqg.J_{a}" for a in AXES), wrench="ctrlLqg")
MELLINGER = Controller("mellinger", 2, mass="ctrlMel.mass")
INDI = Controller("indi", 3, incremental=True)
CONTROLLERS = {c.number: c for c in (LEE, LQG, MELLINGER, INDI)}
CONTROLLER_NAMES = {0: "auto", 1: "PID", 2: "Mellinger", 3: "INDI", 4: "Brescianini", 5: "Lee", 6: "LQG"}


def for_vehicle(controller: Controller, vehicle: Vehicle) -> Controller | str:
    """The controller with the beliefs that this vehicle allows, or one clause why there are none."""
    if controller.number == INDI.number:
        try:
            return replace(controller, others=indi_beliefs(vehicle))
        except ValueError as error:
            return f"{error}: the control effectiveness of INDI is not known"
    if controller.number == MELLINGER.number:
        try:
            belief, value = mass_thrust_belief(vehicle)
        except ValueError as error:
            return replace(
                controller, note=f"{error}: ctrlMel.massThrust is left alone, and ctrlMel.mass goes with it."
            )
        return replace(controller, others=(belief,), known=((belief.name, value),))
    return controller


def with_drag(controller: Controller) -> Controller:
    """The controller with the drag of the onboard filter among its beliefs."""
    return replace(controller, others=controller.others + drag_beliefs())


def controller_named(name: str) -> Controller:
    """The controller of that name.

    Raises:
        UsageError: unknown name.
    """
    for c in CONTROLLERS.values():
        if c.name == name:
            return c
    raise UsageError(f"unknown controller '{name}' (choose {', '.join(c.name for c in CONTROLLERS.values())}).")


# For the message about a controller that takes no estimates: the alternatives.
_SWITCHING = "Lee takes mass and inertia, Mellinger mass and thrust scale, INDI control effectiveness and rotor lag"


def without_target(number: int) -> str:
    """One sentence about a controller that takes no estimates."""
    name = CONTROLLER_NAMES.get(number, f"number {number}")
    why = "takes no mass or inertia"
    if number == 1:
        why = "takes no mass or inertia, only gains"
    elif number == 4:
        why = "has mass and inertia compiled in"
    return f"the {name} controller {why}: estimates are not pushed to it ({_SWITCHING})."


def writes_for(
    controller: Controller,
    changed: Mapping[str, float],
    *,
    beliefs: Mapping[str, float],
    originals: Mapping[str, float],
) -> tuple[tuple[str, float], ...]:
    """Parameter writes, in a safe order, that change beliefs of the controller.

    Attitude gains are scaled by the new inertia over the inertia at connect, so the closed-loop poles stay the same;
    roll and pitch are scaled together by their mean. If the stiffness rises, the damping gain is written first; if it
    falls, the stiffness is. So an incomplete set is never less damped than the old or the new gains.

    Args:
        changed: new estimates [SI]: mass, Ixx, Iyy, Izz, ...
        beliefs: all present beliefs of the controller.
        originals: parameter values at connect.
    """
    now = {**beliefs, **changed}
    held = {p: v for b in controller.beliefs for p, v in b.writes(beliefs[b.name])}
    target = {p: v for b in controller.beliefs if b.name in changed for p, v in b.writes(changed[b.name])}
    writes = [(name, target[name]) for name in _ordered(controller, target, held)]
    if not controller.attitude_gains or not set(INERTIA_NAMES) & set(changed):
        return tuple(writes)
    jx, jy, jz = (originals[p] for p in controller.inertia)
    tilt = (now["Ixx"] + now["Iyy"]) / (jx + jy)
    tilt_before = (beliefs["Ixx"] + beliefs["Iyy"]) / (jx + jy)
    for axis, scale, before, names in (
        (0, tilt, tilt_before, ("Ixx", "Iyy")),
        (1, tilt, tilt_before, ("Ixx", "Iyy")),
        (2, now["Izz"] / jz, beliefs["Izz"] / jz, ("Izz",)),
    ):
        if not any(n in changed for n in names):
            continue
        stiffness, damping = controller.attitude_gains[axis]
        pair = [(damping, originals[damping] * scale), (stiffness, originals[stiffness] * scale)]
        writes.extend(pair if scale >= before else pair[::-1])
    return tuple(writes)


EQUAL_WITHIN = 1e-6  # largest relative difference of equal values: sixteen steps of the firmware's floats


def writes_back(
    controller: Controller,
    target: Mapping[str, float],
    *,
    now: Mapping[str, float],
    uncertain: Collection[str] = (),
) -> tuple[tuple[str, float], ...]:
    """Parameter writes from the values `now` to those of `target`, in a safe order like `writes_for`.

    Args:
        target: firmware parameter -> value; other parameters are not written.
        now: values in the drone; NaN if unknown.
        uncertain: parameters to write even if `now` is equal, because this value was not confirmed.
    """

    def differs(name: str) -> bool:
        value = now.get(name, math.nan)
        return name in target and (name in uncertain or not math.isclose(value, target[name], rel_tol=EQUAL_WITHIN))

    held = [slot.parameter for belief in controller.beliefs for slot in belief.slots]
    wanted = {n: target[n] for n in held if differs(n)}
    names = _ordered(controller, wanted, now)
    for stiffness, damping in controller.attitude_gains:
        rising = now.get(stiffness, math.nan) <= target.get(stiffness, math.nan)
        pair = (damping, stiffness) if rising else (stiffness, damping)
        names += [n for n in pair if differs(n)]
    return tuple((n, target[n]) for n in names)


def _ordered(controller: Controller, target: Mapping[str, float], now: Mapping[str, float]) -> list[str]:
    """Names of `target` in an order with safe intermediate states; attitude gains are ordered elsewhere.

    INDI: first a falling act_dyn, which makes the loop slower, then a rising g1 and g2, then a falling g1, and last a
    rising act_dyn. Mellinger: the thrust is the product of mass and massThrust; first the one that brings the thrust
    nearer to its final value.
    """
    names = list(target)
    if controller.incremental:
        return sorted(names, key=lambda n: _caution(n, rising=not target[n] < now.get(n, math.nan)))
    if controller.number == MELLINGER.number and {"ctrlMel.mass", "ctrlMel.massThrust"} <= set(names):
        errors = {n: abs(math.log(now[n] / target[n])) if now.get(n, 0.0) > 0.0 else math.inf for n in names[:2]}
        names[:2] = sorted(names[:2], key=lambda n: -errors[n])
    return names


def _caution(name: str, *, rising: bool) -> int:
    """Rank of an INDI parameter in the order of writes; g2 changes while g1_r has the larger of its two values."""
    if "act_dyn" in name:
        return 5 if rising else 0
    if name.endswith(".g2"):
        return 2 if rising else 3
    if ".g1_" in name:
        return 1 if rising else 4
    return 6  # parameters of the onboard filter
