"""Optional dependencies: which extra of the package installs a module, and one sentence where the module is missing."""

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
    """A library is not installed that an optional part of the package needs; the message has the pip line."""


def installed(module: str) -> bool:
    """Whether a library can be imported, without importing it."""
    return sys.modules.get(module, "") is not None and importlib.util.find_spec(module) is not None


def require(module: str, purpose: str) -> ModuleType:
    """Import a library of an extra.

    Args:
        module: dotted name, such as "matplotlib.figure".
        purpose: what needs the library, as the beginning of a sentence: "A plot".

    Raises:
        MissingExtraError: the library is not installed.
    """
    top = module.partition(".")[0]
    extra = next(name for name, modules in EXTRAS.items() if top in modules)
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != top:
            raise  # the library is there, and lacks something of its own
        raise MissingExtraError(
            f"{purpose} needs {top}, which is not installed: pip install 'crazyem[{extra}]'."
        ) from None
