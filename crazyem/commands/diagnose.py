"""`crazyem diagnose RECORDING...`: where simulation and recording part, which physics was left out, and the fit."""

import argparse
import json
import os
import sys
import time
from pathlib import Path

from crazyem.commands.files import read_options
from crazyem.commands.output import put
from crazyem.doctor.thrust import vehicle_for
from crazyem.errors import UsageError
from crazyem.live.summary import check_writable
from crazyem.recordings import open_recording


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    from crazyem.diagnosis.compare import compare
    from crazyem.diagnosis.diagnose import diagnose
    from crazyem.diagnosis.document import document_of, saved_vehicle, text_of
    from crazyem.diagnosis.posterior.diagnose import diagnose as diagnose_by_posterior
    from crazyem.diagnosis.report import write_report

    for path in (arguments.json, arguments.report, arguments.write_vehicle):
        check_writable(path)
    begin = time.monotonic()

    def say(text: str) -> None:
        # in one piece: threads speak at once
        sys.stderr.write(f"diagnose: {time.monotonic() - begin:5.1f} s  {text}\n")
        sys.stderr.flush()

    options = read_options(arguments)
    recordings = [open_recording(p, options) for p in arguments.files]
    held_out = [open_recording(p, options) for p in arguments.held_out]
    vehicle = vehicle_for(recordings[0], arguments.vehicle)
    wanted = [n.strip() for n in (arguments.candidates or "").split(",") if n.strip()]
    asked = {
        "held_out": held_out, "wanted": wanted, "withhold": arguments.withhold, "jobs": arguments.jobs, "say": say
    }  # fmt: skip
    if arguments.method == "posterior":
        found = diagnose_by_posterior(recordings, vehicle, **asked)
    else:
        found = diagnose(recordings, vehicle, **asked, strict=arguments.strict_held_out)
    say("open-loop errors before and after")
    document, pictures = document_of(found, recordings, held_out, withhold=arguments.withhold)
    document["notices"] = [*(n for r in recordings for n in r.notices), *document["notices"]]
    document["seconds"] = time.monotonic() - begin
    if arguments.against:
        document["against"] = compare(recordings[0], open_recording(arguments.against, options))
    if arguments.write_vehicle:
        name = Path(arguments.write_vehicle).stem
        _replace(arguments.write_vehicle, saved_vehicle(found, name).to_toml())
    if arguments.report:
        write_report(arguments.report, document, pictures)
    if arguments.json == "-":
        put(json.dumps(document, indent=1))
        return 0
    if arguments.json:
        _replace(arguments.json, json.dumps(document, indent=1) + "\n")
    put(text_of(document))
    return 0


def _replace(path: str, text: str) -> None:
    """All or nothing. Raises UsageError if it cannot be written."""
    with_stream = Path(f"{path}.part")
    try:
        with_stream.write_text(text, encoding="utf-8")
        os.replace(with_stream, path)
    except OSError as error:
        with_stream.unlink(missing_ok=True)
        raise UsageError(f"cannot write {path}: {error.strerror or error}.") from None
