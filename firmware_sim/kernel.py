"""`kernel`: numba's njit for this package, with a cache that becomes invalid when any file of the package changes.

Numba checks only the file that contains a cached function. Our kernels call kernels and read index constants of other
files: after an edit there, numba alone would use old machine code.
"""

import contextlib
from pathlib import Path
from typing import Any

from numba import njit

_ROOT = Path(__file__).parent
_FOLDERS = ("plant", "controllers", "commander")
_SOURCES = [Path(__file__), _ROOT / "contents.py"]
_SOURCES += sorted(p for folder in _FOLDERS for p in (_ROOT / folder).rglob("*.py"))
_STAMP = tuple((p.name, p.stat().st_mtime_ns, p.stat().st_size) for p in _SOURCES)


def kernel(function: Any) -> Any:
    """Compile `function` (explicit loops over flat arrays): cached on disk, without the interpreter lock.

    Division by zero gives infinity as in C, not an exception.
    """
    dispatcher: Any = njit(cache=True, nogil=True, error_model="numpy")(function)
    with contextlib.suppress(AttributeError):  # private to numba; without it the cache checks only the own file
        dispatcher._cache._cache_file._source_stamp = _STAMP
    return dispatcher
