"""The catalogue of effects: every effect by its name, in the order in which effects are applied.

The catalogue is built from the modules of this folder. An `Effect` that a module defines needs no registration.
"""

import importlib
import pkgutil
from collections.abc import Iterable
from typing import Any

from crazyem.errors import FileFormatError
from crazyem.physics import effects as folder
from crazyem.physics.effects.effect import Effect, Effects, Parameter


def discover(paths: Iterable[str], package: str = "") -> dict[str, Effect]:
    """Every effect that the modules of some folders define, by `order` and name.

    Args:
        paths: folders.
        package: dotted name of the package of these folders; empty: top level.

    Raises:
        ValueError: two different effects have the same name.
    """
    found: dict[str, Effect] = {}
    for module in pkgutil.iter_modules(list(paths), f"{package}." if package else ""):
        if module.name == __name__:
            continue
        for value in vars(importlib.import_module(module.name)).values():
            if isinstance(value, Effect) and found.setdefault(value.name, value) is not value:
                raise ValueError(f"two effects are called {value.name}")
    return {effect.name: effect for effect in sorted(found.values(), key=lambda e: (e.order, e.name))}


CATALOGUE: dict[str, Effect] = discover(folder.__path__, folder.__name__)


def check_effects(effects: Effects, *, where: str) -> None:
    """Refuse unknown effects, unknown parameters, and values that are not allowed.

    Args:
        effects: effect -> parameter -> value.
        where: name of the file, for the message.

    Raises:
        FileFormatError: one sentence that names the file, the effect and the parameter.
    """
    for name, values in effects.items():
        if name not in CATALOGUE:
            raise FileFormatError(f"{where}: unknown effect '{name}' (known: {', '.join(CATALOGUE)})")
        known = {p.name: p for p in CATALOGUE[name].parameters}
        for key, value in values.items():
            if key not in known:
                raise FileFormatError(f"{where}: effect '{name}' has no parameter '{key}' (known: {', '.join(known)})")
            problem = _problem(known[key], value)
            if problem:
                raise FileFormatError(f"{where}: parameter '{key}' of effect '{name}' must be {problem}, got {value!r}")


def _problem(parameter: Parameter, value: Any) -> str:
    """Description of the allowed values, or "" if the value is allowed."""
    if parameter.among:
        listed = isinstance(value, list | tuple) and 0 < len(value) <= len(parameter.among)
        return (
            "" if listed and all(v in parameter.among for v in value) else f"a list of some of {list(parameter.among)}"
        )
    if parameter.chosen:
        return "" if value in parameter.chosen and not isinstance(value, bool) else f"one of {list(parameter.chosen)}"
    if value is None and parameter.neutral is None:
        return ""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if number and parameter.low <= value <= parameter.high:
        return ""
    return f"a number in [{parameter.low:g}, {parameter.high:g}]"
