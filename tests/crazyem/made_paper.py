"""Records as `crazyem paper` stores them, made by hand: known statistics, no simulation behind them."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from crazyem.paper.experiments import PATH_POINTS, thin
from crazyem.paper.runner import assemble
from crazyem.paper.settings import Settings
from crazyem.paper.tables import derive

TRUE = np.array([0.18, 2.5e-4, 3.1e-4, 2.0e-4])
BOUND = np.array([0.001, 0.04, 0.05, 0.06])  # relative
MARKS = ("mass_5", "mass_1", "Ixx_25", "Iyy_25", "Izz_25")
TIMING = {"seconds": 0.5, "cpu_seconds": 0.4, "update_median_ms": 1.0, "update_p99_ms": 2.0}


def _limits() -> dict[str, Any]:
    shares = {"bound": 1.0, "bound_noise_known": 0.5, "bound_noise_single": 0.7}
    return {name: (share * BOUND).tolist() for name, share in shares.items()}


def _ci95(value: np.ndarray) -> list[list[float]]:
    return [[v * (1 - 2 * b), v * (1 + 2 * b)] for v, b in zip(value, BOUND)]


def offline(sensor: str, method: str, seed: int, error: np.ndarray | float = 0.0) -> dict[str, Any]:
    """An offline record whose final value has a relative error."""
    name = {"experiment": "offline", "sensor": sensor, "method": method, "seed": seed, "timing": dict(TIMING)}
    if method == "bound":
        return {**name, **_limits()}
    value = TRUE * (1 + error)
    theta = [(value * (1 - 0.5**k)).tolist() for k in range(21)]
    record = {**name, "final": value.tolist(), "theta": theta}
    if method == "published":
        return {**record, **({"dead_reckoned": TRUE.tolist()} if sensor == "C" else {})}
    return {**record, "sd": (value * BOUND).tolist(), "ci95": _ci95(value), "converged": True}


def online(
    sensor: str, method: str, seed: int, errors: list[Any] | None = None, *, updates: int = 1000, crashed: bool = False
) -> dict[str, Any]:
    """An online record with a window for each relative error."""
    errors = [0.0] if errors is None else errors
    ramp = 1 - np.exp(-np.arange(updates) / 30.0)
    windows = [
        {"update": updates - 1 - i, "value": (TRUE * (1 + e)).tolist(), **_limits(), "ci95": _ci95(TRUE * (1 + e))}
        for i, e in enumerate(errors)
    ]
    rows = thin(updates)
    reached = {mark: {"first": 0.1 * (k + 1) + 0.01 * seed, "stays": 0.2 * (k + 1)} for k, mark in enumerate(MARKS)}
    return {
        "experiment": "online", "sensor": sensor, "method": method, "seed": seed,
        "theta": (TRUE[None, :] * ramp[:, None]).tolist(),
        "windows": [] if crashed else windows,
        "crashed": crashed, "crashed_as_printed_after_s": None,
        "flown_s": 20.0, "tracking_rms_m": 1.2, "tracking_rms_known_m": 1.0, "times": reached,
        "path": [[float(k), 1.0, 2.0] for k in range(PATH_POINTS)],
        "interval_rows": rows, "intervals": [None if r < 5 else _ci95(TRUE) for r in rows],
        "timing": {**TIMING, "estimator_median_ms": 0.4, "estimator_p99_ms": 10.0},
    }  # fmt: skip


def table1(seed: int, scale: float = 1.0) -> dict[str, Any]:
    """A record of Table I."""
    errors = {"mean": 0.01 * scale, "sd": 0.005 * scale, "max": 0.03 * scale}
    return {
        "experiment": "table1", "sensor": "A", "method": "filter", "seed": seed, "position": errors, "angles": errors,
        "velocity_within": 1.0, "rate_within": 0.9, "timing": {"seconds": 0.1, "cpu_seconds": 0.1},
    }  # fmt: skip


def whole_run(seeds: int, *, spread: float = 1.0, updates: int = 1000) -> list[dict[str, Any]]:
    """Records of every experiment, sensor and method, with errors of `spread` bounds."""
    rng = np.random.default_rng(4)
    records: list[dict[str, Any]] = [table1(k, 1 + 0.1 * k) for k in range(seeds)]
    for sensor in "ABC":
        for seed in range(seeds):
            records.append(offline(sensor, "bound", seed))
            for method in ("published", "crazyem"):
                records.append(offline(sensor, method, seed, spread * BOUND * rng.normal(size=4)))
                errors = [spread * BOUND * rng.normal(size=4) for _ in range(3)]
                records.append(online(sensor, method, seed, errors, updates=updates))
    return records


def results_of(records: list[dict[str, Any]]) -> dict[str, Any]:
    """results.json of such records, figures left out."""
    settings = Settings()
    timing = {"jobs": 2, "tasks_reused": 0, "simulations_s": 1.0, "figures": 0, "figures_s": 1.0, "wall_s": 2.0}
    return assemble(records, settings, {**derive(records, settings), "figures": []}, timing)


def plain_motion(x, u, noise, dt, mass, inertia):
    """x (12,) one explicit Euler step later; Euler rates by inverting the map to body rates, attitude by scipy."""
    roll, pitch, _ = x[6:9]
    to_body = np.array(
        [
            [1, 0, -np.sin(pitch)],
            [0, np.cos(roll), np.sin(roll) * np.cos(pitch)],
            [0, -np.sin(roll), np.cos(roll) * np.cos(pitch)],
        ]
    )
    body_z = Rotation.from_euler("xyz", x[6:9]).as_matrix()[:, 2]
    momentum = np.diag(inertia) @ x[9:]
    rates = np.linalg.solve(np.diag(inertia), u[1:] + noise[1:] - np.cross(x[9:], momentum))
    slope = [*x[3:6], *(body_z * (u[0] + noise[0]) / mass - [0, 0, 9.81]), *np.linalg.solve(to_body, x[9:]), *rates]
    return x + dt * np.array(slope)
