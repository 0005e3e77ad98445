"""`crazyem info FILE...`: what is in recordings, how hard they flew, what could be identified from them."""

import argparse
from pathlib import Path

from crazyem.commands.batch import each, processes
from crazyem.commands.files import find, read_options
from crazyem.commands.merge import merge_inventories
from crazyem.commands.output import Report, Result
from crazyem.physics import folding
from crazyem.recordings import ReadOptions, open_recording
from crazyem.recordings.parts import can_be_parted, is_large, open_parts


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    report = Report(arguments)
    if arguments.vehicle:
        folding.load(arguments.vehicle)  # a mistake in it is one error, not one for each file
    files = find(arguments.files, mapping=arguments.map)
    options = read_options(arguments)
    tasks = [
        (
            str(f.path),
            options,
            arguments.vehicle,
            arguments.parts,
            processes(arguments.jobs, len(files.found)),
            arguments.all,
        )
        for f in files.found
    ]
    names = [str(f.path) for f in files.found]
    for number, result in enumerate(
        each(inspect, tasks, names=names, what="info", jobs=arguments.jobs, cluster=arguments.cluster)
    ):
        if number:
            report.say("")
        report.add(result)
    if len(files.found) > 1 or files.skipped:
        report.say(f"\n{counted(report.results, files.skipped)}")
    return report.close(skipped_files=files.skipped)


def inspect(path: str, options: ReadOptions, vehicle: str | None, parts: bool, jobs: int, everything: bool) -> Result:
    """One file. Raises as `open_recording`."""
    from crazyem.doctor.inventory import inventory

    drone = folding.load(vehicle) if vehicle else None
    large = parts or is_large(Path(path), jobs=jobs)
    if large and can_be_parted(Path(path)):
        found = merge_inventories(inventory(part, drone) for part in open_parts(path, options))
    else:
        found = inventory(open_recording(path, options), drone)
    return Result(path, found.to_dict(), found.text(everything=everything))


def counted(results: list[Result], skipped: int) -> str:
    """How many files were read, failed and passed over, in one line."""
    failed = sum(bool(r.error) for r in results)
    parts = [f"{len(results) - failed} recordings"]
    if failed:
        parts.append(f"{failed} could not be read")
    if skipped:
        parts.append(f"{skipped} other files skipped")
    return ", ".join(parts)
