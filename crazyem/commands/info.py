"""`crazyem info FILE...`: content of recordings, flight envelope, and identifiable parameters."""

import argparse
from itertools import repeat

from crazyem.commands.batch import close, on_files, processes
from crazyem.commands.files import find, read_options
from crazyem.commands.merge import merge_inventories
from crazyem.commands.output import Report, Result
from crazyem.physics import folding
from crazyem.recordings import ReadOptions, open_recording
from crazyem.recordings.registry import open_parts, to_be_parted


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    report = Report(arguments)
    if arguments.vehicle:
        folding.load(arguments.vehicle)  # raises here, so that a wrong vehicle gives one error, not one per file
    files = find(arguments.files, mapping=arguments.map)
    options = read_options(arguments)
    jobs = processes(arguments.jobs, len(files.found))
    rest = (options, arguments.vehicle, arguments.parts, jobs, arguments.all)
    on_files(arguments, report, files, inspect, repeat(rest), apart=True)
    return close(report, files, apart=True)


def inspect(path: str, options: ReadOptions, vehicle: str | None, parts: bool, jobs: int, everything: bool) -> Result:
    """The inventory of one file. Raises as `open_recording`."""
    from crazyem.doctor.inventory import inventory

    drone = folding.load(vehicle) if vehicle else None
    if to_be_parted(path, asked=parts, jobs=jobs):
        found = merge_inventories(inventory(part, drone) for part in open_parts(path, options))
    else:
        found = inventory(open_recording(path, options), drone)
    return Result(path, found.to_dict(), found.text(everything=everything))
