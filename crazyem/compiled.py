"""`compiled`: numba's njit with a disk cache that notices an edit in any kernel, not only in the function's own file.

Numba stamps a cached function with the content of its own file; a kernel that calls kernels or reads layout
constants of another file would go on running old machine code after an edit there.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from crazyem.kernel_cache import kernel

FASTMATH = {"contract", "reassoc", "nsz"}  # lets dot products use vector registers; NaN keeps its meaning

_ROOT = Path(__file__).parent
# Folders with kernels, and the folders whose kernels those call: an edit in any of these calls for compiling again.
_CALLS = {
    "physics": ("physics",),
    "estimation": ("physics", "estimation"),
    "control": ("control",),
    "paper": ("control", "paper"),
    "diagnosis": ("physics", "estimation", "diagnosis"),
}


def _has_kernels(path: Path) -> bool:
    """Whether an edit there can change a kernel: it defines some, or the indices that they read."""
    return path.name == "layout.py" or "@compiled" in path.read_text(encoding="utf-8")


def _stamp(folders: tuple[str, ...]) -> tuple[tuple[str, int, int], ...]:
    kernels = (p for folder in folders for p in sorted((_ROOT / folder).rglob("*.py")) if _has_kernels(p))
    how = (Path(__file__), Path(__file__).with_name("kernel_cache.py"))  # these say how to compile
    return tuple((p.name, p.stat().st_mtime_ns, p.stat().st_size) for p in (*how, *kernels))


_STAMPS = {folder: _stamp(called) for folder, called in _CALLS.items()}


def compiled(function: Callable[..., Any]) -> Any:
    """Compile `function` (explicit loops over arrays): cached on disk, without the interpreter lock.

    A division by zero gives inf or NaN, as in numpy, and callers check what comes out; raising instead would put a
    branch at every division and cost a third of an update.
    """
    path = Path(function.__code__.co_filename)
    folder = path.relative_to(_ROOT).parts[0] if path.is_relative_to(_ROOT) else ""
    # a kernel elsewhere uses its own file only, which numba checks itself
    return kernel(function, stamp=_STAMPS.get(folder), fastmath=FASTMATH)
