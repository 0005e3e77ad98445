"""Threads that share independent work: the kernels release the interpreter lock, so two of them use two cores."""

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from crazyem.errors import UsageError

T = TypeVar("T")
R = TypeVar("R")
MOST = 64

_busy = threading.local()  # .inside: this thread is one of a pool's; what it starts itself it also does itself


class Workers:
    """Maps functions over items with up to `jobs` threads; results in order, the same for any number of threads.

    Args:
        jobs: threads; None: one for each core that this process may use.

    Raises:
        UsageError: not between 1 and 64.
    """

    def __init__(self, jobs: int | None = None) -> None:
        if jobs is None:
            jobs = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
            jobs = min(jobs, MOST)
        if not 1 <= jobs <= MOST:
            raise UsageError(f"--jobs must lie between 1 and {MOST}, not {jobs}.")
        self.jobs = jobs
        self._pool: ThreadPoolExecutor | None = None

    def map(self, function: Callable[[T], R], items: Iterable[T]) -> list[R]:
        """What `function` gives for each item; it must not change what another item's call reads."""
        items = list(items)
        if self.jobs == 1 or len(items) < 2 or getattr(_busy, "inside", False):
            return [function(item) for item in items]
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self.jobs, "crazyem-diagnose", initializer=_enter)
        return list(self._pool.map(function, items))


def _enter() -> None:
    _busy.inside = True
