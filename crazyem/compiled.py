"""`compiled`: numba's njit with a disk cache and the same machine code in all processes: same input, same bits.

A kernel's library holds a copy of every kernel that it calls. LLVM leaves these copies as weak symbols. If another
library of the process has a function of the same name, the linker may call that function, which is optimised
differently. The last bit of results would then depend on the order in which kernels are compiled or loaded. Here the
copies of a library are private. Compiling is deterministic, so compiled and loaded code are equal.

Numba stamps a cached function with its own file only. A kernel that calls kernels or reads layout constants of another
file would keep old machine code after an edit of that file. `compiled` notices an edit of any kernel.
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
    """Machine code with private copies of the called kernels: other kernels may link its bitcode, not its symbols."""

    def _finalize_final_module(self) -> None:
        linkable = self._final_module.clone()  # numba makes this copy, too, when another kernel inlines this one
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

    `stamp`: the cache is valid while this value is equal (picklable); None is numba's stamp of the function's file.
    `options`: of `numba.njit`. A division by zero gives inf or NaN, as in numpy and C.
    """
    dispatcher: Any = njit(cache=True, nogil=True, error_model="numpy", pipeline_class=_Compiler, **options)(function)
    _KERNELS.append(dispatcher)
    with contextlib.suppress(AttributeError):  # private names of numba; without them the cache works, but misses edits
        cache = dispatcher._cache
        if stamp is not None:
            cache._cache_file._source_stamp = stamp
        cache._cache_file.save = _alone(cache._cache_file.save, Path(cache._cache_file._index_path))
    return dispatcher


def _alone(save: Callable[..., None], index: Path) -> Callable[..., None]:
    """`save` under a lock, because it reads the index of a kernel's signatures and writes it with one more entry."""

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
    """Number of kernels that this process has compiled because they were not in the disk cache."""
    stats = (k.stats for k in _KERNELS if hasattr(k, "stats"))
    return sum(sum(s.cache_misses.values()) for s in stats)


FASTMATH = {"contract", "reassoc", "nsz"}  # lets dot products use vector registers; NaN keeps its meaning

_ROOT = Path(__file__).parent
# Folders with kernels, and the folders of the kernels that they call: an edit in these requires a new compilation.
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
    """Whether an edit of this file can change a kernel: it defines kernels, or the indices that kernels read."""
    return path.name == "layout.py" or "@compiled" in path.read_text(encoding="utf-8")


def _stamp(folders: tuple[str, ...]) -> tuple[tuple[str, int, int], ...]:
    kernels = (p for folder in folders for p in sorted((_ROOT / folder).rglob("*.py")) if _has_kernels(p))
    return tuple((p.name, p.stat().st_mtime_ns, p.stat().st_size) for p in (Path(__file__), *kernels))


_STAMPS = {folder: _stamp(called) for folder, called in _CALLS.items()}


def compiled(function: Callable[..., Any]) -> Any:
    """Compile `function` (explicit loops over arrays): cached on disk, without the interpreter lock.

    A division by zero gives inf or NaN, as in numpy, and callers check the results. Raising would put a branch at
    every division and cost a third of an update.
    """
    path = Path(function.__code__.co_filename)
    folder = path.relative_to(_ROOT).parts[0] if path.is_relative_to(_ROOT) else ""
    # a kernel of another folder uses only its own file, which numba checks
    return kernel(function, stamp=_STAMPS.get(folder), fastmath=FASTMATH)
