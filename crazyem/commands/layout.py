"""`crazyem layout`: a layout for Foxglove and Lichtblick that shows recordings of ours."""

import argparse
import json
from pathlib import Path

from crazyem.commands.output import check_json
from crazyem.errors import UsageError


def run(arguments: argparse.Namespace) -> int:
    """Print the layout, or write it to a file."""
    from crazyem.recordings.mcap.layout import foxglove_layout

    text = json.dumps(foxglove_layout(), indent=2, allow_nan=False) + "\n"
    target = arguments.output or arguments.json or "-"
    if target == "-":
        print(text, end="", flush=True)
        return 0
    if Path(target).exists() and not arguments.force and arguments.output:
        raise UsageError(f"{target} exists already (--force replaces it).")
    check_json(target)
    try:
        Path(target).write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"cannot write {target}: {error.strerror}.") from None
    return 0
