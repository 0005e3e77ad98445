"""Plan a flight that narrows intervals, or a flight that tells two effects apart."""

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from crazyem.api.inputs import VehicleLike, vehicle_of
from crazyem.errors import FileFormatError, UsageError
from crazyem.estimation.model import GROUPS, Noise
from crazyem.physics import folding
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.planning.informative import PROCESS, noise_in
from crazyem.planning.limits import Limits
from crazyem.planning.plan import DEFAULT, Plan, can_discriminate, plan_discrimination, plan_parameters
from crazyem.toml_file import read_text
from crazyem.vehicle import Vehicle

LARGEST_JSON = 1 << 26  # bytes of a diagnosis or summary


def plan(
    vehicle: VehicleLike = "cf2",
    *,
    parameters: Sequence[str] = (),
    split: tuple[str, str] | None = None,
    diagnosis: str | Path | None = None,
    box: tuple[float, float, float] = (1.0, 1.0, 0.6),
    tilt: float = 20.0,
    duration: float = 10.0,
    criterion: str = "D",
    noise: str | Path | None = None,
    starts: int = 3,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Plan:
    """Plan the most informative flight within limits, without flying. One goal: `parameters`, `split` or `diagnosis`.

    Args:
        vehicle: the present model of the drone: a Vehicle, a preset's name or a file.
        parameters: parameters whose intervals should become narrow; mass, Ixx, Iyy, Izz if no goal is given.
        split: two effects to tell apart.
        diagnosis: JSON of a diagnosis; the goal is to tell apart its first pair of look-alikes.
        box: m, full widths along x, y, z. tilt: deg. duration: s.
        criterion: for `parameters`: "D" (volume of the joint interval) or "A" (sum of relative variances).
        noise: JSON of an earlier flight or replay of the same drone, which gives the expected noise.
        starts, seed: of the search; the same seed gives the same plan.
        progress: called with a line for each start.

    Raises:
        UsageError: arguments that do not fit; an unknown name. FileFormatError: a file that cannot be used.
    """
    say = progress or (lambda text: None)
    if sum(map(bool, (parameters, split, diagnosis))) > 1:
        raise UsageError("a plan has one goal: parameters, a pair to split, or a diagnosis.")
    if criterion not in ("A", "D"):
        raise UsageError(f"unknown criterion '{criterion}' (A or D).")
    given = vehicle_of(vehicle)
    limits = Limits(box=box, tilt=math.radians(tilt))
    if not given.arm[0] or not given.torque_per_thrust:
        raise UsageError(f"vehicle {given.name} has no rotors in its file, so nothing can be planned for it.")
    pair = look_alikes(diagnosis)[0] if diagnosis is not None else split
    if pair is not None:
        return plan_discrimination(*pair, given, limits, duration=duration, starts=starts, seed=seed, say=say)
    nominal, _ = folding.fold(given)
    scales = None if noise is None else noise_of(noise, nominal)
    return plan_parameters(
        tuple(parameters) or DEFAULT, nominal, limits, duration=duration, criterion=criterion, noise=scales,
        starts=starts, seed=seed, say=say,
    )  # fmt: skip


def look_alikes(path: str | Path) -> list[tuple[str, str]]:
    """Pairs of effects that a diagnosis could not tell apart, from its JSON.

    Raises:
        UsageError: no such file, or the diagnosis has no such pair. FileFormatError: the file is no diagnosis.
    """
    data = _json(path, "diagnosis")
    groups = data.get("indistinguishable") if data.get("format") == "crazyem-diagnosis" else None
    if not isinstance(groups, list):
        raise FileFormatError(f"{path}: not a diagnosis: no key 'indistinguishable'.")
    pairs = [
        (group[0], other) for group in groups if isinstance(group, list) for other in group[1:]
        if group[0] in CATALOGUE and other in CATALOGUE and group[0] != other
    ]  # fmt: skip
    if not pairs:
        raise UsageError(f"{path}: the diagnosis leaves no effects that could be told apart.")
    return pairs


def plan_commands(groups: Sequence[Sequence[str]], vehicle: Vehicle, name: str) -> list[str]:
    """Sentences with commands that plan a flight, one for each pair of look-alikes that a manoeuvre can tell apart.

    Args:
        groups: names of effects, as in `indistinguishable` of a diagnosis.
        vehicle: of the diagnosis. name: of the vehicle in the command.
    """
    return [
        f"fly a plan that tells {group[0]} from {other}: crazyem plan --split {group[0]},{other} "
        f"--vehicle {name} -o plan.toml"
        for group in groups for other in group[1:] if can_discriminate(group[0], other, vehicle, Limits())
    ]  # fmt: skip


def noise_of(path: str | Path, vehicle: Vehicle) -> Noise:
    """Noise scales from the summary of a flight or replay, in the estimator's units of acceleration.

    Raises:
        UsageError: no such file. FileFormatError: the file has no noise scales.
    """
    data = _json(path, "summary")
    estimate = data.get("estimate", data)
    found = noise_in(estimate.get("noise") if isinstance(estimate, dict) else None, vehicle)
    if found is None:
        raise FileFormatError(f"{path}: no noise scales ({', '.join((*PROCESS, *GROUPS[:4]))}) of a flight.")
    return found


def _json(path: str | Path, what: str) -> dict[str, Any]:
    text = read_text(path, what=what, largest=LARGEST_JSON)
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        raise FileFormatError(f"{path}: not a {what}: no JSON.") from None
    if not isinstance(data, dict):
        raise FileFormatError(f"{path}: not a {what}: no JSON object.")
    return data
