"""Mass properties: payload, center_of_mass, inertia, inertia_products, by Steiner's theorem.

    M = m + m_p;  c = (m c_0 + m_p r) / M;  J = J_0 + m S(c_0 - c) + m_p S(r - c),  S(d) = |d|^2 I - d d'

m, J_0: the bare body's mass and inertia about its own centre of mass, c_0 = center_of_mass; r, m_p: payload, a point
mass. `inertia` and `inertia_products` replace elements of J_0. Places are from the geometric origin (the middle of the
rotors), body axes. Source: any textbook of mechanics.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from firmware_sim.plant.effects.catalogue import Values


@dataclass(frozen=True)
class Body:
    """mass kg; inertia (3, 3) kg m^2 about the centre of mass; center_of_mass (3,) m from the geometric origin."""

    mass: float
    inertia: np.ndarray
    center_of_mass: np.ndarray


def loaded_body(
    mass: float, inertia: np.ndarray, effects: Mapping[str, Values], load: Sequence[tuple[float, Sequence[float]]]
) -> Body:
    """The vehicle's body with the effects on its mass and inertia. Absent effects change no bit.

    load: point masses [kg] with their places [m, body], attached one after the other.
    """
    c = np.zeros(3)
    if "center_of_mass" in effects:
        c = np.array([effects["center_of_mass"][axis] for axis in "xyz"])
    body = Body(mass, replaced(inertia, effects), c)
    for extra, place in load:
        body = with_point(body, extra, np.array(place))
    return body


def with_point(body: Body, extra: float, r: np.ndarray) -> Body:
    """The body with a point mass `extra` [kg] at r [m, body]."""
    if extra == 0.0:
        return body
    total = body.mass + extra
    c = body.center_of_mass
    common = (body.mass * c + extra * r) / total
    return Body(total, body.inertia + body.mass * steiner(c - common) + extra * steiner(r - common), common)


def replaced(inertia: np.ndarray, effects: Mapping[str, Values]) -> np.ndarray:
    """The inertia matrix with the elements that `inertia` and `inertia_products` replace."""
    J = inertia.copy()
    for name, elements in (("inertia", (0, 0, 1, 1, 2, 2)), ("inertia_products", (0, 1, 0, 2, 1, 2))):
        values = list(effects.get(name, {}).values())
        for n, value in enumerate(values):
            if value is not None:
                i, j = elements[2 * n], elements[2 * n + 1]
                J[i, j] = J[j, i] = value
    return J


def steiner(d: np.ndarray) -> np.ndarray:
    """Inertia of a unit point mass at d [m] about the origin, m^2."""
    return float(d @ d) * np.eye(3) - np.outer(d, d)
