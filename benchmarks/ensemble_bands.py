"""Bands of `predict --ensemble` on flights that were not fitted, beside randomisation by 20 %; published constants of
simulators judged by the same flights. Prints the tables of docs/results/simulators.md.

    python -m benchmarks.ensemble_bands --shared ../shared [--only FLIGHT] [--file nanodrone params.toml cf21B_500]

Both drones are as docs/results/diagnosis_real.json has them: the nano-drone benchmark's by runs 1 to 3 of each kind,
NanoBench's by circles and figures 8. Numbers of their posterior are drawn independently, by the standard deviations
there. Judged are runs 4, as recorded, and trefoils and ramps.
"""

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.diagnosis_real import KINDS, LEFT_OUT, TRAIN
from crazyem.diagnosis.prediction.ensemble import Ensemble, ensemble
from crazyem.diagnosis.prediction.horizon import UNITS, errors, open_loop, windows
from crazyem.diagnosis.prediction.predict import Recorded, recorded
from crazyem.physics.rotors import wrench
from crazyem.recordings import open_recording
from crazyem.simulators.convert import HORIZON, convert, load_source
from crazyem.simulators.findings import field_findings, rescaled
from crazyem.simulators.sampling import sample
from crazyem.vehicle import Posterior, Vehicle, load_vehicle

RANDOM = 0.2  # relative, of a uniform randomisation by hand
RANDOM_COUNT, SEED = 48, 1
PUBLISHED = {"nanodrone": load_vehicle("cf21bl-busetto"), "nanobench": replace(load_vehicle("cf2"), mass=0.027)}


def fitted(results: Path, drone: str) -> Vehicle:
    """The vehicle that the diagnosis of real recordings has fitted."""
    effects = json.loads(results.read_text())[drone]["effects"]
    values = {e["name"]: {n: p["value"] for n, p in e["parameters"].items()} for e in effects}
    known = [(f"{e['name']}.{n}", p["value"], p["sd"]) for e in effects for n, p in e["parameters"].items() if p["sd"]]
    names, mean, sd = zip(*known, strict=True)
    covariance = tuple(tuple(row) for row in np.diag(np.square(sd)).tolist())
    return replace(PUBLISHED[drone], effects=values, posterior=Posterior(names, mean, covariance))


