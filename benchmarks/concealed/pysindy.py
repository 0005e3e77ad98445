"""Sparse regression (pysindy, extra `bench`) on the same recordings: what it names as the physics that was left out.

    python -m benchmarks.concealed.pysindy --out DIR [--cases N]

It gets what the diagnosis gets, and the nominal model on top: the part of specific force and angular acceleration that
the nominal rigid body with its rotor lag does not explain is regressed on a library of terms, one for each effect of
the catalogue that is a plain function of the state. Effects with a memory (delays, loads, gusts) and those of sensors
have no such term; it cannot name them. The term that explains most of the variance is what it names first.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from crazyem.diagnosis.fitting.model import Model, Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.physics.rotations import rotation_matrix
from crazyem.recordings.registry import open_recording
from crazyem.vehicle import Vehicle, load_vehicle

from .diagnose import flown
from .paths import Study, read

SMOOTHING = 15  # samples of the derivative's window: 0.15 s, a compromise between noise and motion
SHARES = (0.003, 0.01, 0.03)  # thresholds of the regression, as shares of the residual's standard deviation; held out
LEAST = 0.05  # least share of variance that only this term explains, for a term that is named
FORCE_TERMS = {
    "thrust": "thrust_scale", "speed": "linear_drag", "speed squared": "quadratic_drag", "near floor": "ground_effect",
    "voltage": "battery_sag", "time": "battery_sag", "tilted weight": "wind", "constant": "accelerometer_misalignment",
    "thrust squared": "thrust_curve",
}  # fmt: skip
TORQUE_TERMS = {
    "torque": "torque_scale", "speed": "velocity_moment", "rate": "rate_damping", "thrust": "center_of_mass",
    "other torque": "inertia_products", "thrust rate": "rotor_inertia",
}  # fmt: skip


def residuals(recording: Path, vehicle: Vehicle) -> tuple[NDArray, dict[str, NDArray], dict[str, NDArray]]:
    """(n, 6) residuals of the nominal model (m/s^2, rad/s^2, body); terms (n, 3) of force and of torque."""
    flight = flight_of(open_recording(str(recording)), vehicle)
    model = Model(flight)
    point = Point(vehicle, {}, start_noise())
    accelerations, situation = model.accelerations(point)
    use = np.all(np.isfinite(flight.y), axis=1)
    rotation = rotation_matrix(flight.y[use, 6:10])
    step = float(np.median(np.diff(flight.time)))
    rate, velocity = flight.y[use, 10:13], flight.y[use, 3:6]
    smooth = {"window_length": SMOOTHING, "polyorder": 2, "axis": 0}
    turning = savgol_filter(rate, deriv=1, delta=step, **smooth)
    pushed = savgol_filter(velocity, deriv=1, delta=step, **smooth) + np.array([0.0, 0.0, 9.81])
    measured = np.concatenate([np.einsum("nji,nj->ni", rotation, pushed), turning], axis=1)
    explained = savgol_filter(accelerations[use], **smooth)
    air = np.einsum("nji,nj->ni", rotation, velocity)
    up = np.zeros_like(air)
    thrust = explained[:, 2:3]
    up[:, 2:] = thrust
    voltage, flew = flight.voltage[use, None], flight.flown[use, None]
    height = (flight.y[use, 2:3] - flight.ground) / 0.15
    ones = np.ones_like(air)
    force = {
        "thrust": up,
        "speed": air,
        "speed squared": np.linalg.norm(air, axis=1, keepdims=True) * air,
        "near floor": up * np.exp(-np.maximum(height, 0.0)),
        "voltage": up * (voltage - 3.7),
        "time": up * flew,
        "thrust squared": up * (thrust - 9.81) / 9.81,
        "tilted weight": rotation[:, 0, :] + rotation[:, 1, :],
        "constant": ones * (1.0, 1.0, 0.0),
    }
    turn = explained[:, 3:]
    rising = np.gradient(situation.thrust[use] @ np.array([1.0, -1.0, 1.0, -1.0]), step)[:, None]
    torque = {
        "torque": turn,
        "speed": np.column_stack([air[:, 1], air[:, 0], np.zeros(len(air))]),
        "rate": rate,
        "thrust": ones * (1.0, 1.0, 1.0) * thrust / 9.81,
        "other torque": np.roll(turn, 1, axis=1),
        "thrust rate": rising * (0.0, 0.0, 1.0),
    }
    return measured - explained, force, torque


def named(recording: Path, vehicle: Vehicle) -> list[tuple[str, float]]:
    """Effects by the share of an axis's variance that their terms explain, largest first; from `LEAST` on."""
    import pysindy

    missing, force, torque = residuals(recording, vehicle)
    shares: dict[str, float] = {}
    half = len(missing) // 2
    for axis in range(6):
        terms, names = (force, FORCE_TERMS) if axis < 3 else (torque, TORQUE_TERMS)
        live = [t for t in terms if np.ptp(terms[t][:, axis % 3]) > 0 or np.any(terms[t][:, axis % 3])]
        columns = np.column_stack([terms[t][:, axis % 3] for t in live])
        size = np.maximum(np.sqrt(np.mean(columns**2, axis=0)), 1e-12)
        target, scaled = missing[:, axis : axis + 1], columns / size
        total = float(np.mean(target**2))
        best, least = np.zeros(len(live)), float(np.mean(target[half:] ** 2))
        for share in SHARES:
            fit = pysindy.STLSQ(threshold=share * np.sqrt(total) * 10, alpha=1e-3)
            fit.fit(scaled[:half], target[:half])
            left = float(np.mean((target[half:] - scaled[half:] @ fit.coef_.T) ** 2))
            if left < least:
                best, least = fit.coef_[0], left
        for i in np.flatnonzero(best):
            share = (_left(scaled, target, best, without=int(i)) - _left(scaled, target, best)) / total
            shares[names[live[i]]] = max(shares.get(names[live[i]], 0.0), share)
    found = sorted(shares.items(), key=lambda item: -item[1])
    return [(name, share) for name, share in found if share > LEAST]


def _left(columns: NDArray, target: NDArray, chosen: NDArray, *, without: int = -1) -> float:
    """Mean square residual of least squares on the chosen columns, optionally without one of them."""
    keep = [i for i in np.flatnonzero(chosen) if i != without]
    found = np.linalg.lstsq(columns[:, keep], target, rcond=None)[0]
    return float(np.mean((target - columns[:, keep] @ found) ** 2))


def main() -> None:
    """Print the names of each case, and the share of right ones."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.concealed.pysindy", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cases", type=int, default=10**6)
    arguments = parser.parse_args()
    study = Study(arguments.out.resolve())
    counts: dict[str, list[float]] = {}
    for case in flown(study)[: arguments.cases]:
        truth: dict[str, Any] = read(study.truth(case))
        said = named(study.recording(case, "recording"), load_vehicle(truth["platform"]))
        true = [*truth["effects"], *truth["hidden"]]
        first = [name for name, _ in said][:1]
        right = {
            "nothing": not said,
            "single": first == true,
            "pair": sorted(n for n, _ in said) == sorted(true),
            "outside": not said,
        }[truth["kind"]]
        counts.setdefault(truth["kind"], []).append(float(right))
        told = ", ".join(f"{n} ({100 * s:.0f} %)" for n, s in said[:4]) or "nothing"
        print(f"{case} {truth['kind']}: {', '.join(true) or 'nothing'}; named {told}", flush=True)
    for kind, values in counts.items():
        print(f"{kind}: right in {100 * np.mean(values):.0f} % of {len(values)}")


if __name__ == "__main__":
    main()
