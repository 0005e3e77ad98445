"""One function over many files: in this process, in processes of this machine, or on a Dask cluster."""

import contextlib
import importlib
import os
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from crazyem.commands.output import Progress, Result
from crazyem.errors import CrazyemError, LinkError, UsageError

CONNECT_SECONDS = 10.0  # to a scheduler, and for its first worker


def each(
    function: Callable[..., Result],
    tasks: Sequence[tuple[Any, ...]],
    *,
    names: Sequence[str],
    what: str,
    jobs: int | None = None,
    cluster: str | None = None,
    unit: str = "files",
) -> Iterator[Result]:
    """Results of `function(*task)`, in the order of the tasks, as they become known; progress on standard error.

    Args:
        function: of a module, so that other processes can find it; returns a `Result`.
        tasks: arguments of one call each.
        names: the file of each task; a call that raises becomes a failed result of that name.
        what: the command, for progress.
        jobs: processes; None: one a core, but none for a single task.
        cluster: address of a Dask scheduler, whose workers see the same files under the same names.
        unit: what the tasks are, for progress.

    Raises: UsageError (no `distributed`, wrong address), LinkError (nothing answers there).
    """
    calls = [(function, task, name) for task, name in zip(tasks, names, strict=True)]
    with Progress(what, len(calls), unit) as progress, contextlib.ExitStack() as stack:
        for result in _results(calls, jobs, cluster, stack):
            progress.clear()
            yield result
            progress.step()


def processes(jobs: int | None, files: int) -> int:
    """How many files are worked on at a time: `jobs`, else one a core, and never more than there are."""
    return min(jobs or _cores(), files)


def _cores() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


def _results(calls: list[Any], jobs: int | None, cluster: str | None, stack: contextlib.ExitStack) -> Iterator[Result]:
    count = processes(jobs, len(calls))
    if cluster is None and count <= 1:
        return (_guarded(*call) for call in calls)
    return _parallel(calls, count, cluster, stack)


def _parallel(calls: list[Any], count: int, cluster: str | None, stack: contextlib.ExitStack) -> Iterator[Result]:
    import joblib

    if cluster is not None:
        _connect(cluster, stack)
        stack.enter_context(joblib.parallel_config("dask", wait_for_workers_timeout=CONNECT_SECONDS))
        count = -1
    pool = joblib.Parallel(n_jobs=count, return_as="generator")
    with _workers_deaf_to_interrupts():
        results = pool(joblib.delayed(_guarded)(*call) for call in calls)
    finished = False
    try:
        for result in results:  # noqa: UP028 (`yield from` would close `results` before the finally below can)
            yield result
        finished = True
    except CrazyemError:
        raise
    except TimeoutError as error:
        raise LinkError(f"the cluster at {cluster} has no worker ({error}).") from None
    except (OSError, RuntimeError) as error:  # joblib's TerminatedWorkerError is a RuntimeError of some kind
        died = "Terminated" in type(error).__name__ or "Broken" in type(error).__name__
        why = "out of memory? --jobs 1 needs the least" if died else f"{type(error).__name__}: {error}"
        raise CrazyemError(f"a worker process ended before its work was done ({why}).") from None
    finally:
        if not finished:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that work was cancelled is what was wanted
                results.close()
            if cluster is None:
                _end_workers()


@contextlib.contextmanager
def _workers_deaf_to_interrupts() -> Iterator[None]:
    """Processes started here ignore Ctrl-C, which the terminal sends to them too; this process deals with it."""
    try:
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    except ValueError:  # not the main thread: no Ctrl-C comes here
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _end_workers() -> None:
    """After Ctrl-C or an error: processes that still read are not waited for."""
    with contextlib.suppress(Exception):
        loky = importlib.import_module("joblib.externals.loky")
        loky.get_reusable_executor().shutdown(wait=False, kill_workers=True)


def _connect(address: str, stack: contextlib.ExitStack) -> None:
    try:
        distributed = importlib.import_module("distributed")
    except ImportError:
        raise UsageError("--cluster needs Dask: pip install 'crazyem[cluster]', here and on its workers.") from None
    if "://" not in address:
        address = f"tcp://{address}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            client = distributed.Client(address, timeout=CONNECT_SECONDS)
    except ValueError as error:
        raise UsageError(f"{address} is no address of a Dask scheduler ({error}).") from None
    except (OSError, TimeoutError) as error:
        first = str(error).split("\n", 1)[0] or type(error).__name__
        raise LinkError(f"no Dask scheduler answers at {address} ({first.rstrip('.')}).") from None
    stack.callback(client.close)


def _guarded(function: Callable[..., Result], task: tuple[Any, ...], name: str) -> Result:
    """One call; an error becomes a failed result, so that one file cannot stop an archive of thousands."""
    try:
        return function(*task)
    except CrazyemError as error:
        return Result(name, error=str(error), code=error.exit_code)
    except MemoryError:
        return Result(name, error=f"{name}: there is not enough memory to read it.", code=1)
    except Exception as error:
        if os.environ.get("CRAZYEM_DEBUG"):
            raise
        what = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        return Result(name, error=f"{name}: this should not happen, please report it ({what}).", code=1)
