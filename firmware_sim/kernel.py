"""`kernel`: numba's njit for this package, with a cache that notices edits in any file, not only in the function's own.

Numba stamps a cached function with the content of the file it is written in. Our kernels call kernels of
other files and read index constants of other files, so an edit there would silently leave old machine code in use.
"""

from pathlib import Path
from typing import Any

import kernel_cache

_ROOT = Path(__file__).parent
_FOLDERS = ("plant", "controllers", "commander")
_SOURCES = [Path(__file__), Path(kernel_cache.__file__), _ROOT / "contents.py"]  # the first two say how to compile
_SOURCES += sorted(p for folder in _FOLDERS for p in (_ROOT / folder).rglob("*.py"))
_STAMP = tuple((p.name, p.stat().st_mtime_ns, p.stat().st_size) for p in _SOURCES)


def kernel(function: Any) -> Any:
    """Compile `function` (explicit loops over flat arrays): cached on disk, without the interpreter lock.

    Division by zero gives infinity as in C, not an exception.
    """
    return kernel_cache.kernel(function, stamp=_STAMP)
