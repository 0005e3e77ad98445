"""Gazebo: an SDF model with a MulticopterMotorModel plugin for each rotor, and the same constants in its controller.

Propellers are separate bodies here. Mass, centre and inertia of a drone are those of body and propellers together,
without the propellers' inertia about their rotation axes. In a template the propellers stay and the body changes.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import FileFormatError
from crazyem.physics.effects.mass_properties import steiner
from crazyem.simulators.constants import Constants, inertia_of
from crazyem.simulators.documents.xml import Element, XmlDocument
from crazyem.simulators.fields import NOTHING, Field, Format, template

Array = NDArray[np.float64]
_ELEMENTS = (("ixx", 0, 0), ("iyy", 1, 1), ("izz", 2, 2), ("ixy", 0, 1), ("ixz", 0, 2), ("iyz", 1, 2))


def _model(document: XmlDocument) -> tuple[tuple[str, ...], Element]:
    for path in (("model",), ("world", "model")):
        found = document.find(path)
        if found is not None and _motors(found):
            return path, found
    raise FileFormatError(
        f"{document.where}: no model with four motor plugins (motorConstant), so there is no quadrotor"
    )


def _text(element: Element, tag: str, document: XmlDocument) -> str:
    found = element.all(tag)
    return document.inner(found[0]).strip() if found else ""


def _motors(model: Element) -> list[int]:
    """Indices of the motor plugins."""
    found = [k for k, p in enumerate(model.all("plugin")) if p.all("motorConstant")]
    return found if len(found) == 4 else []


@dataclass(frozen=True)
class _Parts:
    """Link indices of the body and of four propellers; their masses [kg], places [m] and inertias [kg m^2].

    centre: body's centre of mass [m]; places: (4, 3), middle: their mean; own: (3, 3) sum of the
    propellers' inertias, 0 about their spin axes.
    """

    body: int
    props: tuple[int, ...]
    mass: float
    centre: Array
    inertia: Array
    masses: Array
    places: Array
    own: Array

    @property
    def middle(self) -> Array:
        return np.asarray(self.places.mean(axis=0))

    @property
    def rounding(self) -> float:
        """Largest distance [m] that counts as a rounding error."""
        return NOTHING * float(np.abs(self.places - self.middle).max())


def _pose(element: Element, document: XmlDocument) -> Array:
    words = _text(element, "pose", document).split() or ["0"] * 6
    if len(words) != 6:
        raise FileFormatError(f"{document.where}: a <pose> must hold six numbers, got '{' '.join(words)}'")
    return np.array(words, float)


def _parts(document: XmlDocument) -> _Parts:
    _, model = _model(document)
    links = model.all("link")
    names = [link.name() for link in links]
    plugins = model.all("plugin")
    of_motors = [_text(plugins[k], "linkName", document) for k in _motors(model)]
    if any(n not in names for n in of_motors):
        raise FileFormatError(f"{document.where}: a motor plugin's linkName is no link of the model")
    props = tuple(names.index(n) for n in of_motors)
    others = [k for k in range(len(links)) if k not in props and links[k].all("inertial")]
    if not others:
        raise FileFormatError(f"{document.where}: the model has no body with <inertial>")
    body = max(others, key=lambda k: _number(links[k], document, "mass"))
    inertia = _inertia(links[body], document)
    places = np.array([_pose(links[k], document)[:3] for k in props])
    own = np.zeros((3, 3))
    for k in props:
        matrix = _inertia(links[k], document)
        own += np.diag([matrix[0, 0], matrix[1, 1], 0.0])
    centre = _pose(links[body], document)[:3] + _pose(links[body].all("inertial")[0], document)[:3]
    masses = np.array([_number(links[k], document, "mass") for k in props])
    return _Parts(body, props, _number(links[body], document, "mass"), centre, inertia, masses, places, own)


def _number(link: Element, document: XmlDocument, *path: str) -> float:
    """A number of a link's <inertial> element; 0 if missing."""
    elements = [link]
    for tag in ("inertial", *path[:-1]):
        elements = elements[0].all(tag) if elements else []
    text = _text(elements[0], path[-1], document) if elements else ""
    try:
        return float(text or 0.0)
    except ValueError:
        where = ".".join((link.name(), "inertial", *path))
        raise FileFormatError(f"{document.where}: {where} is no number: '{text}'") from None


def _inertia(link: Element, document: XmlDocument) -> Array:
    matrix = np.zeros((3, 3))
    for name, i, j in _ELEMENTS:
        matrix[i, j] = matrix[j, i] = _number(link, document, "inertia", name)
    return matrix


