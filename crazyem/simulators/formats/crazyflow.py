"""crazyflow: a table per drone in `dynamics/first_principles/params.toml`.

Thrust and torque are polynomials in RPM. Rotors have two rates, for rising and falling speed. The constants are values
at hover; in a template the polynomials and rates are scaled as a whole and keep their shape.
"""

import math
from collections.abc import Sequence
from typing import Any

from crazyem.simulators.constants import RPM, Constants, hover_speed
from crazyem.simulators.documents.tables import TomlDocument
from crazyem.simulators.fields import Field, Format, template
from crazyem.vehicle import GRAVITY

_AXES = "xyz"
PER_RPM2 = 1.0 / RPM**2  # N/RPM^2 of one N/(rad/s)^2
BENT = 1e-6  # share of constant and linear terms in hover thrust above which a polynomial is no parabola


def _fields(document: Any, name: str) -> list[Field]:
    matrix = [(i, j) for i in range(3) for j in range(3)]
    return [
        Field((name, "mass"), "mass", "kg"),
        *(Field((name, "J", i, j), f"inertia_{''.join(sorted(_AXES[i] + _AXES[j]))}", "kg m^2") for i, j in matrix),
        Field((name, "L"), "arm", "m"),
        Field((name, "thrust_max"), "thrust_max", "N"),
        Field((name, "rpm2thrust, at hover"), "thrust_per_speed2", "N/RPM^2", factor=PER_RPM2, own=True),
        Field((name, "rpm2torque, at hover"), "torque_per_speed2", "N m/RPM^2", factor=PER_RPM2, own=True),
        Field((name, "rotor_dyn_coef, as one lag"), "lag", "s", own=True),
        *(Field((name, "drag_matrix", i, i), f"drag_{_AXES[i]}", "N s/m", factor=-1.0) for i in range(3)),
    ]


def _numbers(document: TomlDocument, name: str, key: str, count: int) -> list[float]:
    found = [document.get((name, key, k)) for k in range(count)]
    return [] if any(v is None for v in found) else [float(v) for v in found if v is not None]


def speed_of(law: Sequence[float], thrust: float) -> float:
    """Speed [RPM] at which a polynomial gives a thrust [N]; NaN if there is none."""
    a, b, c = law[0] - thrust, law[1], law[2]
    root = b * b - 4.0 * a * c
    return (-b + math.sqrt(root)) / (2.0 * c) if c > 0.0 and root >= 0.0 else math.nan


def _read_more(document: TomlDocument, name: str, found: dict[str, float]) -> list[str]:
    remarks = []
    law, torque = (_numbers(document, name, key, 3) for key in ("rpm2thrust", "rpm2torque"))
    hover = found.get("mass", math.nan) * GRAVITY / 4.0
    rpm = speed_of(law, hover) if law else math.nan
    if law and math.isfinite(rpm):
        found["thrust_per_speed2"] = hover / (rpm / RPM) ** 2
        if abs(law[0]) + abs(law[1] * rpm) > BENT * hover:
            remarks.append(
                f"{name}.rpm2thrust is no parabola: thrust per squared speed is that at hover, {rpm:.0f} RPM"
            )
        if torque:
            found["torque_per_thrust"] = (torque[0] + torque[1] * rpm + torque[2] * rpm**2) / hover
    rates = _rates(_numbers(document, name, "rotor_dyn_coef", 4), rpm)
    if rates:
        found["lag"] = 1.0 / math.sqrt(rates[0] * rates[1])
        if abs(rates[0] - rates[1]) > 0.01 * rates[0]:
            remarks.append(
                f"{name}.rotor_dyn_coef: rotors take {1e3 / rates[0]:.0f} ms to rise and {1e3 / rates[1]:.0f} ms to "
                f"fall; one lag of {1e3 * found['lag']:.0f} ms stands for both"
            )
    return remarks


def _rates(coefficients: Sequence[float], rpm: float) -> tuple[float, float] | None:
    """Rates of rise and fall at a speed [1/s]."""
    if not coefficients:
        return None
    a, b, c, d = coefficients
    if (b or d) and not math.isfinite(rpm):
        return None
    up, down = a + 2.0 * (b and b * rpm), c + 2.0 * (d and d * rpm)
    return (up, down) if up > 0.0 and down > 0.0 else None


def _write_more(document: TomlDocument, name: str, c: Constants) -> None:
    rpm = hover_speed(c) * RPM
    if c.mass is not None and math.isfinite(rpm):
        hover = c.mass * GRAVITY / 4.0
        _scale(document, name, "rpm2thrust", hover, rpm)
        if c.torque_per_thrust is not None:
            _scale(document, name, "rpm2torque", hover * c.torque_per_thrust, rpm)
    coefficients = _numbers(document, name, "rotor_dyn_coef", 4)
    rates = _rates(coefficients, rpm)
    if c.lag and rates:
        factor = 1.0 / (c.lag * math.sqrt(rates[0] * rates[1]))
        if abs(factor - 1.0) > 1e-9:
            for k, value in enumerate(coefficients):
                document.put((name, "rotor_dyn_coef", k), value * factor)


def _scale(document: TomlDocument, name: str, key: str, wanted: float, rpm: float) -> None:
    """Scale a polynomial so that it has the wanted value at a speed."""
    law = _numbers(document, name, key, 3)
    now = law[0] + law[1] * rpm + law[2] * rpm**2 if law else 0.0
    if now <= 0.0:
        law, now = [0.0, 0.0, 1.0], rpm**2
    for k, value in enumerate(law):
        if abs(wanted / now - 1.0) > 1e-9 and document.get((name, key, k)) is not None:
            document.put((name, key, k), value * (wanted / now))


def _key(name: str) -> str:
    return name if name.replace("_", "").replace("-", "").isalnum() else '"' + name.replace('"', "") + '"'


CRAZYFLOW = Format(
    name="crazyflow",
    order=10,
    suffix=".toml",
    words="crazyflow's first-principles parameters (TOML)",
    open=TomlDocument,
    recognises=lambda text: "rpm2thrust" in text and "rotor_dyn_coef" in text and "=" in text and "<" not in text[:1],
    names=lambda document: [k for k in document.keys(()) if "rpm2thrust" in document.keys((k,))],
    fields=_fields,
    skeleton=template("crazyflow.toml", named=_key),
    read_more=_read_more,
    write_more=_write_more,
    source="comments of crazyflow 0.4, dynamics/first_principles/params.toml",
)
