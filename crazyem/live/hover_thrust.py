"""Hover thrust of PX4 and ArduPilot as something the guard can write: a mass in other units.

A drone whose hover thrust parameter was right at the mass of the vehicle file needs, at another mass, the old value
times the ratio of the masses, as long as thrust grows in proportion to what is asked for. That holds where the
autopilot linearises its motors (THR_MDL_FAC, MOT_THST_EXPO) and the battery (MOT_BAT_VOLT_MAX); else it is a first
step.
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
    """Where estimates can be pushed to on a MAVLink drone, or None and one sentence why not.

    Args:
        link: open. vehicle: its mass is the one at which the parameter was right.
    """
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
    """The policy's bounds and those of hover thrust, whichever are narrower; its battery threshold for every cell."""
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
    """What has to be known before the next session, one sentence; "" if the drone holds what it held.

    The next session would take the new value for right at the old mass, and make the same correction twice.

    Args:
        now: parameters the drone holds, NaN where not known. before: at connect.
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
