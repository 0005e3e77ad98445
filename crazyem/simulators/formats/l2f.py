"""l2f (RAPTOR): the JSON of `parameters_to_json`. Thrust is a polynomial in a normalised command; J_inv follows J.

Rotor positions are from the centre of mass. Rotors have separate time constants for rising and falling; in a template
their ratio stays.
"""

import math
from typing import Any

import numpy as np

from crazyem.errors import FileFormatError
from crazyem.simulators.constants import Constants, inertia_of
from crazyem.simulators.documents.literal import LiteralDocument
from crazyem.simulators.fields import AGREE, Field, Format, placed, read_positions, template
from crazyem.simulators.formats.crazyflow import speed_of
from crazyem.vehicle import GRAVITY

ROUNDED = 1e-4  # relative difference up to which a derived number counts as unchanged: files hold rounded numbers
_AXES = "xyz"
_LAGS = ("rotor_time_constants_rising", "rotor_time_constants_falling")


def _root(document: LiteralDocument) -> tuple[Any, ...]:
    for path in (("", "dynamics"), ("",)):
        if "rotor_thrust_coefficients" in document.keys(path):
            return path
    raise FileFormatError(f"{document.where}: no rotor_thrust_coefficients, so these are no parameters of l2f")


def _fields(document: LiteralDocument, name: str) -> list[Field]:
    root = _root(document)
    matrix = [(i, j) for i in range(3) for j in range(3)]
    return [
        Field((*root, "mass"), "mass", "kg"),
        *(Field((*root, "J", i, j), f"inertia_{''.join(sorted(_AXES[i] + _AXES[j]))}", "kg m^2") for i, j in matrix),
        *(Field((*root, "rotor_positions", 0, k), f"{what}_{_AXES[k]}", "m", own=True)
          for what, axes in (("arm", 2), ("centre", 3)) for k in range(axes)),
        Field((*root, "rotor_thrust_coefficients, at full command"), "thrust_max", "N", own=True),
        *(Field((*root, "rotor_torque_constants", k), "torque_per_thrust", "m") for k in range(4)),
        Field((*root, "rotor_time_constants, as one lag"), "lag", "s", own=True),
    ]  # fmt: skip


def _grid(document: LiteralDocument, key: str, rows: int, columns: int) -> np.ndarray:
    root = _root(document)
    found = [[document.get((*root, key, i, j)) for j in range(columns)] for i in range(rows)]
    if any(v is None for row in found for v in row):
        raise FileFormatError(f"{document.where}: dynamics.{key} must hold {rows} times {columns} numbers")
    return np.array(found, float)


def _thrust_at(law: np.ndarray, command: float) -> float:
    return float(law @ [1.0, command, command**2])


def _limits(document: LiteralDocument) -> tuple[float, float]:
    root = _root(document)
    low, high = (document.get((*root, "action_limit", k)) for k in ("min", "max"))
    return (0.0 if low is None else low), (1.0 if high is None else high)


def _lags(document: LiteralDocument) -> list[float]:
    """Mean rotor time constants of rising and of falling [s]; empty if missing."""
    found = []
    for key in _LAGS:
        values = [document.get((*_root(document), key, k)) for k in range(4)]
        found += [float(np.mean([v for v in values if v is not None]))] if None not in values else []
    return found if len(found) == 2 and min(found) > 0.0 else []


def _read_more(document: LiteralDocument, name: str, found: dict[str, float]) -> list[str]:
    positions = _grid(document, "rotor_positions", 4, 3)
    values, remarks = read_positions(positions, where=document.where, field="dynamics.rotor_positions")
    found |= values
    law = _grid(document, "rotor_thrust_coefficients", 4, 3).mean(axis=0)
    found["thrust_max"] = _thrust_at(law, _limits(document)[1])
    if lags := _lags(document):
        found["lag"] = math.sqrt(lags[0] * lags[1])
        if abs(lags[0] - lags[1]) > 0.01 * lags[0]:
            remarks.append(f"rotors take {1e3 * lags[0]:.0f} ms to rise and {1e3 * lags[1]:.0f} ms to fall; one lag of "
                           f"{1e3 * found['lag']:.0f} ms stands for both")  # fmt: skip
    if law[0] or law[1]:
        remarks.append("rotor_thrust_coefficients are no parabola; crazyem knows the thrust at full command only")
    matrix, inverse = _grid(document, "J", 3, 3), _grid(document, "J_inv", 3, 3)
    if matrix.any() and np.abs(matrix @ inverse - np.eye(3)).max() > AGREE:
        raise FileFormatError(f"{document.where}: dynamics.J_inv is not the inverse of dynamics.J")
    return remarks


def _write_more(document: LiteralDocument, name: str, c: Constants) -> None:
    root = _root(document)

    def put(path: tuple[Any, ...], value: float, now: float, rounded: float = 1e-9) -> None:
        if abs(value - now) > rounded * max(abs(value), abs(now)):
            document.put((*root, *path), value)

    if c.arm_x is not None and c.arm_y is not None:
        now = _grid(document, "rotor_positions", 4, 3)
        for (i, j), value in np.ndenumerate(placed(now, c)):
            put(("rotor_positions", i, j), float(value) if abs(value) > 1e-15 else 0.0, float(now[i, j]))
    matrix = inertia_of(c)
    if matrix is not None:
        now = _grid(document, "J_inv", 3, 3)
        for (i, j), value in np.ndenumerate(np.linalg.inv(matrix)):
            put(("J_inv", i, j), float(value), float(now[i, j]), ROUNDED)
    if c.lag and (lags := _lags(document)):
        factor = c.lag / math.sqrt(lags[0] * lags[1])
        for key in _LAGS:
            for k in range(4):
                present = document.get((*root, key, k)) or 0.0
                put((key, k), present * factor, present)
    if c.thrust_max is None:
        return
    laws = _grid(document, "rotor_thrust_coefficients", 4, 3)
    low, high = _limits(document)
    factor = c.thrust_max / _thrust_at(laws.mean(axis=0), high)
    for (i, j), value in np.ndenumerate(laws):
        put(("rotor_thrust_coefficients", i, j), float(value * factor), float(value))
    throttle = document.get((*root, "hovering_throttle_relative"))
    if throttle is not None and c.mass is not None:
        command = speed_of(laws.mean(axis=0) * factor, c.mass * GRAVITY / 4.0)
        if math.isfinite(command) and high > low:
            put(("hovering_throttle_relative",), (command - low) / (high - low), throttle, ROUNDED)


L2F = Format(
    name="l2f",
    order=90,
    suffix=".json",
    words="parameters of l2f (RAPTOR), JSON",
    open=LiteralDocument,
    recognises=lambda text: "rotor_thrust_coefficients" in text and "rotor_torque_constants" in text,
    fields=_fields,
    skeleton=template("l2f.json"),
    read_more=_read_more,
    write_more=_write_more,
    source="rl_tools, rl/environments/l2f (json of Dynamics, multirotor_dynamics)",
)
