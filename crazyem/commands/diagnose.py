"""`crazyem diagnose RECORDING...`: differences of simulation and recording, the missing physics, and the fit."""

import argparse
import sys
import time
from pathlib import Path

from crazyem.atomic_file import write_file
from crazyem.commands.files import read_options
from crazyem.commands.output import deliver, names_in
from crazyem.live.summary import check_writable


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    from crazyem.api.diagnosing import diagnose
    from crazyem.diagnosis.report.content import text_of

    for path in (arguments.json, arguments.report, arguments.write_vehicle):
        check_writable(path)
    if arguments.method:
        sys.stderr.write("diagnose: --method is deprecated and changes nothing: there is one method.\n")
    begin = time.monotonic()

    def say(text: str) -> None:
        # one write, so that lines of several threads do not mix
        sys.stderr.write(f"diagnose: {time.monotonic() - begin:5.1f} s  {text}\n")
        sys.stderr.flush()

    found = diagnose(
        arguments.files,
        arguments.vehicle,
        held_out=arguments.held_out,
        baseline=arguments.baseline,
        against=arguments.against,
        candidates=names_in(arguments.candidates),
        withhold=arguments.withhold,
        strict_held_out=arguments.strict_held_out,
        jobs=arguments.jobs,
        options=read_options(arguments),
        progress=say,
    )
    document = {**found.document, "seconds": time.monotonic() - begin}
    if arguments.write_vehicle:
        write_file(arguments.write_vehicle, found.named_vehicle(Path(arguments.write_vehicle).stem).to_toml())
    if arguments.report:
        found.report(arguments.report)
    deliver(document, arguments.json, text_of(document))
    return 0
