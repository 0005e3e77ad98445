"""Tables I to V: each cell with the paper's values, the results of its method and of crazyem, and the bound."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.paper.experiments import CONVERGENCE_BANDS, SETTLED_SECONDS
from crazyem.paper.published_values import PARAMETERS, PUBLISHED_RANGES, SENSORS, TABLE_I, table_of
from crazyem.paper.settings import Settings

Record = Mapping[str, Any]


def expected_range(count: int) -> float:
    """Expected range (largest minus smallest) of `count` standard normal numbers (3.73 for 20)."""
    from scipy.special import ndtr

    x = np.linspace(-9.0, 9.0, 4001)
    below = ndtr(x)
    return float(np.trapezoid(1.0 - below**count - (1.0 - below) ** count, x))


# cells --------------------------------------------------------------------------------------------------------


def derive(records: Sequence[Record], settings: Settings) -> dict[str, Any]:
    """The content of results.json besides the tasks: Table I, the cells of Tables II to V, convergence, summary."""
    cells = [
        cell(records, settings, experiment, sensor, parameter)
        for experiment in ("offline", "online")
        for sensor in SENSORS
        for parameter in PARAMETERS
        if any(r["experiment"] == experiment and r["sensor"] == sensor for r in records)
    ]
    return {"table1": table1(records), "cells": cells, "flights": flights(records), "summary": summary(cells)}


def table1(records: Iterable[Record]) -> dict[str, Any] | None:
    """Pose errors: mean over flights, smallest and largest value of a flight; None without such tasks."""
    chosen = [r for r in records if r["experiment"] == "table1"]
    if not chosen:
        return None
    rows: dict[str, Any] = {"flights": len(chosen)}
    for name, printed in TABLE_I.items():
        rows[name] = {
            key: {"paper": value, **_spread([r[name][key] for r in chosen])} for key, value in printed.items()
        }
    for name in ("velocity_within", "rate_within"):
        rows[name] = _spread([r[name] for r in chosen])
    return rows


def _spread(values: Sequence[float]) -> dict[str, float]:
    return {"mean": _digits(np.mean(values)), "low": _digits(np.min(values)), "high": _digits(np.max(values))}


def cell(records: Iterable[Record], settings: Settings, experiment: str, sensor: str, parameter: str) -> dict[str, Any]:
    """One cell of Tables II to V; methods without tasks are null."""
    column = PARAMETERS.index(parameter)
    truth = (settings.mass, *settings.inertia)[column]
    paper = PUBLISHED_RANGES[experiment, sensor][parameter]
    mine = [r for r in records if r["experiment"] == experiment and r["sensor"] == sensor]
    # offline both methods share the flight and its bound; online each method has its own flights
    limits = {r["seed"]: r for r in mine if r["method"] == "bound"}
    result: dict[str, Any] = {
        "table": table_of(experiment, parameter), "experiment": experiment, "sensor": sensor, "parameter": parameter,
        "true": truth, "paper": {"range": list(paper), "middle_bias": _digits(sum(paper) / 2 / truth - 1)},
    }  # fmt: skip
    bounds: NDArray | None = None
    for method in ("published", "crazyem"):
        chosen = [r for r in mine if r["method"] == method]
        values, ci95, sds = _values(chosen, limits, column, experiment)
        result[method] = None
        if len(values):
            result[method] = {
                **_statistics(values, ci95, sds[:, 0], truth, paper),
                "crashed": sum(bool(r.get("crashed")) for r in chosen),
                **(_curves(chosen, settings, column, paper) if experiment == "online" else {}),
            }
            bounds = sds
    result["dead_reckoned"] = None
    if sensor == "C" and experiment == "offline":
        other = [r["dead_reckoned"][column] for r in mine if r["method"] == "published"]
        values = np.array([v for v in other if v is not None])
        if len(values):
            result["dead_reckoned"] = _statistics(values, [], np.array([]), truth, paper)
    result["bound"] = None if bounds is None else _bound(bounds, truth)
    return result


def _values(
    records: Sequence[Record], limits: Mapping[int, Record], column: int, experiment: str
) -> tuple[NDArray, list[Any], NDArray]:
    """Values of a column, their intervals, and (n, 3) relative bounds for noise free, single and known."""
    values, ci95, sds = [], [], []
    for record in records:
        found = record["windows"] if experiment == "online" else [{"value": record["final"], **record}]
        for one in found:
            limit = limits.get(record["seed"], one)
            if one["value"][column] is None:
                continue
            values.append(one["value"][column])
            ci95.append(None if one.get("ci95") is None else one["ci95"][column])
            sds.append([limit[k][column] for k in ("bound", "bound_noise_single", "bound_noise_known")])
    return np.array(values, float), ci95, np.array(sds, float).reshape(-1, 3)


def _curves(records: Sequence[Record], settings: Settings, column: int, paper: tuple[float, float]) -> dict[str, Any]:
    """A second definition of an online range: all values of the curves after 8 s."""
    first = round(SETTLED_SECONDS / (settings.dt * settings.every))
    values = [row[column] for r in records if not r["crashed"] for row in r["theta"][first:] if row[column] is not None]
    if not values:
        return {"curve_range": None, "curve_width_ratio": None}
    low, high = min(values), max(values)
    return {"curve_range": [low, high], "curve_width_ratio": _digits((high - low) / (paper[1] - paper[0]))}


def _statistics(
    values: NDArray, ci95: Sequence[Any], sds: NDArray, truth: float, paper: tuple[float, float]
) -> dict[str, Any]:
    low, high = float(values.min()), float(values.max())
    error = values / truth - 1
    result: dict[str, Any] = {
        "n": len(values),
        "range": [low, high],
        "mean": _digits(values.mean()),
        "bias": _digits(error.mean()),
        "sd": _digits(error.std(ddof=1)) if len(values) > 1 else None,
        "rms": _digits(np.sqrt(np.mean(error**2))),
        "overlap": bool(low <= paper[1] and high >= paper[0]),
        "width_ratio": _digits((high - low) / (paper[1] - paper[0])),
    }
    if len(sds) == len(values):
        result["rms_over_bound"] = _digits(np.sqrt(np.mean((error / sds) ** 2)))
        result["bias_over_bound"] = _digits(np.mean(error / sds))
    known = [(v, i) for v, i in zip(values, ci95) if i is not None and None not in i]
    if known:
        result["intervals"] = len(known)
        result["coverage"] = _digits(np.mean([i[0] <= truth <= i[1] for _, i in known]))
        result["interval_width"] = _digits(np.median([i[1] - i[0] for _, i in known]) / truth)
    return result


def _bound(sds: NDArray, truth: float) -> dict[str, Any]:
    free, single, known = np.sqrt(np.mean(sds**2, axis=0))
    half = expected_range(max(len(sds), 2)) / 2 * free
    return {
        "n": len(sds),
        "sd": _digits(free),
        "sd_noise_single": _digits(single),
        "sd_noise_known": _digits(known),
        "range": [_digits(truth * (1 - half)), _digits(truth * (1 + half))],
    }


def _digits(value: Any) -> float:
    return float(f"{float(value):.6g}")


# over cells and flights ---------------------------------------------------------------------------------------


def flights(records: Sequence[Record]) -> list[dict[str, Any]]:
    """Online flights of each sensor and method: crashes, tracking, convergence times."""
    found = []
    for sensor in SENSORS:
        for method in ("published", "crazyem"):
            chosen = [r for r in records if (r["experiment"], r["sensor"], r["method"]) == ("online", sensor, method)]
            if not chosen:
                continue
            ratio = [
                r["tracking_rms_m"] / r["tracking_rms_known_m"]
                for r in chosen
                if not r["crashed"] and r["tracking_rms_m"] is not None
            ]
            entry: dict[str, Any] = {
                "sensor": sensor, "method": method, "flights": len(chosen),
                "crashed": sum(r["crashed"] for r in chosen),
                "crashed_as_printed": sum(r.get("crashed_as_printed_after_s") is not None for r in chosen),
                "tracking_over_known": _digits(np.mean(ratio)) if ratio else None,
            }  # fmt: skip
            for name in CONVERGENCE_BANDS:
                for when in ("first", "stays"):
                    times = sorted(math.inf if (t := r["times"][name][when]) is None else t for r in chosen)
                    middle = float(np.median(times))
                    entry[f"{name}_{when}"] = {
                        "median_s": middle if math.isfinite(middle) else None,
                        "worst_s": times[-1] if math.isfinite(times[-1]) else None,
                        "never": sum(math.isinf(t) for t in times),
                    }
            found.append(entry)
    return found


def summary(cells: Sequence[Record]) -> dict[str, Any]:
    """Summary of the agreement with the paper, and of the quality of crazyem's estimates."""
    result: dict[str, Any] = {}
    published = [c for c in cells if c["published"] and c["published"]["n"] > 1]
    if published:
        result["cells"] = len(published)
        result["cells_overlapping"] = sum(c["published"]["overlap"] for c in published)
        result["cells_not_overlapping"] = [_name(c) for c in published if not c["published"]["overlap"]]
        result["widths"] = _widths(published, "width_ratio")
        if any(c["published"].get("curve_width_ratio") for c in published):
            result["widths_of_curves"] = _widths(published, "curve_width_ratio")
    ours = [c for c in cells if c["crazyem"]]
    for experiment in ("offline", "online"):
        for group in ("mass", "inertia"):
            some = [
                c["crazyem"]
                for c in ours
                if c["experiment"] == experiment and (c["parameter"] == "mass") == (group == "mass")
            ]
            covered = [c for c in some if "coverage" in c]
            if some:
                result[f"crazyem_{experiment}_{group}"] = {
                    "largest_bias": _digits(max((c["bias"] for c in some), key=abs)),
                    "rms_over_bound": _digits(np.sqrt(np.mean([c["rms_over_bound"] ** 2 for c in some]))),
                    "coverage": _digits(
                        sum(c["coverage"] * c["intervals"] for c in covered) / sum(c["intervals"] for c in covered)
                    )
                    if covered
                    else None,
                }
    return result


def _widths(cells: Sequence[Record], key: str) -> dict[str, Any]:
    """Width of the published method's ranges over the paper's width; offline with one definition of the range only."""
    ratios = {_name(c): c["published"].get(key) or c["published"]["width_ratio"] for c in cells}

    def mean(names: Sequence[str]) -> float | None:
        some = [ratios[n] for n in names if ratios[n] > 0]
        return _digits(np.exp(np.mean(np.log(some)))) if some else None

    return {
        "all": mean([*ratios]),
        "mass": mean([n for n in ratios if n.endswith("mass")]),
        "inertia": mean([n for n in ratios if not n.endswith("mass")]),
        "least": min(ratios.values()),
        "largest": max(ratios.values()),
        "out_of_half_to_double": [n for n, v in ratios.items() if not 0.5 <= v <= 2],
    }


def _name(one: Record) -> str:
    return f"{one['experiment']} {one['sensor']} {one['parameter']}"