def randomised(vehicle: Vehicle, seed: int, *, each_rotor: bool = False) -> list[Vehicle]:
    """Vehicles whose mass, moments of inertia and thrust (of all rotors, or of each) vary by up to 20 %."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(RANDOM_COUNT):
        mass, *inertia = rng.uniform(1.0 - RANDOM, 1.0 + RANDOM, 4)
        thrust = rng.uniform(1.0 - RANDOM, 1.0 + RANDOM, 4 if each_rotor else 1) * np.ones(4)
        # rotors of unequal thrust make a torque: a trim
        total, *torque = wrench(thrust[None] / 4.0, arm=vehicle.arm, torque_per_thrust=vehicle.torque_per_thrust)[0]
        effects = {n: dict(v) for n, v in vehicle.effects.items()}
        if "inertia" in effects:
            effects["inertia"] = {n: v * f for (n, v), f in zip(effects["inertia"].items(), inertia, strict=True)}
        effects["thrust_scale"] = {"scale": effects.get("thrust_scale", {"scale": 1.0})["scale"] * float(total)}
        effects["trim"] = dict(zip("xyz", (float(v / total) for v in torque), strict=True))
        moments = tuple(float(i * f) for i, f in zip(vehicle.inertia, inertia, strict=True))
        found.append(replace(vehicle, mass=vehicle.mass * mass, inertia=moments, effects=effects, posterior=None))
    return found


def flights(shared: Path, drone: str) -> tuple[list[Path], list[Path]]:
    """The fitted and the judged flights."""
    folder = shared / "recordings" / drone
    if drone == "nanobench":
        return [folder / f"{n}.csv.gz" for n in TRAIN], [folder / f"{n}.csv.gz" for n in LEFT_OUT]
    runs = {k: [folder / "raw" / f"{k}_run{i}.csv.gz" for i in (1, 2, 3, 4)] for k in KINDS}
    return [p for k in KINDS for p in runs[k][:3]], [runs[k][3] for k in KINDS]


def bands(shared: Path, results: Path, drone: str, count: int, only: str, cache: dict[str, dict]) -> None:
    """Put held shares and widths of every judged flight into `cache`, by its name."""
    train, judged = flights(shared, drone)
    vehicle, published = fitted(results, drone), PUBLISHED[drone]
    others = [open_recording(p) for p in train]
    for path in judged:
        if path.name in cache or only not in path.name:
            continue
        flight = open_recording(path)
        members = sample(vehicle, count, seed=SEED, days=False, mass_sd=0.0).vehicles
        cache[path.name] = {
            "drone": drone,
            "ensemble": told(ensemble(flight, vehicle, members, horizon=HORIZON, calibrate=others, seed=SEED)),
            **{
                name: told(ensemble(flight, v, randomised(v, SEED, each_rotor=each), horizon=HORIZON, plain=True))
                for name, v, each in (
                    ("published", published, False), ("fitted", vehicle, False), ("each rotor", vehicle, True),
                )
            },
        }  # fmt: skip
        print(path.name, json.dumps(cache[path.name]), flush=True)


def told(found: Ensemble) -> dict[str, list[float]]:
    """Starts, held shares and widths."""
    return {"starts": [len(found.rows)], "held": [*found.held().values()], "width": [*found.width().values()]}


def pooled(cache: dict[str, dict], drone: str) -> str:
    """A table over the judged flights of a drone, each start counting the same."""
    rows = [entry for entry in cache.values() if entry["drone"] == drone]
    starts = np.array([r["ensemble"]["starts"][0] for r in rows], float)

    def mean(which: str, what: str) -> np.ndarray:
        return np.asarray(np.array([r[which][what] for r in rows]).T @ starts / starts.sum())

    width = mean("ensemble", "width")
    lines = [f"| {drone}, {len(rows)} flights, {starts.sum():.0f} starts | position | velocity | attitude | rate |",
             "|---|---|---|---|---|",
             "| held |" + "".join(f" {100 * v:.0f} % |" for v in mean("ensemble", "held")),
             "| width |" + "".join(f" {v:.2g} {u} |" for v, u in zip(width, UNITS.values(), strict=True))]  # fmt: skip
    for name in ("published", "fitted", "each rotor"):
        lines.append(f"| width over ±20 %, {name} |" + "".join(f" {v:.2f} |" for v in width / mean(name, "width")))
        lines.append(f"| held by ±20 %, {name} |" + "".join(f" {100 * v:.0f} % |" for v in mean(name, "held")))
    return "\n".join(lines)


def file_errors(shared: Path, results: Path, drone: str, path: str, name: str) -> str:
    """Fields of a published file that were fitted, and errors after half a second on the judged flights: of the file as
    published, with the fitted values, and of the whole fit. Position and velocity also with the recorded attitude, for
    the forces alone. Values that were not fitted are the preset's."""
    _, judged = flights(shared, drone)
    source = load_source(path, name=name or None, base=PUBLISHED[drone], strict=False)
    assert source.imported is not None
    same_weight = rescaled(fitted(results, drone), source.vehicle.mass)
    effects = json.loads(results.read_text())[drone]["effects"]
    fields = field_findings(source.imported, source.vehicle, same_weight, effects, {})
    made = convert(same_weight, source.format, template=source.text, name=name, costs=False)
    models = {"before": source.vehicle, "corrected file": made.held, "all found": same_weight}
    lines = [f"{path} {name}: {', '.join(p.name.split('.')[0] for p in judged)}"]
    lines += [f"{'off' if f.off else '   '} {f}" for f in fields if f.sd > 1e-6 * abs(f.fitted)]
    for which, model in models.items():
        shown = [recorded(open_recording(p), model) for p in judged]
        rms = []
        for measured in (False, True):
            found = [horizon_rms(s, measured_attitude=measured) for s in shown]
            rms += [math.sqrt(np.mean([e[q] ** 2 for e in found])) for q in list(UNITS)[: 2 if measured else 4]]
        units = [*UNITS.values(), "m", "m/s"]
        lines.append(f"| {which} |" + "".join(f" {v:.2g} {u} |" for v, u in zip(rms, units, strict=True)))
    return "\n".join(lines)


def horizon_rms(shown: Recorded, *, measured_attitude: bool) -> dict[str, float]:
    """Root mean square errors after half a second, by quantity."""
    at = windows(shown, horizons=(HORIZON,))
    found = errors(open_loop(shown, at, measured_attitude=measured_attitude), at)
    return {q: v[-1] for q, v in found.rms.items()}


def main() -> None:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, required=True, help="folder with recordings/")
    parser.add_argument("--only", default="", help="judged flights with this in their name")
    parser.add_argument("--count", type=int, default=256, help="drones of an ensemble")
    parser.add_argument("--results", type=Path, default=Path("docs/results/diagnosis_real.json"))
    parser.add_argument("--out", type=Path, default=Path("ensemble_bands.json"), help="what is there is not done again")
    parser.add_argument("--file", nargs=3, action="append", default=[], metavar=("DRONE", "FILE", "NAME"),
                        help="a simulator's file to judge; nanodrone or nanobench; its drone, or -")  # fmt: skip
    arguments = parser.parse_args()
    for drone, path, name in arguments.file:
        print(file_errors(arguments.shared, arguments.results, drone, path, name.strip("-")), flush=True)
    if arguments.file:
        return
    cache = json.loads(arguments.out.read_text()) if arguments.out.is_file() else {}
    for drone in PUBLISHED:
        bands(arguments.shared, arguments.results, drone, arguments.count, arguments.only, cache)
        arguments.out.write_text(json.dumps(cache, indent=1) + "\n")
        if any(entry["drone"] == drone for entry in cache.values()):
            print(pooled(cache, drone))


if __name__ == "__main__":
    main()
