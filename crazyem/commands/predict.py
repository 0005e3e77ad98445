"""`crazyem predict RECORDING --vehicle FILE --horizon N -o OUT.npz`: causal open-loop predictions from every start."""

import argparse
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyem.commands.files import Found, read_options, targets
from crazyem.commands.output import Progress, put
from crazyem.doctor.thrust import vehicle_for
from crazyem.errors import UsageError
from crazyem.recordings import open_recording

LARGEST_PREDICTION = 4e9  # bytes of the arrays


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    from crazyem.diagnosis.prediction.predict import predict, recorded

    recording_path = Path(arguments.file)
    output = targets([Found(recording_path)], arguments.output, ".npz", force=arguments.force)[0]
    recording = open_recording(recording_path, read_options(arguments))
    vehicle = vehicle_for(recording, arguments.vehicle)
    shown = recorded(recording, vehicle)
    size = 14 * 8 * arguments.horizon * (shown.time.size / arguments.every)
    if size > LARGEST_PREDICTION:
        raise UsageError(
            f"{shown.time.size} samples with {arguments.horizon} steps each are {size / 1e9:.0f} GB of predictions; "
            f"use --every {int(np.ceil(arguments.every * size / LARGEST_PREDICTION))} or more."
        )
    with Progress("predict", shown.time.size, "starts") as progress:
        found = predict(
            shown,
            horizon=arguments.horizon,
            step=arguments.step,
            every=arguments.every,
            plain=arguments.plain,
            progress=lambda done, total: progress.show(f"predict: {done} of {total} starts"),
        )
    write(output, found.arrays())
    finite = np.isfinite(found.prediction).all(axis=(1, 2))
    lines = [
        f"{output}: {found.prediction.shape[0]} starts x {found.prediction.shape[1]} steps of "
        f"{1e3 * found.step:.4g} ms from {shown.inputs.signal}, vehicle {vehicle.name}"
        + (f" with {', '.join(vehicle.effects)}" if vehicle.effects else ""),
        *(f"  {notice}." for notice in shown.inputs.notices),
    ]
    skipped = len(range(0, shown.time.size - (arguments.horizon if arguments.step is None else 0), arguments.every))
    skipped -= finite.size
    if arguments.step is None and skipped > 0:
        lines.append(f"  {skipped} starts are left out: no whole state, or a gap in the inputs (see start_index).")
    if not finite.all():
        lines.append(f"  {int((~finite).sum())} predictions left the range of numbers: the model is unstable there.")
    put("\n".join(lines))
    return 0


def write(output: Path, arrays: dict[str, NDArray]) -> None:
    """All or nothing: into a file beside it first. Raises UsageError if it cannot be written."""
    with_stream = output.with_name(output.name + ".part")
    try:
        with with_stream.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
        os.replace(with_stream, output)
    except OSError as error:
        raise UsageError(f"cannot write {output}: {error.strerror or error}.") from None
    finally:
        with_stream.unlink(missing_ok=True)
