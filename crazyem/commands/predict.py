"""`crazyem predict RECORDING --vehicle FILE --horizon N -o OUT.npz`: causal open-loop predictions from every start."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.atomic_file import new_file
from crazyem.commands.files import Found, read_options, targets
from crazyem.commands.output import Progress, put


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    from crazyem.api.diagnosing import predict

    recording = Path(arguments.file)
    output = targets([Found(recording)], arguments.output, ".npz", force=arguments.force)[0]
    if arguments.ensemble:
        return _ensemble(arguments, output)
    with Progress("predict", 0, "starts") as progress:
        found = predict(
            recording,
            arguments.vehicle,
            horizon=arguments.horizon,
            step=arguments.step,
            every=arguments.every,
            plain=arguments.plain,
            options=read_options(arguments),
            progress=lambda done, total: progress.show(f"predict: {done} of {total} starts"),
        )
    write(output, found.arrays())
    lines = [f"{output}: {found}", *(f"  {notice}." for notice in found.notices)]
    if arguments.step is None and found.left_out > 0:
        lines.append(
            f"  {found.left_out} starts are left out: no whole state, or a gap in the inputs (see start_index)."
        )
    unstable = int((~np.isfinite(found.prediction).all(axis=(1, 2))).sum())
    if unstable:
        lines.append(f"  {unstable} predictions left the range of numbers: the model is unstable there.")
    put("\n".join(lines))
    return 0


def _ensemble(arguments: argparse.Namespace, output: Path) -> int:
    """Predict a band `horizon` steps ahead, from draws of the vehicle's posterior."""
    from crazyem.api.vehicles import predict_ensemble

    found = predict_ensemble(
        arguments.file,
        arguments.vehicle,
        count=arguments.ensemble,
        horizon=arguments.horizon,
        step=arguments.step,
        seed=arguments.seed,
        days=arguments.other_day,
        calibrate=arguments.calibrate,
        plain=arguments.plain,
        options=read_options(arguments),
    )
    write(output, found.arrays())
    put(f"{output}: {found}")
    return 0


def write(output: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Write the arrays; a failed write leaves no file. Raises UsageError if the file cannot be written."""
    with new_file(output, force=True) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
