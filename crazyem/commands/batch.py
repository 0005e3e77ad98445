"""Apply one function to many files: in this process, in processes of this machine, or on a Dask cluster."""

import argparse
import contextlib
import os
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from crazyem.commands.files import Files
from crazyem.commands.output import Progress, Report, Result
from crazyem.commands.workers import shared
from crazyem.errors import CrazyemError, LinkError, UsageError
from crazyem.extras import require

CONNECT_SECONDS = 10.0  # s: time limit to connect to a scheduler, and to wait for its first worker


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
    """Yield the results of `function(*task)` in the order of the tasks; progress goes to standard error.

    Args:
        function: at module level, so that other processes can import it.
        names: the file of each task; a call that raises becomes a failed result of that name.
        what, unit: name of the command, and plural noun for the tasks, for progress.
        jobs: processes; None: one per core, but none for a single task.
        cluster: address of a Dask scheduler, whose workers see the same files under the same names.

    Raises: UsageError (no `distributed`, wrong address), LinkError (nothing answers there).
    """
    calls = [(function, task, name) for task, name in zip(tasks, names, strict=True)]
    with Progress(what, len(calls), unit) as progress, contextlib.ExitStack() as stack:
        for result in _results(calls, jobs, cluster, stack):
            progress.clear()
            yield result
            progress.step()


def on_files(
    arguments: argparse.Namespace,
    report: Report,
    files: Files,
    work: Callable[..., Result],
    rests: Iterable[tuple[Any, ...]],
    *,
    apart: bool = False,
) -> None:
    """Call `work(path, *rest)` for each file and rest, by --jobs and --cluster, and add the results to the report.

    apart: whether to put an empty line between two results.
    """
    names = [str(f.path) for f in files.found]
    tasks = [(name, *rest) for name, rest in zip(names, rests)]
    results = each(work, tasks, names=names, what=arguments.command, jobs=arguments.jobs, cluster=arguments.cluster)
    for number, result in enumerate(results):
        if apart and number:
            report.say("")
        report.add(result)


def close(report: Report, files: Files, *, apart: bool = False) -> int:
    """Print the count of files if there are several, write the JSON and return the exit code."""
    if len(files.found) > 1 or files.skipped:
        report.say(("\n" if apart else "") + counted(report.results, files.skipped))
    return report.close(skipped_files=files.skipped)


def counted(results: Sequence[Result], skipped: int) -> str:
    """One line with the numbers of files that were read, failed and skipped."""
    failed = sum(bool(r.error) for r in results)
    parts = [f"{len(results) - failed} recordings"]
    if failed:
        parts.append(f"{failed} could not be read")
    if skipped:
        parts.append(f"{skipped} other files skipped")
    return ", ".join(parts)


def processes(jobs: int | None, files: int) -> int:
    """Number of files processed in parallel: `jobs`, else one per core, and never more than `files`."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(jobs or cores, files)


def _results(calls: list[Any], jobs: int | None, cluster: str | None, stack: contextlib.ExitStack) -> Iterator[Result]:
    if cluster is not None:
        return _on_cluster(calls, cluster, stack)
    count = processes(jobs, len(calls))
    if count <= 1:
        return (_guarded(*call) for call in calls)
    return stack.enter_context(contextlib.closing(shared(_guarded, calls, count)))


def _on_cluster(calls: list[Any], address: str, stack: contextlib.ExitStack) -> Iterator[Result]:
    client = _connect(address, stack)
    try:
        client.wait_for_workers(1, timeout=CONNECT_SECONDS)
        futures = deque(client.map(_guarded, *zip(*calls, strict=True), pure=False))
        while futures:
            yield futures.popleft().result()
    except TimeoutError:
        raise LinkError(f"the cluster at {address} has no worker.") from None
    except Exception as error:  # `_guarded` catches errors of the work; this is a killed worker or lost scheduler
        what = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise CrazyemError(f"the cluster at {address} ended before its work was done ({what}).") from None


def _connect(address: str, stack: contextlib.ExitStack) -> Any:
    distributed = require("distributed", "--cluster")
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
    return client


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
