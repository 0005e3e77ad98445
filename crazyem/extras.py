"""Optional dependencies: the extra of the package that installs a module, and the error if the module is missing."""

import importlib
import importlib.util
import sys
from types import ModuleType

from crazyem.errors import UsageError

# extra of pyproject.toml -> modules that come with it; a test compares the two
EXTRAS: dict[str, tuple[str, ...]] = {
    "formats": ("rosbags", "pyulog"),
    "plots": ("matplotlib", "jinja2"),
    "live": ("rich", "foxglove"),
    "cluster": ("distributed",),
    "simulators": ("tomlkit", "ruamel"),
}


class MissingExtraError(UsageError):
    """A library for an optional part of the package is not installed; the message has the pip command."""


def installed(module: str) -> bool:
    """Whether a library can be imported, without importing it."""
    return sys.modules.get(module, "") is not None and importlib.util.find_spec(module) is not None


def require(module: str, purpose: str) -> ModuleType:
    """Import a library of an extra.

    Args:
        module: dotted name, such as "matplotlib.figure".
        purpose: use of the library, as the subject of a sentence: "A plot".

    Raises:
        MissingExtraError: the library is not installed.
    """
    top = module.partition(".")[0]
    extra = next(name for name, modules in EXTRAS.items() if top in modules)
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != top:
            raise  # the library is installed, but one of its own dependencies is missing
        raise MissingExtraError(
            f"{purpose} needs {top}, which is not installed: pip install 'crazyem[{extra}]'."
        ) from None
