"""`crazyem import FILE... -o OUT.mcap`: convert recordings of any format to MCAP, without resampling or omissions."""

import argparse
from typing import Any

from crazyem.commands.batch import close, on_files
from crazyem.commands.files import find, read_options, targets
from crazyem.commands.output import Report, Result, remarks
from crazyem.recordings import ReadOptions, Recording, open_recording


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    report = Report(arguments)
    files = find(arguments.files, mapping=arguments.map)
    outputs = targets(files.found, arguments.output, ".mcap", force=arguments.force)
    options = read_options(arguments)
    on_files(arguments, report, files, convert, ((str(o), options, arguments.force) for o in outputs))
    return close(report, files)


def convert(path: str, output: str, options: ReadOptions, force: bool) -> Result:
    """Convert one file. Raises as `open_recording`; UsageError if the result cannot be written."""
    from crazyem.recordings.mcap.signals import write_recording

    recording = open_recording(path, options)
    write_recording(recording, output, replace=force)
    data = {"output": output, **summary(recording)}
    counts = f"{recording.duration:.2f} s, {len(recording.signals)} signals, {len(recording)} samples"
    text = f"{path} -> {output}: {recording.source}, {counts}"
    return Result(path, data, "\n".join([text, *remarks(recording.findings)]))


def summary(recording: Recording) -> dict[str, Any]:
    """Summary of the converted recording, for JSON."""
    return {
        "source": recording.source,
        "duration_s": recording.duration,
        "signals": {name: int(array.time.size) for name, array in recording.signals.items()},
        "samples": len(recording),
        "events": len(recording.events),
        "findings": [f.to_dict() for f in recording.findings],
    }
