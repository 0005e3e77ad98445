"""`crazyem vehicle convert | check | sample`: work with simulator files."""

import argparse
from pathlib import Path

from crazyem.atomic_file import write_file
from crazyem.commands.files import read_options
from crazyem.commands.output import deliver, names_in, say
from crazyem.errors import DataError, UsageError
from crazyem.live.summary import check_writable

BY_SUFFIX = {".urdf": "gym-pybullet-drones", ".sdf": "gazebo", ".py": "rotorpy"}


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    return {"convert": _convert, "check": _check, "sample": _sample}[arguments.action](arguments)


def _check(arguments: argparse.Namespace) -> int:
    from crazyem.api.vehicles import check_vehicle

    if arguments.write:
        _check_target(Path(arguments.write), arguments)
    found = check_vehicle(
        arguments.file,
        arguments.files,
        held_out=arguments.held_out,
        name=arguments.name,
        beside=arguments.beside,
        base=arguments.vehicle,
        mass=arguments.mass,
        candidates=names_in(arguments.candidates),
        tolerance=arguments.tolerance,
        jobs=arguments.jobs,
        options=read_options(arguments),
        progress=lambda text: say(f"check: {text}"),
    )
    if arguments.write:
        write_file(arguments.write, found.corrected.text)
    deliver({**found.to_dict(), "written": arguments.write}, arguments.json, str(found))
    return DataError.exit_code if arguments.strict and not found.fits else 0


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
    write_file(str(output), made.text)
    remarks = [] if source.imported is None else list(source.imported.remarks)
    document = {"source": arguments.source, "source_format": source.format, "output": str(output), **made.to_json()}
    document["remarks"] = remarks
    lines = [f"{output}: {to}, from {arguments.source} ({source.format}), vehicle {source.vehicle.name}"]
    lines += [f"  {remark}" for remark in remarks]
    if made.omissions:
        lines += ["  not held by this file:", *(f"    {omission}" for omission in made.omissions)]
    deliver(document, arguments.json, "\n".join(lines))
    return 0


def _sample(arguments: argparse.Namespace) -> int:
    import numpy as np

    from crazyem.commands.predict import write
    from crazyem.physics import folding
    from crazyem.simulators.convert import FORMATS, OWN, convert, read_text
    from crazyem.simulators.sampling import MASS_SD, sample

    vehicle = folding.load(arguments.file)
    mass_sd = MASS_SD if arguments.mass_sd is None else arguments.mass_sd
    found = sample(vehicle, arguments.count, seed=arguments.seed, days=not arguments.same_day, mass_sd=mass_sd)
    output, to = Path(arguments.output), arguments.to or OWN
    arrays = found.arrays()
    if output.suffix.lower() == ".npz":
        if arguments.to:
            raise UsageError("--to needs a folder; arrays are in SI.")
        _check_target(output, arguments)
        write(output, {**arrays, "draws": found.draws, "parameters": np.array(found.parameters)})
    else:
        template = read_text(arguments.template) if arguments.template else None
        suffix = ".toml" if to == OWN else FORMATS[to].suffix if to in FORMATS else ""
        output.mkdir(parents=True, exist_ok=True)
        width = max(3, len(str(arguments.count - 1)))
        for k, drawn in enumerate(found.vehicles):
            target = output / f"{vehicle.name}_{k:0{width}d}{suffix}"
            _check_target(target, arguments)
            made = convert(drawn, to, template=template, where=arguments.template or "", name=arguments.name or "",
                           costs=False)  # fmt: skip
            write_file(str(target), made.text)
    rows = {n: [float(np.mean(v)), float(np.std(v))] for n, v in arrays.items()}
    document = {
        "file": arguments.file, "output": str(output), "to": to, "count": arguments.count, "seed": arguments.seed,
        "same_day": arguments.same_day, "mass_sd": mass_sd,
        "constants": {n: {"mean": mean, "sd": sd} for n, (mean, sd) in rows.items()},
    }  # fmt: skip
    lines = [f"{output}: {arguments.count} drones of {vehicle.name}, seed {arguments.seed}"]
    lines += [f"  {n}: {mean:.4g} +- {sd:.2g}" for n, (mean, sd) in rows.items() if sd > 0.0]
    deliver(document, arguments.json, "\n".join(lines))
    return 0


def _several(source: str, form: str | None) -> list[str]:
    """Names of the drones in a source; empty if its format has no names."""
    from crazyem.simulators.convert import OWN, format_named, format_of, read_text
    from crazyem.vehicle import preset_names

    if source in preset_names():
        return []
    text = read_text(source)
    kind = form or format_of(text, where=source)
    return [] if kind == OWN else format_named(kind).names(format_named(kind).open(text, source))


def _target_format(arguments: argparse.Namespace, template: str | None) -> str:
    """The output format from the template or the suffix. Raises UsageError if both are ambiguous."""
    from crazyem.simulators.convert import NAMES, format_of

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
