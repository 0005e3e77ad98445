"""All formats by name, and recognition of a text's format. Every `Format` in a module of `formats/` is registered."""

import importlib
import pkgutil
from collections.abc import Iterable

from crazyem.errors import FileFormatError, UsageError
from crazyem.simulators.fields import Format
from crazyem.simulators.formats.rotorpy import ROTORPY_JSON

OWN = "crazyem"  # a vehicle file


def discover(paths: Iterable[str], package: str = "") -> dict[str, Format]:
    """Every `Format` in the modules of some folders, sorted by `order` and name.

    Args:
        paths: folders.
        package: dotted name of the package of these folders; empty: top level.
    """
    modules = pkgutil.iter_modules(list(paths), f"{package}." if package else "")
    found = [v for m in modules for v in vars(importlib.import_module(m.name)).values() if isinstance(v, Format)]
    return {form.name: form for form in sorted(found, key=lambda form: (form.order, form.name))}


_FOLDER = importlib.import_module("crazyem.simulators.formats")
FORMATS = discover(_FOLDER.__path__, _FOLDER.__name__)
NAMES = (*(n for n in FORMATS if n != ROTORPY_JSON.name), OWN)


def format_named(name: str) -> Format:
    """A format by its name. Raises UsageError for an unknown one."""
    if name not in FORMATS:
        raise UsageError(f"unknown format '{name}' (known: {', '.join(NAMES)}).")
    return FORMATS[name]


def format_of(text: str, *, where: str) -> str:
    """The name of a text's format, `OWN` for a vehicle file.

    Raises: FileFormatError if no format fits.
    """
    for form in FORMATS.values():
        if form.recognises(text):
            return form.name
    if "cmd_f_coef" in text or "rpy_coef" in text:
        raise FileFormatError(
            f"{where}: a fitted closed-loop model of crazyflow holds no physical constants; fit it to flights instead"
        )
    if "thrust2torque" in text and "mass_thrust" in text:
        raise FileFormatError(f"{where}: gains of crazyflow's controller, not constants of a drone")
    if any(line.split("=")[0].strip() == "mass" for line in text.splitlines()) and "inertia" in text:
        return OWN
    raise FileFormatError(f"{where}: no file of a known simulator ({', '.join(NAMES)})")
