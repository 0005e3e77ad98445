"""`crazyem layout`: a layout for Foxglove and Lichtblick that shows crazyem's recordings or a live swarm."""

import argparse
import json
from pathlib import Path
from typing import Any

from crazyem.atomic_file import write_file
from crazyem.commands.output import check_json
from crazyem.errors import UsageError
from crazyem.live.swarm import DRONE_NAME, read_swarm


def run(arguments: argparse.Namespace) -> int:
    """Print the layout, or write it to a file."""
    text = json.dumps(_layout(arguments), indent=2, allow_nan=False) + "\n"
    target = arguments.output or arguments.json or "-"
    if target == "-":
        print(text, end="", flush=True)
        return 0
    if Path(target).exists() and not arguments.force and arguments.output:
        raise UsageError(f"{target} exists already (--force replaces it).")
    check_json(target)
    write_file(target, text)
    return 0


def _layout(arguments: argparse.Namespace) -> dict[str, Any]:
    """The layout for the drones of --swarm or --drones, else for one drone without a name."""
    from crazyem.recordings.mcap.layout import foxglove_layout, swarm_layout

    names = list(getattr(arguments, "drones", None) or ())
    swarm = getattr(arguments, "swarm", None)
    if swarm and names:
        raise UsageError("--swarm names the drones: leave out --drones.")
    if swarm:
        names = [m.name for m in read_swarm(swarm, vehicle="cf2", trajectory=("hover",))]
    for name in names:
        if not DRONE_NAME.fullmatch(name):
            raise UsageError(f"the name of a drone is 1 to 40 letters, digits, - or _, not {name!r}.")
    if len(set(names)) < len(names):
        raise UsageError("every drone needs a name of its own.")
    return swarm_layout(names) if names else foxglove_layout()
