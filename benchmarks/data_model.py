"""Does the noise of the likelihood hold? Scatter of block scores and false gains on drones with nothing hidden.

    python -m benchmarks.data_model STUDY... [--cases 8] [--hidden] [--json FILE]

STUDY is a folder of `benchmarks.concealed`. Of every flown case with nothing hidden (with --hidden: with effects of the
catalogue) both flights are fitted, each by itself, by the nominal model with what is usual of a recording. One pass
with the columns of all effects then gives

- the *scatter* of each column: variance of its block scores, with twice the covariance of neighbours, over its
  information. It is 1 where the noise is what the model says; log odds are too sure by that factor.
- the *false gain* of each effect: by how much it raises the log evidence [nats], in the linear approximation.

Drag and flapping that a drone has beside its file (`aside`) are fitted too.
"""

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.concealed.diagnose import flown
from benchmarks.concealed.ideal import options_of
from benchmarks.concealed.paths import FLIGHTS, Study, read
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.diagnosis.posterior.evidence import Shared
from crazyem.diagnosis.posterior.study import Study as Fitting
from crazyem.diagnosis.workers import Workers
from crazyem.recordings.registry import open_recording
from crazyem.vehicle import Vehicle, load_vehicle

Found = dict[str, Any]
BUILT = ("linear_drag", "velocity_moment")  # what drones of drawn worlds may have beside their file


def scatter(shared: Shared, column: int) -> tuple[float, float]:
    """Variance of a column's block scores over its information, and their lag-one correlation; NaN: it says nothing."""
    left, size = shared.blocks[:, column] - shared.blocks[:, column].mean(), shared.information[column, column]
    alone, beside = float(left @ left), float(left[1:] @ left[:-1])
    return ((alone + 2.0 * beside) / size, beside / alone) if size > 0.0 < alone else (float("nan"), float("nan"))


def measure(recording: Path, vehicle: Vehicle, mapping: Path | None, aside: Sequence[str]) -> Found:
    """Of one flight: log-likelihood, noise as fitted, scatter of every column, gain of every effect."""
    began = time.process_time()
    study = Fitting([flight_of(open_recording(str(recording), options_of(mapping)), vehicle)], vehicle, Workers(1))
    known = [m for m in study.pool.members if m.effect in aside and m.effect in BUILT]
    start = [p.with_effects({m.effect: m.candidate.neutral(p) for m in known}) for p in study.points]
    fit = study.fit(study.data, start, known, frozenset(), np.zeros(sum(len(m.candidate.free) for m in known)), {})
    asked = [m for m in study.pool.looks if m.effect not in aside]
    look = study.look(study.data, fit.points, known, {}, asked)
    out: Found = {"loglik": float(fit.blocks.sum()), "noise": noise_of(fit.points[0]), "scatter": {}, "correlation": {}}
    gains: dict[str, float] = defaultdict(lambda: -np.inf)
    alone = study.posterior(look, known).gain
    for m in asked:
        for name, i in zip(m.candidate.free, look.places[m.candidate], strict=True):
            key = f"{m.candidate.label}.{name}"
            out["scatter"][key], out["correlation"][key] = scatter(look.shared, i)
        gains[m.effect] = max(gains[m.effect], study.posterior(look, [*known, m], nudged=[m]).gain - alone)
    usual = {c.effect: {n: fit.points[0].effects[c.effect].get(n) for n in c.free} for c, _ in study.pool.usual}
    return out | {"gain": dict(gains), "usual": usual, "processor_seconds": time.process_time() - began}


def noise_of(point: Point) -> dict[str, Any]:
    """The scales of a model's noise, for people."""
    return {k: np.round(v, 5).tolist() for k, v in vars(point.noise).items()}


def cases(folders: Sequence[Path], kinds: Sequence[str]) -> Iterator[tuple[Study, str, Found]]:
    """Flown cases of some kinds."""
    for folder in folders:
        study = Study(folder)
        for case in flown(study):
            truth = read(study.truth(case))
            if truth["kind"] in kinds:
                yield study, case, truth


def summary(found: Sequence[Found]) -> str:
    """Scatter and false gains by effect, and over all."""
    scatters, gains = defaultdict(list), defaultdict(list)
    for f in found:
        for key, value in f["scatter"].items():
            scatters[key.split("[")[0].split(".")[0]].append(value)
        for key, value in f["gain"].items():
            gains[key].append(value)
    lines = ["| effect | scatter: median | false gain: median | largest |", "|---|---|---|---|"]
    for key in sorted(gains, key=lambda k: -float(np.median(gains[k]))):
        lines.append(
            f"| {key} | {np.nanmedian(scatters[key]):.2f} | {np.median(gains[key]):.1f} | {max(gains[key]):.1f} |"
        )
    each = [float(np.nanmedian(list(f["scatter"].values()))) for f in found]
    most = [max(f["gain"].values()) for f in found]
    over = np.mean([v > 8.0 for f in found for v in f["gain"].values()])
    lines.append(
        f"{len(found)} flights: scatter {np.median(each):.2f} (quartiles {np.quantile(each, 0.25):.2f} to "
        f"{np.quantile(each, 0.75):.2f}), largest false gain {np.median(most):.1f} nats "
        f"({np.quantile(most, 0.25):.1f} to {np.quantile(most, 0.75):.1f}), {100 * over:.1f} % of gains over 8 nats, "
        f"{sum(f['processor_seconds'] for f in found):.0f} s of processor"
    )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="+", type=Path, metavar="STUDY")
    parser.add_argument("--cases", type=int, default=10**6, help="at most so many")
    parser.add_argument("--hidden", action="store_true", help="cases with hidden effects: what these gain")
    parser.add_argument("--json", type=Path, help="all numbers of each flight")
    arguments = parser.parse_args(argv)
    found = []
    kinds = ("single", "pair") if arguments.hidden else ("nothing",)
    for study, case, truth in list(cases(arguments.studies, kinds))[: arguments.cases]:
        home = truth.get("world", "home") == "home"
        vehicle = load_vehicle(truth["platform"] if home else str(study.vehicle(case)))
        for name in FLIGHTS:
            one = measure(study.recording(case, name), vehicle, study.mapping(case), truth.get("aside", ()))
            one |= {"study": study.folder.name, "case": case, "flight": name}
            found.append(one)
            true = {k: v for k, v in one["gain"].items() if k in truth["effects"]}
            most = sorted(one["gain"].items(), key=lambda kv: -kv[1])[:3]
            told = [f"true {k} {v:.1f}" for k, v in true.items()] + [f"{k} {v:.1f}" for k, v in most]
            spread = np.nanmedian(list(one["scatter"].values()))
            print(f"{study.folder.name} {case} {name}: scatter {spread:.2f}, " + ", ".join(told), flush=True)
    if not arguments.hidden:
        print(summary(found))
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
