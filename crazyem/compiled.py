"""`compiled`: numba's njit with a disk cache that notices an edit in any kernel, not only in the function's own file.

Numba stamps a cached function with the modification time of its own file; a kernel that calls kernels or reads layout
constants of another file would go on running old machine code after an edit there.
"""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

FASTMATH = {"contract", "reassoc", "nsz"}  # lets dot products use vector registers; NaN keeps its meaning

_ROOT = Path(__file__).parent
_KERNELS = tuple(_ROOT / folder for folder in ("physics", "estimation"))  # kernels here call each other across files
_STAMP = tuple(
    (path.name, path.stat().st_mtime_ns, path.stat().st_size)
    for folder in _KERNELS
    for path in sorted(folder.rglob("*.py"))
)


def compiled(function: Callable[..., Any]) -> Any:
    """Compile `function` (explicit loops over arrays): cached on disk, without the interpreter lock."""
    dispatcher: Any = njit(cache=True, nogil=True, fastmath=FASTMATH)(function)
    if not any(folder in Path(function.__code__.co_filename).parents for folder in _KERNELS):
        return dispatcher  # a kernel elsewhere uses its own file only, whose time numba checks itself
    with contextlib.suppress(AttributeError):  # private to numba; without it caching works, only less watchful
        dispatcher._cache._cache_file._source_stamp = _STAMP
    return dispatcher
