"""`crazyem export FILE... -o OUT.csv|OUT.parquet`: write recordings as tables, without resampling."""

import argparse

from crazyem.commands.batch import close, on_files, processes
from crazyem.commands.files import find, read_options, targets
from crazyem.commands.output import Report, Result, remarks
from crazyem.errors import UsageError
from crazyem.recordings import ReadOptions, open_recording
from crazyem.recordings.export import EXPORT_SUFFIXES, METADATA_SUFFIX, export, export_parts
from crazyem.recordings.registry import open_parts, to_be_parted


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    report = Report(arguments)
    files = find(arguments.files, mapping=arguments.map)
    suffix = f".{arguments.format or 'csv'}"
    outputs = targets(files.found, arguments.output, suffix, force=arguments.force)
    for output in outputs:
        if output.suffix.lower() not in EXPORT_SUFFIXES:
            raise UsageError(f"{output}: an export ends in {' or '.join(EXPORT_SUFFIXES)}.")
        if arguments.format and output.suffix.lower() != suffix:
            raise UsageError(f"{output} does not end in {suffix}, which --format asks for.")
    options = read_options(arguments)
    jobs = processes(arguments.jobs, len(files.found))
    rests = ((str(o), options, arguments.force, arguments.parts, jobs) for o in outputs)
    on_files(arguments, report, files, convert, rests)
    return close(report, files)


def convert(path: str, output: str, options: ReadOptions, force: bool, parts: bool, jobs: int) -> Result:
    """Convert one file. Raises as `open_recording`; UsageError if the result cannot be written."""
    if to_be_parted(path, asked=parts, jobs=jobs):
        description = export_parts(lambda: open_parts(path, options), output, force=force)
    else:
        description = export(open_recording(path, options), output, force=force)
    written = [output]
    if output.lower().endswith(".csv"):
        written.append(output + METADATA_SUFFIX)
    names = [entry.name for entry in description.entries]
    data = {
        "output": written,
        "source": description.source,
        "signals": names,
        "columns": ["time", "host_time", *(c.name for c in description.columns)],
        "findings": [f.to_dict() for f in description.findings],
    }
    text = (
        f"{path} -> {', '.join(written)}: {description.source}, {len(names)} signals in {len(data['columns'])} columns"
    )
    return Result(path, data, "\n".join([text, *remarks(description.findings)]))
