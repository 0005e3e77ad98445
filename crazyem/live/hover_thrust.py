"""Hover thrust of PX4 and ArduPilot as a parameter for the guard: a mass in other units.

The hover thrust parameter is assumed to be right at the mass of the vehicle file. At another mass it is scaled by the
ratio of the masses, if thrust is proportional to the command. This holds if the autopilot linearises its motors
(THR_MDL_FAC, MOT_THST_EXPO) and the battery (MOT_BAT_VOLT_MAX); otherwise the new value is an approximation.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

from crazyem.errors import CrazyemError
from crazyem.links.base import HoverThrustLink
from crazyem.live.controllers import Controller
from crazyem.live.write_supervisor import WriteRules
from crazyem.vehicle import Vehicle

LOWEST_HOVER_THRUST, HIGHEST_HOVER_THRUST = 0.1, 0.8  # of full thrust: PX4's own bounds on MPC_THR_HOVER
_NO_CONTROLLER = -1  # there is no stabilizer.controller


def hover_target(link: HoverThrustLink, vehicle: Vehicle) -> tuple[Controller | None, str]:
    """The target of pushes on a MAVLink drone, or None and one sentence why there is none."""
    name = link.hover_parameter
    if not name:
        return None, "this autopilot has no hover thrust parameter that is known here: estimates are not pushed."
    try:
        value = link.read_parameter(name)
    except CrazyemError as error:
        return None, f"{str(error).rstrip('.')}: estimates are not pushed."
    if not LOWEST_HOVER_THRUST <= value <= HIGHEST_HOVER_THRUST:
        bounds = f"{LOWEST_HOVER_THRUST:g} to {HIGHEST_HOVER_THRUST:g}"
        return None, f"{name} is {value:g}, outside {bounds}: estimates are not pushed."
    note = f"{name} = {value:.4g} is taken for right at {vehicle.mass:.4g} kg, and thrust for proportional to it."
    if link.onboard_hover_estimator:
        note += f" {link.onboard_hover_estimator}: what is written may have no effect, or be overwritten."
    scale = vehicle.mass / value
    return Controller("hover thrust", _NO_CONTROLLER, mass=name, mass_scale=scale, persistent=True, note=note), note


def hover_rules(rules: WriteRules, link: HoverThrustLink, controller: Controller | None) -> WriteRules:
    """Rules with the narrower of the policy's bounds and those of hover thrust; the battery threshold is per cell."""
    policy = rules.policy
    if controller is not None:
        least, most = policy.limits.mass_absolute
        inside = (
            max(least, LOWEST_HOVER_THRUST * controller.mass_scale),
            min(most, HIGHEST_HOVER_THRUST * controller.mass_scale),
        )
        policy = replace(policy, limits=replace(policy.limits, mass_absolute=inside))
    cells = max(link.cells, 1)
    if math.isfinite(policy.health.battery):
        policy = replace(policy, health=replace(policy.health, battery=policy.health.battery * cells))
    return replace(rules, policy=policy)


def hover_afterwards(controller: Controller, *, now: Mapping[str, float], before: Mapping[str, float]) -> str:
    """One sentence for the user before the next session; "" if the parameter has its value from connect.

    The next session would assume that the new value is right at the old mass, and make the same correction again.

    Args:
        now: parameter values in the drone, NaN if unknown. before: at connect.
    """
    name = controller.mass
    value = now.get(name, math.nan)
    if math.isclose(value, before.get(name, math.nan), rel_tol=1e-6):
        return ""
    if math.isnan(value):
        return f"what {name} holds is not known: read it before the next flight."
    return (
        f"{name} is {value:.4g} now, right at {value * controller.mass_scale:.4g} kg: give that mass in the vehicle "
        "file from now on, or the next session makes the same correction again."
    )
