"""Threads that share independent work: kernels release the interpreter lock, so two threads use two cores."""

import contextvars
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Generic, TypeVar

from crazyem.errors import UsageError

T = TypeVar("T")
R = TypeVar("R")
MOST = 64  # threads
_depth: contextvars.ContextVar[int] = contextvars.ContextVar("depth", default=0)  # nesting depth of shared work


class Workers:
    """Maps functions over items with up to `jobs` threads; results in order, the same for any number of threads.

    Calls may be nested: idle threads help with inner work, and no thread waits for work that has not begun.

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
        # the calling thread works, too
        self._pool = ThreadPoolExecutor(jobs - 1, "crazyem-diagnose") if jobs > 1 else None
        self._changed = threading.Condition()
        self._open: list[_Shared[Any, Any]] = []

    def map(self, function: Callable[[T], R], items: Iterable[T]) -> list[R]:
        """The results of `function` for each item; a call must not change data that another call reads.

        Raises: the exception of `function` for the first item that failed.
        """
        items = list(items)
        if self._pool is None or len(items) < 2:
            return [function(item) for item in items]
        shared = _Shared(function, items, self._changed)
        with self._changed:
            self._open.append(shared)
            self._changed.notify_all()
        helpers = [self._pool.submit(shared.work) for _ in range(min(self.jobs, len(items)) - 1)]
        try:
            shared.work()
            self._help_until_done(shared)
        finally:  # after an interrupt by the user, no thread takes the rest
            shared.stop()
            for helper in helpers:
                helper.cancel()
            with self._changed:
                self._open.remove(shared)
        return shared.results()

    def _help_until_done(self, shared: "_Shared[Any, Any]") -> None:
        """Wait for the threads at the last items, and help with inner work that they share."""
        while True:
            with self._changed:
                while shared.busy and not (inner := [o for o in self._open if o.depth > shared.depth and o.left]):
                    self._changed.wait()
                if not shared.busy:
                    return
            inner[-1].work()


class _Shared(Generic[T, R]):
    """Items that several threads take one after the other, in the context of the calling thread, which contains the
    error state of numpy (overflow)."""

    def __init__(self, function: Callable[[T], R], items: list[T], changed: threading.Condition) -> None:
        self._function, self._items, self._changed = function, items, changed
        self.depth = _depth.get() + 1  # 1: called outside of shared work
        self.left, self.busy = len(items), 0
        self._context = contextvars.copy_context()
        self._context.run(_depth.set, self.depth)
        self._done: dict[int, R] = {}
        self._failed: dict[int, Exception] = {}

    def work(self) -> None:
        """Take items until none is left."""
        self._context.copy().run(self._work)

    def _work(self) -> None:
        while (i := self._take()) is not None:
            try:
                self._done[i] = self._function(self._items[i])
            except Exception as error:  # raised by `results`
                self._failed[i] = error
            finally:
                with self._changed:
                    self.busy -= 1
                    self._changed.notify_all()

    def _take(self) -> int | None:
        with self._changed:
            if not self.left:
                return None
            self.left -= 1
            self.busy += 1
            return len(self._items) - 1 - self.left

    def stop(self) -> None:
        """Let no thread take another item."""
        with self._changed:
            self.left = 0

    def results(self) -> list[R]:
        """All results, after all threads have finished."""
        if self._failed:
            raise self._failed[min(self._failed)]
        return [self._done[i] for i in range(len(self._items))]
