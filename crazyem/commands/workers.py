"""Processes of this machine that share calls of one function; however their work ends, they end first.

A process and its parent share one pipe and nothing else: no queue or semaphore that a killed process could leave
behind, half written or locked. Modules that take long are imported by the work, not by this file.
"""

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Generator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from crazyem.errors import CrazyemError

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # in each process; processes share the cores


def shared(function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], count: int) -> Generator[Any, None, None]:
    """Values of `function(*task)` from `count` processes, in the order of the tasks, as they become known.

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
            for _ in range(count):
                _start(processes, links)
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
            for process, link in zip(processes, links, strict=True):
                if not finished:
                    process.kill()  # work that is not wanted any more is not waited for
                link.close()
                process.join()


def _start(processes: list[multiprocessing.process.BaseProcess], links: list[Connection]) -> None:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    with theirs:  # in the process alone, so that its end is the end of the pipe
        process = context.Process(target=_work, args=(theirs,), daemon=True)
        process.start()
    processes.append(process)
    links.append(ours)


def _work(link: Connection) -> None:
    """A process: does what it is sent until nothing more can come."""
    for name in _THREADS:
        os.environ.setdefault(name, "1")
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            function, task = link.recv()
            link.send(function(*task))


@contextlib.contextmanager
def _no_interrupts() -> Generator[None, None, None]:
    """Ctrl-C does nothing here, nor ever in processes started here, to which a terminal sends it too."""
    try:
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    except ValueError:  # not the main thread: no Ctrl-C comes here
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