def _fields(document: XmlDocument, name: str) -> list[Field]:
    path, model = _model(document)
    parts = _parts(document)
    inertial = (*path, f"link[{parts.body}]", "inertial")
    found = [
        Field((*inertial, "mass", "#"), "mass", "kg", offset=-float(parts.masses.sum())),
        *(Field((*inertial, "inertia", key, "#"), f"inertia_{key[1:]}", "kg m^2", own=True) for key, _, _ in _ELEMENTS),
        *(Field((*inertial, "pose", "#", k), f"centre_{'xyz'[k]}", "m", own=True) for k in range(3)),
        *(Field((*path, f"link[{link}]", "pose", "#", k), f"arm_{'xy'[k]}", "m", magnitude=True)
          for link in parts.props for k in (0, 1)),
    ]  # fmt: skip
    for k in _motors(model):
        motor = (*path, f"plugin[{k}]")
        found += [
            Field((*motor, "motorConstant", "#"), "thrust_per_speed2", "N/(rad/s)^2"),
            Field((*motor, "momentConstant", "#"), "torque_per_thrust", "m"),
            Field((*motor, "maxRotVelocity", "#"), "speed_max", "rad/s"),
            Field((*motor, "timeConstantUp and Down, as one lag"), "lag", "s", own=True),
            Field((*motor, "rotorDragCoefficient", "#"), "rotor_drag_xy", "N/(m/s)/(rad/s)"),
        ]
    for k, plugin in enumerate(model.all("plugin")):
        for rotors in plugin.all("rotorConfiguration"):
            for n, _ in enumerate(rotors.all("rotor")):
                rotor = (*path, f"plugin[{k}]", "rotorConfiguration", f"rotor[{n}]")
                found.append(Field((*rotor, "forceConstant", "#"), "thrust_per_speed2", "N/(rad/s)^2"))
                found.append(Field((*rotor, "momentConstant", "#"), "torque_per_thrust", "m"))
    return found


def _read_more(document: XmlDocument, name: str, found: dict[str, float]) -> list[str]:
    parts = _parts(document)
    total = parts.mass + parts.masses.sum()
    if total <= 0.0:
        return []
    centre = (parts.mass * parts.centre + parts.masses @ parts.places) / total
    inertia = parts.inertia + _around(parts, centre, parts.mass, parts.centre)
    found |= {f"inertia_{key[1:]}": float(inertia[i, j]) for key, i, j in _ELEMENTS}
    shift = np.where(np.abs(centre - parts.middle) < parts.rounding, 0.0, centre - parts.middle)
    found |= {f"centre_{a}": float(c) for a, c in zip("xyz", shift)}
    lags = _lags(document)
    up, down = lags or _DEFAULT_LAGS
    found["lag"] = float(np.sqrt(up * down))
    if abs(up / down - 1.0) < 0.01:
        return []
    said = "timeConstantUp and Down are" if lags else "timeConstantUp and Down are not set, so they are Gazebo's own"
    one = f"one lag of {1e3 * found['lag']:.3g} ms stands for both"
    return [f"{said} {1e3 * up:.3g} and {1e3 * down:.3g} ms; {one}"]


_DEFAULT_LAGS = (1.0 / 80.0, 1.0 / 40.0)  # s, defaults of the plugin


def _lags(document: XmlDocument) -> tuple[float, float] | None:
    path, model = _model(document)
    first = (*path, f"plugin[{_motors(model)[0]}]")
    up, down = (document.get((*first, key, "#")) for key in ("timeConstantUp", "timeConstantDown"))
    if up is None and down is None:
        return None
    return (_DEFAULT_LAGS[0] if up is None else up), (_DEFAULT_LAGS[1] if down is None else down)


def _around(parts: _Parts, centre: Array, mass: float, place: Array) -> Array:
    """Inertia of the masses of body and propellers about a common centre, to add to the body's own inertia."""
    found = parts.own + steiner(mass, place - centre)
    for m, r in zip(parts.masses, parts.places):
        found = found + steiner(float(m), r - centre)
    return np.asarray(found)


def _write_more(document: XmlDocument, name: str, c: Constants) -> None:
    path, model = _model(document)
    before, parts = _parts(document), _parts(XmlDocument(document.text, document.where))  # with the new arms
    matrix = inertia_of(c)
    if c.mass is None or matrix is None:
        return
    props = float(parts.masses.sum())
    if c.mass <= props:
        raise FileFormatError(f"{document.where}: the propellers alone weigh {props:g} kg, more than the whole drone")
    centre = parts.middle + np.array([c.or_(f"centre_{a}", 0.0) for a in "xyz"])
    place = (c.mass * centre - parts.masses @ parts.places) / (c.mass - props)
    inertial = (*path, f"link[{parts.body}]", "inertial")
    if np.abs(place - before.centre).max() > parts.rounding:
        link = _pose(model.all("link")[parts.body], document)[:3]
        document.put_vector((*inertial, "pose", "#"), [*(place - link), 0.0, 0.0, 0.0])
    rest = matrix - _around(parts, centre, c.mass - props, place)
    if np.linalg.eigvalsh(rest)[0] <= 0.0:
        raise FileFormatError(f"{document.where}: the propellers of this template leave the body no inertia of its own")
    for key, i, j in _ELEMENTS:
        if abs(rest[i, j] - before.inertia[i, j]) > NOTHING * rest.max():
            document.put((*inertial, "inertia", key, "#"), float(rest[i, j]))
    _write_lags(document, c)


def _write_lags(document: XmlDocument, c: Constants) -> None:
    if not c.lag:
        return
    path, model = _model(document)
    lags = _lags(document) or _DEFAULT_LAGS
    factor = c.lag / float(np.sqrt(lags[0] * lags[1]))
    if abs(factor - 1.0) < 1e-9:
        return
    for k in _motors(model):
        for key, value in zip(("timeConstantUp", "timeConstantDown"), lags):
            document.put((*path, f"plugin[{k}]", key, "#"), value * factor)


GAZEBO = Format(
    name="gazebo",
    order=40,
    suffix=".sdf",
    words="a Gazebo model (SDF)",
    open=XmlDocument,
    recognises=lambda text: "<sdf" in text and "motorConstant" in text,
    fields=_fields,
    skeleton=template("gazebo.sdf"),
    read_more=_read_more,
    write_more=_write_more,
    source="gz-sim, MulticopterMotorModel; crazyflie-simulation, gazebo/crazyflie/model.sdf",
)
