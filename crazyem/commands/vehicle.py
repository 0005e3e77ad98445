"""`crazyem vehicle convert | check | sample`: files of simulators."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from crazyem.commands.output import put, replace_text
from crazyem.errors import UsageError
from crazyem.live.summary import check_writable

BY_SUFFIX = {".urdf": "gym-pybullet-drones", ".sdf": "gazebo", ".py": "rotorpy"}


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    return {"convert": _convert}[arguments.action](arguments)


def _convert(arguments: argparse.Namespace) -> int:
    from crazyem.physics import folding
    from crazyem.recordings import open_recording
    from crazyem.simulators.convert import convert, load_source, read_text

    output = Path(arguments.output)
    _check_target(output, arguments)
    base = folding.load(arguments.vehicle) if arguments.vehicle else None
    template = read_text(arguments.template) if arguments.template else None
    to = arguments.to or _target_format(arguments, template)
    names = _several(arguments.source, arguments.form)
    source = load_source(
        arguments.source, form=arguments.form, name=arguments.name if arguments.name in names else None, base=base
    )
    flight = open_recording(arguments.flight) if arguments.flight else None
    made = convert(
        source.vehicle, to, template=template, where=arguments.template or "", name=arguments.name or "",
        suffix=output.suffix.lower(), flight=flight,
    )  # fmt: skip
    replace_text(str(output), made.text)
    remarks = [] if source.imported is None else list(source.imported.remarks)
    document = {"source": arguments.source, "source_format": source.format, "output": str(output), **made.to_json()}
    document["remarks"] = remarks
    lines = [f"{output}: {to}, from {arguments.source} ({source.format}), vehicle {source.vehicle.name}"]
    lines += [f"  {remark}" for remark in remarks]
    lines += _listed("not held by this file:", made.lost)
    return _report(arguments, document, lines)


def _several(source: str, form: str | None) -> list[str]:
    """The drones of a source, where it has names for them."""
    from crazyem.simulators.convert import read_text
    from crazyem.simulators.registry import OWN, format_named, format_of
    from crazyem.vehicle import preset_names

    if source in preset_names():
        return []
    text = read_text(source)
    kind = form or format_of(text, where=source)
    return [] if kind == OWN else format_named(kind).names(format_named(kind).open(text, source))


def _target_format(arguments: argparse.Namespace, template: str | None) -> str:
    """The format that is not named. Raises UsageError where nothing says it."""
    from crazyem.simulators.registry import NAMES, format_of

    if template is not None:
        return format_of(template, where=arguments.template)
    suffix = Path(arguments.output).suffix.lower()
    if suffix in BY_SUFFIX:
        return BY_SUFFIX[suffix]
    raise UsageError(f"{arguments.output} may be of several formats; --to says which: {', '.join(NAMES)}.")


def _check_target(output: Path, arguments: argparse.Namespace) -> None:
    if output.exists() and not arguments.force:
        raise UsageError(f"{output} exists already (--force replaces it).")
    check_writable(str(output))
    if arguments.json not in (None, "-"):
        check_writable(arguments.json)


def _listed(head: str, entries: Sequence[Any]) -> list[str]:
    return [f"  {head}", *(f"    {entry}" for entry in entries)] if entries else []


def _report(arguments: argparse.Namespace, document: dict[str, Any], lines: list[str]) -> int:
    text = json.dumps(document, indent=1)
    if arguments.json == "-":
        put(text)
        return 0
    if arguments.json:
        replace_text(arguments.json, text + "\n")
    put("\n".join(lines))
    return 0
