"""Old names that work for one more release: each use gives a DeprecationWarning with the new name."""

import importlib
import warnings
from collections.abc import Callable, Mapping


def warn(old: str, new: str, *, level: int = 2) -> None:
    """Warn that `old` is deprecated and `new` replaces it.

    Args:
        old, new: names as a user writes them.
        level: frames up to the user's code; 2 is the caller of the function that warns.
    """
    warnings.warn(
        f"{old} is deprecated and will be removed in the next release: use {new}", DeprecationWarning, level + 1
    )


def moved(module: str, names: Mapping[str, str]) -> Callable[[str], object]:
    """A module's `__getattr__` for names that have moved or were renamed.

        __getattr__ = moved(__name__, {"old_name": "crazyem.new.place:new_name"})

    Args:
        module: of the old names.
        names: old name -> "module:name" of the new one.
    """

    def attribute(name: str) -> object:
        if name not in names:
            raise AttributeError(f"module '{module}' has no attribute '{name}'")
        where, _, new = names[name].partition(":")
        warn(f"{module}.{name}", f"{where}.{new}")
        return getattr(importlib.import_module(where), new)

    return attribute
