"""`compiled`: numba's njit with a disk cache, and one machine code for all processes: same input, same bits.

A kernel's library holds a copy of every kernel that it calls. LLVM leaves these copies as weak symbols: where another
library of the process has a function of the same name, the linker calls that one instead, and both are optimised
differently. Numbers would then differ in the last bit by which kernel a process compiled or loaded first. Here a
library keeps its copies to itself. Compiling is deterministic, so code compiled now is the code loaded later.

Numba stamps a cached function with the content of its own file; a kernel that calls kernels or reads layout constants
of another file would go on running old machine code after an edit there. `compiled` notices an edit in any kernel.
"""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from numba import njit
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder

try:
    import fcntl
except ImportError:  # Windows: two processes that compile one kernel at once may both write its index
    fcntl = None  # type: ignore[assignment]

_KERNELS: list[Any] = []


class _SeparateLibrary(JITCodeLibrary):
    """Machine code in which calls between kernels are bound: other kernels may link its bitcode, not its symbols."""

    def _finalize_final_module(self) -> None:
        linkable = self._final_module.clone()  # as numba makes it when another kernel wants to inline this one
        _relink(linkable, "external", "linkonce_odr")
        self._shared_module = linkable
        _relink(self._final_module, "linkonce_odr", "internal")
        super()._finalize_final_module()


def _relink(module: Any, old: str, new: str) -> None:
    for function in module.functions:
        if not function.is_declaration and function.linkage.name == old:
            function.linkage = new


class _Compiler(CompilerBase):  # numba's way to customise compilation
    def define_pipelines(self) -> list[Any]:
        self.state.library = _SeparateLibrary(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        self.state.library.enable_object_caching()
        return [DefaultPassBuilder.define_nopython_pipeline(self.state)]


def kernel(function: Callable[..., Any], stamp: object = None, **options: Any) -> Any:
    """Compile `function` (explicit loops over arrays): cached on disk, without the interpreter lock.

    `stamp`: what the cache is compared by (picklable); None is numba's own, the content of the function's file.
    `options`: of `numba.njit`. A division by zero gives inf or NaN, as in numpy and C.
    """
    dispatcher: Any = njit(cache=True, nogil=True, error_model="numpy", pipeline_class=_Compiler, **options)(function)
    _KERNELS.append(dispatcher)
    with contextlib.suppress(AttributeError):  # private to numba; without it caching works, only less watchful
        cache = dispatcher._cache
        if stamp is not None:
            cache._cache_file._source_stamp = stamp
        cache._cache_file.save = _alone(cache._cache_file.save, Path(cache._cache_file._index_path))
    return dispatcher


def _alone(save: Callable[..., None], index: Path) -> Callable[..., None]:
    """`save`, one process at a time: it reads the index of a kernel's signatures and writes the index with one more."""

    def save_alone(key: Any, data: Any) -> None:
        with _locked(index.with_suffix(".lock")):
            save(key, data)

    return save_alone


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    if fcntl is None:
        yield
        return
    with path.open("wb") as file:  # closing the file unlocks it
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def compilations() -> int:
    """How many kernels this process has compiled, because the disk did not have them."""
    stats = (k.stats for k in _KERNELS if hasattr(k, "stats"))
    return sum(sum(s.cache_misses.values()) for s in stats)


FASTMATH = {"contract", "reassoc", "nsz"}  # lets dot products use vector registers; NaN keeps its meaning

_ROOT = Path(__file__).parent
# Folders with kernels, and the folders whose kernels those call: an edit in any of these calls for compiling again.
_CALLS = {
    "physics": ("physics",),
    "estimation": ("physics", "estimation"),
    "control": ("control",),
    "planning": ("planning",),
    "paper": ("control", "paper"),
    "diagnosis": ("physics", "estimation", "diagnosis"),
    "monitoring": ("physics", "estimation", "monitoring"),
}


def _has_kernels(path: Path) -> bool:
    """Whether an edit there can change a kernel: it defines some, or the indices that they read."""
    return path.name == "layout.py" or "@compiled" in path.read_text(encoding="utf-8")


def _stamp(folders: tuple[str, ...]) -> tuple[tuple[str, int, int], ...]:
    kernels = (p for folder in folders for p in sorted((_ROOT / folder).rglob("*.py")) if _has_kernels(p))
    return tuple((p.name, p.stat().st_mtime_ns, p.stat().st_size) for p in (Path(__file__), *kernels))


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
