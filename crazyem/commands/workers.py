"""Worker processes of this machine that share the calls of one function; they always end before the caller goes on.

A process and its parent share only one pipe: a killed process could leave a queue half written or a semaphore locked.
Slow modules are imported by the work, not by this file.
"""

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Generator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from crazyem.errors import CrazyemError

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # 1 in each worker: workers share the cores


def shared(function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], count: int) -> Generator[Any, None, None]:
    """Yield the values of `function(*task)` from `count` processes, in the order of the tasks.

    Raises: CrazyemError (a process ended before its work was done).
    """
    processes: list[multiprocessing.process.BaseProcess] = []
    links: list[Connection] = []
    busy: dict[Any, int] = {}
    values: dict[int, Any] = {}
    left = iter(enumerate(tasks))

    def give(link: Connection) -> None:
        for number, task in left:
            link.send((function, task))
            busy[link] = number
            return

    finished = False
    try:
        with _no_interrupts():
            context = multiprocessing.get_context("spawn")
            for _ in range(count):
                ours, theirs = context.Pipe()
                with theirs:  # closed in the parent: the pipe then ends with the worker process
                    process = context.Process(target=_work, args=(theirs,), daemon=True)
                    process.start()
                processes.append(process)
                links.append(ours)
        try:
            for link in links:
                give(link)
            for number in range(len(tasks)):
                while number not in values:
                    for ready in wait(list(busy)):
                        assert isinstance(ready, Connection)
                        values[busy.pop(ready)] = ready.recv()
                        give(ready)
                yield values.pop(number)
        except (EOFError, ConnectionError):
            raise CrazyemError(
                "a worker process ended before its work was done (out of memory? --jobs 1 needs the least)."
            ) from None
        finished = True
    finally:
        with _no_interrupts():
            for worker, link in zip(processes, links, strict=True):
                if not finished:
                    worker.kill()  # the caller needs no further results, so do not wait
                link.close()
                worker.join()


def _work(link: Connection) -> None:
    """Main function of a worker: run received tasks until the pipe closes."""
    for name in _THREADS:
        os.environ.setdefault(name, "1")
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            function, task = link.recv()
            link.send(function(*task))


@contextlib.contextmanager
def _no_interrupts() -> Generator[None, None, None]:
    """Ignore Ctrl-C in this block, and always in processes started here: a terminal sends Ctrl-C to them, too."""
    try:
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    except ValueError:  # not the main thread, which alone receives Ctrl-C
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
