"""`crazyem recover BROKEN.mcap -o OUT.mcap`: copy every complete chunk of a damaged MCAP file to a valid one."""

import argparse
import os

from crazyem.commands.output import Report, Result
from crazyem.errors import CrazyemError, UsageError


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    from crazyem.recordings.mcap.recover import recover

    report = Report(arguments)
    source, target = arguments.file, arguments.output
    if os.path.realpath(source) == os.path.realpath(target):
        raise UsageError(f"{target} is the broken file itself; it is never written in place.")
    if os.path.isdir(target):
        raise UsageError(f"cannot write {target}: it is a folder.")
    try:
        found = recover(source, target, replace=arguments.force)
    except CrazyemError as error:
        result = Result(source, error=str(error), code=error.exit_code)
    else:
        result = Result(source, {"output": target, **found.to_dict()}, f"{source} -> {target}\n{found}")
    report.add(result)
    return report.close()
