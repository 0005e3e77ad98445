"""What each firmware controller believes about the drone, and the parameter writes that tell it better."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from crazyem.errors import UsageError

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Controller:
    """A controller of the firmware and where its mass and inertia live.

    Attributes:
        name: as on the command line.
        number: value of the parameter stabilizer.controller.
        mass: parameter that holds the believed mass [kg], "" if it takes none.
        inertia: parameters that hold the believed principal inertia [kg m^2], empty if it takes none.
        attitude_gains: for each axis, (proportional, derivative) gain parameters in absolute N m/rad and N m s/rad
            that have to be scaled with the inertia, empty if gains are per unit of inertia already.
        wrench: log group of its commanded thrust and torque, "" if it logs none in SI units.
        note: what a user has to know about pushing to it.
    """

    name: str
    number: int
    mass: str = ""
    inertia: tuple[str, ...] = ()
    attitude_gains: tuple[tuple[str, str], ...] = ()
    wrench: str = ""
    note: str = ""
    mass_scale: float = 1.0  # kg a unit of the mass parameter, where that is not a mass (see crazyem.live.hover_thrust)
    persistent: bool = False  # whether parameters outlive a restart of the firmware

    def scale(self, parameter: str) -> float:
        """SI units of the estimate in a unit of a parameter."""
        return self.mass_scale if parameter == self.mass else 1.0

    @property
    def parameters(self) -> tuple[str, ...]:
        """Every parameter a push may write; their values at connect are the reference for scaling."""
        gains = tuple(g for pair in self.attitude_gains for g in pair)
        return ((self.mass,) if self.mass else ()) + self.inertia + gains


# ctrlLee.J_* enters only the small term omega x J omega, the attitude gains are absolute torques: without scaling the
# gains a new inertia would change next to nothing (controller_lee.c).
LEE = Controller(
    "lee",
    5,
    mass="ctrlLee.mass",
    inertia=tuple(f"ctrlLee.J_{a}" for a in AXES),
    attitude_gains=tuple((f"ctrlLee.KR_{a}", f"ctrlLee.Kw_{a}") for a in AXES),
    wrench="ctrlLee",
)
LQG = Controller("lqg", 6, mass="ctrlLqg.mass", inertia=tuple(f"ctrlLqg.J_{a}" for a in AXES), wrench="ctrlLqg")
MELLINGER = Controller(
    "mellinger",
    2,
    mass="ctrlMel.mass",
    note="the Mellinger controller takes a mass but no inertia, and its mass is one only if ctrlMel.massThrust fits",
)
CONTROLLERS = {c.number: c for c in (LEE, LQG, MELLINGER)}
CONTROLLER_NAMES = {0: "auto", 1: "PID", 2: "Mellinger", 3: "INDI", 4: "Brescianini", 5: "Lee", 6: "LQG"}


def controller_named(name: str) -> Controller:
    """The controller of that name.

    Raises:
        UsageError: unknown name.
    """
    for c in CONTROLLERS.values():
        if c.name == name:
            return c
    raise UsageError(f"unknown controller '{name}' (choose lee or lqg).")


def without_target(number: int) -> str:
    """One sentence for a controller that takes no mass."""
    return (
        f"the {CONTROLLER_NAMES.get(number, f'number {number}')} controller takes no mass or inertia: "
        "estimates are not pushed (select Lee, LQG or Mellinger)."
    )


def writes_for(
    controller: Controller,
    changed: Mapping[str, float],
    *,
    beliefs: Mapping[str, float],
    originals: Mapping[str, float],
) -> tuple[tuple[str, float], ...]:
    """Parameter writes, in a safe order, that make the controller believe new values.

    Attitude gains keep the closed-loop poles: they are scaled by new inertia over the inertia at connect, roll and
    pitch together by their mean. When stiffness rises the damping gain goes first, when it falls the stiffness does,
    so that a half-done set is never less damped than either end.

    Args:
        changed: mass [kg], Ixx, Iyy, Izz [kg m^2] that are to change.
        beliefs: all four as the controller believes them now.
        originals: parameter values at connect.
    """
    now = {**beliefs, **changed}
    writes: list[tuple[str, float]] = []
    if "mass" in changed and controller.mass:
        writes.append((controller.mass, changed["mass"] / controller.mass_scale))
    for name, parameter in zip(("Ixx", "Iyy", "Izz"), controller.inertia):
        if name in changed:
            writes.append((parameter, changed[name]))
    if not controller.attitude_gains:
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


EQUAL_WITHIN = 1e-6  # relative difference of values that is none: sixteen steps of the firmware's floats


def writes_back(
    controller: Controller,
    target: Mapping[str, float],
    *,
    now: Mapping[str, float],
    uncertain: Collection[str] = (),
) -> tuple[tuple[str, float], ...]:
    """Parameter writes that lead from the values `now` to those of `target`, safe at every step like `writes_for`.

    Args:
        target: firmware parameter -> value; what is not in it is left as it is.
        now: what the drone holds, as far as known; NaN where not.
        uncertain: written even if `now` is equal, because that value was never confirmed.
    """

    def differs(name: str) -> bool:
        value = now.get(name, math.nan)
        return name in target and (name in uncertain or not math.isclose(value, target[name], rel_tol=EQUAL_WITHIN))

    names = [n for n in ((controller.mass,) if controller.mass else ()) + controller.inertia if differs(n)]
    for stiffness, damping in controller.attitude_gains:
        rising = now.get(stiffness, math.nan) <= target.get(stiffness, math.nan)
        pair = (damping, stiffness) if rising else (stiffness, damping)
        names += [n for n in pair if differs(n)]
    return tuple((n, target[n]) for n in names)
