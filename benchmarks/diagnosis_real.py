"""Proof 2: `crazyem diagnose` and `predict` on real recordings; writes docs/results/diagnosis_real.json and its table.

    python benchmarks/diagnosis_real.py --shared ../shared [--parts alignment,nanodrone,...] [--docs docs] [--work DIR]

Each part runs the commands as a user would, scores what they write by code that shares nothing with them, and replaces
its own entry of the JSON file; parts that are not run keep theirs. The tables of docs: diagnosis_real.md between the
marks are made from the JSON file.
"""

import argparse
import gzip
import json
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from crazyem import load_vehicle, open_recording
from crazyem.diagnosis.naming.steady import with_baseline

HORIZON = 50
KINDS = ("square", "chirp", "random")
MARKS = ("<!-- measured -->", "<!-- end of measured -->")


def crazyem(*arguments: str) -> tuple[str, float]:
    """Run a command; returns its output and seconds. Raises RuntimeError with the output if it fails."""
    begin = time.monotonic()
    done = subprocess.run([sys.executable, "-m", "crazyem", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"crazyem {' '.join(arguments[:2])} ...: {done.stderr.strip().splitlines()[-1:]}")
    return done.stdout, time.monotonic() - begin


def diagnose(
    work: Path, name: str, train: Sequence[Path], held_out: Sequence[Path], vehicle: str | Path, *more: str
) -> dict[str, Any]:
    """One diagnosis: named effects, sentence, seconds, and path of the fitted vehicle."""
    fitted, document = work / f"{name}.toml", work / f"{name}.json"
    apart = ["--held-out", *map(str, held_out)] if held_out else []
    text, seconds = crazyem(
        "diagnose", *map(str, train), *apart, "--vehicle", str(vehicle), "--write-vehicle", str(fitted), "--json",
        str(document), *more,
    )  # fmt: skip
    found = json.loads(document.read_text())
    return {
        "train": [p.name for p in train],
        "held_out": [p.name for p in held_out],
        "seconds": round(seconds, 1),
        "mismatch": found["mismatch"],
        "effects": found["effects"],
        "indistinguishable": found["indistinguishable"],
        "unexplained": found["unexplained"]["found"],
        "not_identifiable": [e["name"] for e in found["not_identifiable"]],
        "text": text,
        "fitted": str(fitted),
    }


# -- nanodrone ---------------------------------------------------------------------------------------------------------


def table_of(path: Path) -> NDArray:
    """(n, 13) states of a processed run."""
    names = ["x", "y", "z", "vx", "vy", "vz", "qx", "qy", "qz", "qw", "wx", "wy", "wz"]
    with gzip.open(path, "rt") as file:
        head = file.readline().strip().split(",")
        rows = np.loadtxt(file, delimiter=",")
    return rows[:, [head.index(n) for n in names]]


def sigma(runs: Sequence[NDArray], predictions: Sequence[NDArray]) -> dict[str, float]:
    """Mean length of the error summed over 50 steps: position, velocity, rotation, body rate (arXiv 2512.14450,
    windows that stay within a run)."""
    total = {}
    for name, part in (("pos", slice(0, 3)), ("vel", slice(3, 6)), ("omega", slice(10, 13))):
        total[name] = sum(
            float(np.mean(np.concatenate([
                np.linalg.norm(p[:, h - 1, part] - x[h : h + len(p), part], axis=1)
                for x, p in zip(runs, predictions, strict=True)
            ])))
            for h in range(1, HORIZON + 1)
        )  # fmt: skip
    total["rot"] = sum(
        float(np.mean(np.concatenate([
            (Rotation.from_quat(x[h : h + len(p), 6:10]).inv() * Rotation.from_quat(p[:, h - 1, 6:10])).magnitude()
            for x, p in zip(runs, predictions, strict=True)
        ])))
        for h in range(1, HORIZON + 1)
    )  # fmt: skip
    return {k: round(total[k], 3) for k in ("pos", "vel", "rot", "omega")}


def nanodrone(shared: Path, work: Path) -> dict[str, Any]:
    """Fit on runs 1 to 3, predict run 4."""
    folder = shared / "recordings/nanodrone/processed"
    train = [folder / f"{k}_run{i}.csv.gz" for k in KINDS for i in (1, 2, 3)]
    apart = [folder / f"{k}_run4.csv.gz" for k in KINDS]
    found = diagnose(work, "nanodrone", train, apart, "cf21bl-busetto")
    runs = [table_of(p) for p in apart]
    scores = {"naive": sigma(runs, [np.repeat(x[:-HORIZON, None], HORIZON, axis=1) for x in runs])}
    for name, vehicle in (("before", "cf21bl-busetto"), ("after", found["fitted"])):
        predictions = []
        for path in apart:
            out = work / f"{name}_{path.stem}.npz"
            crazyem("predict", str(path), "--vehicle", vehicle, "--horizon", str(HORIZON), "-o", str(out), "--force")
            predictions.append(np.load(out)["prediction"])
        scores[name] = sigma(runs, predictions)
    return {**found, "sigma": scores}


def alignment(shared: Path, work: Path) -> dict[str, Any]:
    """Delays between rotor speeds and body rates of every run, raw and processed."""
    from crazyem.diagnosis.flights.inputs import inputs_of
    from crazyem.recordings import open_recording
    from crazyem.vehicle import load_vehicle

    vehicle, found = load_vehicle("cf21bl-busetto"), {}
    for kind in ("raw", "processed"):
        for path in sorted((shared / "recordings/nanodrone" / kind).glob("*.csv.gz")):
            a = inputs_of(open_recording(path), vehicle).alignment
            found[f"{kind}/{path.name.split('.')[0]}"] = a and {
                "delay_ms": round(1e3 * a.delay, 2), "sd_ms": round(1e3 * a.sd, 2), "roll_ms": round(1e3 * a.roll, 2),
                "pitch_ms": round(1e3 * a.pitch, 2), "explained": round(a.explained, 2),
            }  # fmt: skip
    return {"delays": found}


# -- nanobench ---------------------------------------------------------------------------------------------------------

TRAIN = tuple(
    f"{kind}_rep{i}"
    for kind, i in (
        ("B2_circle_fast", 1), ("B2_circle_fast", 3), ("B2_circle_medium", 1), ("B2_circle_slow", 1),
        ("B3_figure8_fast", 1), ("B3_figure8_fast", 2), ("B3_figure8_medium", 1), ("B3_figure8_slow", 1),
    )
)  # fmt: skip
LEFT_OUT = (
    "B9_trefoil_medium_rep1", "B9_trefoil_slow_rep1", "B9_trefoil_slow_rep14", "B9_trefoil_fast_rep1",
    "B6_linear_ramp_rep2",
)  # fmt: skip
Judged = tuple[NDArray, float, int]  # see `forces`
WINDOW = 21  # samples of the Savitzky-Golay filter that accelerations come from


def forces(path: Path, vehicle: str, withhold: Sequence[str], *, learned: bool = False) -> Judged:
    """Residual of the specific force (n, 3) m/s^2, body axes, at recorded states; rms of the position error after 0.5 s
    with the measured attitude [m]; number of starts. `learned`: as in `crazyem predict`, with the force that was
    missing before each start; else the model alone. (For the position, a withheld voltage is that of the first 3 s,
    also at earlier starts.)"""
    from crazyem.diagnosis.flights.flight import without
    from crazyem.diagnosis.prediction.bias_correction import correction_weights
    from crazyem.diagnosis.prediction.horizon import errors, open_loop, windows
    from crazyem.diagnosis.prediction.predict import predict, recorded, turned_by
    from crazyem.recordings import open_recording
    from crazyem.vehicle import load_vehicle

    shown = recorded(without(open_recording(path), withhold), load_vehicle(vehicle))
    at = windows(shown)
    weights = correction_weights(turned_by(shown), at.times[:, 0], horizon=at.horizons[-1]) if learned else None
    position = errors(open_loop(shown, at, measured_attitude=True, weights=weights), at)
    step = 0.01  # one step from every sample: the model's acceleration
    if learned:
        found = predict(shown, horizon=1)
        starts = np.searchsorted(shown.time, found.start_time)
        keep = found.airborne & shown.airborne[starts + 1]
        starts, span = starts[keep], (found.time[keep, 0] - found.start_time[keep])[:, None]
        model = (found.prediction[keep, 0, 3:6] - shown.state[starts, 3:6]) / span
    else:
        short = windows(shown, horizons=(step,), spacing=step)
        one = open_loop(shown, short, measured_attitude=True)[:, 0]
        starts, span = short.rows, (short.times[:, 1] - short.times[:, 0])[:, None]
        model = (one[:, 3:6] - shown.state[starts, 3:6]) / span
    rest = []
    for rows in np.split(np.arange(starts.size), np.flatnonzero(np.diff(starts) > 1) + 1):
        if rows.size < 5 * WINDOW:
            continue
        time, state = shown.time[starts[rows]], shown.state[starts[rows]]
        grid = np.arange(time[0], time[-1], step)
        place = np.stack([np.interp(grid, time, c) for c in state[:, :3].T], 1)
        acceleration = np.stack([np.interp(grid, time, c) for c in model[rows].T], 1)
        twice = np.cumsum(np.cumsum(acceleration, axis=0), axis=0) * step**2  # the same filter for both
        both = [savgol_filter(v, WINDOW, 3, deriv=2, delta=step, axis=0) for v in (place, twice)]
        turn = Rotation.from_quat(np.stack([np.interp(grid, time, c) for c in state[:, 6:10].T], 1)).inv()
        rest.append(turn.apply(both[0] - both[1])[WINDOW:-WINDOW])
    return np.concatenate(rest), position.rms["position"][-1], position.starts


def judged(folder: Path, vehicle: str, withhold: Sequence[str] = ()) -> dict[str, Any]:
    """Scores of the flights of types that were not fitted: pooled, and of each flight."""
    paths = [folder / f"{n}.csv.gz" for n in LEFT_OUT]
    parts = [forces(p, vehicle, withhold) for p in paths]
    learned = [forces(p, vehicle, withhold, learned=True) for p in paths]
    return {
        **_scores(parts, learned),
        "flights": {n: _scores([p], [by]) for n, p, by in zip(LEFT_OUT, parts, learned, strict=True)},
    }


def _scores(parts: Sequence[Judged], learned: Sequence[Judged]) -> dict[str, Any]:
    """Scores of the model alone, and of `predict`."""
    return {
        "force_rms": rms_of(np.concatenate([p[0] for p in parts])),
        "predicted_force_rms": rms_of(np.concatenate([p[0] for p in learned])),
        "position_rms": _pooled_position(parts),
        "predicted_position_rms": _pooled_position(learned),
    }


def _pooled_position(parts: Sequence[Judged]) -> float:
    starts = np.array([p[2] for p in parts], float)
    return round(float(np.sqrt(np.sum(starts * np.square([p[1] for p in parts])) / starts.sum())), 4)


def rms_of(rest: NDArray) -> list[float]:
    """By axis, (n, 3) -> 3."""
    return [round(float(v), 3) for v in np.sqrt(np.mean(rest**2, axis=0))]


def nanobench(shared: Path, work: Path) -> dict[str, Any]:
    """Circles and figures 8 fitted, trefoils and ramps judged; the same with the voltage withheld."""
    folder = shared / "recordings/nanobench"
    vehicle = work / "cf2-27g.toml"
    vehicle.write_text(_with(_preset("cf2"), name="cf2-27g", mass=0.027))
    train = [folder / f"{n}.csv.gz" for n in TRAIN]
    apart = [folder / f"{LEFT_OUT[0]}.csv.gz"]
    with_voltage = diagnose(work, "nanobench", train, apart, vehicle)
    withheld = diagnose(work, "nanobench_withheld", train, apart, vehicle, "--withhold", "pm.vbat")
    return {
        **with_voltage,
        "withheld": withheld,
        "before": judged(folder, str(vehicle)),
        "after": judged(folder, with_voltage["fitted"]),
        "withheld_before": judged(folder, str(vehicle), ["pm.vbat"]),
        "withheld_after": judged(folder, withheld["fitted"], ["pm.vbat"]),
    }


def _preset(name: str) -> str:
    import crazyem as package

    return (Path(package.__file__).parent / "presets" / f"{name}.toml").read_text()


def _with(text: str, *, name: str, mass: float) -> str:
    """A preset under another name and mass."""
    lines = [f'name = "{name}"' if t.startswith("name") else t for t in text.splitlines()]
    changed = "\n".join(f"mass = {mass}" if t.startswith("mass") else t for t in lines) + "\n"
    assert tomllib.loads(changed)["mass"] == mass
    return changed


# -- crazypad and sysid ------------------------------------------------------------------------------------------------


def crazypad(shared: Path, work: Path) -> dict[str, Any]:
    """Make a drone's file from a preset and healthy flights, and diagnose other flights with this file.

    Each healthy flight is diagnosed with a file from the others of its drone, for the rate of false alarms.
    """
    folder = shared / "recordings/crazypad"
    result: dict[str, Any] = {}
    for drone in ("E8", "E9"):
        flights = sorted(folder.glob(f"*__{drone}_*"))
        healthy = [p for p in flights if "normal_flight" in p.name]
        for path in flights:
            others = [p for p in healthy if p != path]
            file = work / f"{drone}{healthy.index(path) if path in healthy else ''}.toml"
            if not file.is_file():
                learnt = with_baseline(load_vehicle("cf2-legacy"), [open_recording(p) for p in others])
                file.write_text(learnt.to_toml())
            try:
                result[path.name] = diagnose(work, path.name, [path], [], file)
            except RuntimeError as error:
                result[path.name] = {"failed": str(error)}
            print(path.name, [e["label"] for e in result[path.name].get("effects", [])], flush=True)
    return result


def sysid(shared: Path, work: Path) -> dict[str, Any]:
    """Diagnose errors of the published constants."""
    folder = shared / "recordings/sysid"
    published = Path(__file__).parent / "vehicles/cf2-eschmann.toml"
    return diagnose(work, "sysid", [folder / "log10"], [folder / "log15"], str(published))


PARTS: dict[str, Callable[[Path, Path], dict[str, Any]]] = {
    "alignment": alignment, "nanodrone": nanodrone, "nanobench": nanobench, "crazypad": crazypad, "sysid": sysid,
}  # fmt: skip


# -- the tables --------------------------------------------------------------------------------------------------------


def tables(done: dict[str, Any]) -> str:
    """Markdown of the measured figures; the JSON file has every diagnosis in words."""
    out: list[str] = []
    if "nanodrone" in done:
        out += ["| nanodrone, run 4, sum over 50 steps | position m | velocity m/s | rotation rad | rate rad/s |",
                "| --- | --- | --- | --- | --- |"]  # fmt: skip
        for name, s in done["nanodrone"]["sigma"].items():
            out.append(f"| {name} | {s['pos']} | {s['vel']} | {s['rot']} | {s['omega']} |")
        out += ["| aim | 1.80 | 7.8 | 3.0 | 18.0 |", ""]
    if "alignment" in done:
        out += ["| delay ms, runs 1 to 4 | raw | processed |", "| --- | --- | --- |"]
        delays = done["alignment"]["delays"]
        for kind in dict.fromkeys(name.split("/")[1].split("_")[0] for name in delays):
            of = [_delays(delays, f"{form}/{kind}_") for form in ("raw", "processed")]
            out.append(f"| {kind} | {' | '.join(of)} |")
        out.append("")
    if "nanobench" in done:
        out += ["| nanobench, types left out | force residual x, y, z m/s² | by `predict` | position after 0.5 s m | "
                "by `predict` |", "| --- | --- | --- | --- | --- |"]  # fmt: skip
        for name in ("before", "after", "withheld_before", "withheld_after"):
            s = done["nanobench"][name]
            x, y, z = s["force_rms"]
            by = ", ".join(map(str, s.get("predicted_force_rms", ["-"])))
            late = s.get("predicted_position_rms", "-")
            out.append(f"| {name.replace('_', ', ')} | {x}, {y}, {z} | {by} | {s['position_rms']} | {late} |")
        out += ["| aim | - | 0.16, 0.07, 0.17; withheld z 0.33 | - | 0.030 |", ""]
    return "\n".join(out)


def public(value: Any) -> Any:
    """The value without paths of this machine."""
    if isinstance(value, dict):
        return {k: public(v) for k, v in value.items() if k != "fitted"}
    return [public(v) for v in value] if isinstance(value, list) else value


def _delays(delays: dict[str, dict[str, float] | None], begin: str) -> str:
    """Delays of all runs whose names start with `begin`."""
    told = [entry for name, entry in sorted(delays.items()) if name.startswith(begin)]
    return ", ".join(f"{entry['delay_ms']:+.1f} ± {entry['sd_ms']:.1f}" if entry else "not told" for entry in told)


def main() -> None:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, required=True, help="folder with recordings/")
    parser.add_argument("--parts", default=",".join(PARTS), help="a,b,... of " + ", ".join(PARTS))
    parser.add_argument("--docs", type=Path, default=Path("docs/results"))
    parser.add_argument("--work", type=Path, default=Path("diagnosis_real"), help="for fitted vehicles and documents")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    path = arguments.docs / "diagnosis_real.json"
    done: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    for name in filter(None, arguments.parts.split(",")):
        print(f"{name} ...", flush=True)
        done[name] = PARTS[name](arguments.shared, arguments.work)
        path.write_text(json.dumps(public({k: done[k] for k in PARTS if k in done}), indent=1) + "\n")
    page = arguments.docs / "diagnosis_real.md"
    if page.is_file():
        text = page.read_text()
        begin, end = text.index(MARKS[0]) + len(MARKS[0]), text.index(MARKS[1])
        page.write_text(f"{text[:begin]}\n\n{tables(done)}\n{text[end:]}")


if __name__ == "__main__":
    main()
