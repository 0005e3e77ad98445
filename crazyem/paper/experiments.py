"""The paper's simulations as tasks, one per experiment, sensor, method and seed; the name determines the result.

A record is JSON data: SI units, numbers rounded to seven digits, null for NaN and infinity. `timing` is a separate
entry, so that all other entries can be compared bit by bit.
"""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.paper.bound import bound
from crazyem.paper.flight import Flight, fly
from crazyem.paper.product import ProductOnline, product_offline
from crazyem.paper.published import PublishedOnline, published_offline
from crazyem.paper.published_values import PARAMETERS
from crazyem.paper.settings import Settings

SETTLED_SECONDS = 8.0  # s: windows of an online flight that begin later count as converged
OFFLINE_ITERATIONS = 20  # of EM, offline
PATH_POINTS = 200
_DENSE, _EVERY = 50, 10  # updates whose intervals are stored: the first 50, then every tenth
_CRASH_CHECK_PERIOD = 25  # updates between two checks for a crash
CONVERGENCE_BANDS = {
    "mass_5": (0, 0.05),
    "mass_1": (0, 0.01),
    "Ixx_25": (1, 0.25),
    "Iyy_25": (2, 0.25),
    "Izz_25": (3, 0.25),
}


@dataclass(frozen=True, order=True)
class Task:
    """One simulation.

    Attributes:
        experiment: table1, offline or online.
        sensor: A, B or C.
        method: published, crazyem, bound (offline: Cramer-Rao bound of the flight) or filter (table1).
        seed: of all noise.
    """

    experiment: str
    sensor: str
    method: str
    seed: int

    @property
    def name(self) -> str:
        """Name of the task, for its file and in messages."""
        return f"{self.experiment}-{self.sensor}-{self.method}-{self.seed:04d}"


def plan(experiments: Iterable[str], sensors: Iterable[str], methods: Iterable[str], seeds: int) -> list[Task]:
    """All requested tasks, in an order that suits parallel processes without compiled kernels.

    The first task of each kind compiles its kernels. While one process compiles the estimator, the others get tasks
    without the estimator. Short tasks come last, so that all processes finish at about the same time.
    """
    experiments, sensors, methods = tuple(experiments), tuple(sensors), tuple(methods)

    def group(experiment: str, method: str, *needs: str) -> list[Task]:
        if experiment not in experiments or not set(needs) <= set(methods):
            return []
        return [Task(experiment, s, method, k) for s in sensors for k in range(seeds)]

    online, offline = group("online", "crazyem", "crazyem"), group("offline", "crazyem", "crazyem")
    tasks = online[:1] + group("online", "published", "published") + offline[:1] + group("offline", "bound")
    tasks += online[1:] + offline[1:] + group("offline", "published", "published")
    if "table1" in experiments:
        tasks += [Task("table1", "A", "filter", k) for k in range(seeds)]
    return tasks


def run_task(task: Task, settings: Settings) -> dict[str, Any]:
    """Run a task; the record holds the parts of its name, the results, and `timing`."""
    run: Callable[[Task, Settings], dict[str, Any]] = {
        ("table1", "filter"): _table1,
        ("offline", "published"): _offline_published,
        ("offline", "crazyem"): _offline_crazyem,
        # bound of the whole flight; offline both methods have the same flight, so one bound serves both
        ("offline", "bound"): lambda task, of: _bounds(fly(of, task.seed), task.sensor, 0, of.steps + 1),
        ("online", "published"): _online_published,
        ("online", "crazyem"): _online_crazyem,
    }[task.experiment, task.method]
    begin, cpu = time.perf_counter(), time.process_time()
    results = run(task, settings)
    timing = {
        "seconds": round(time.perf_counter() - begin, 4),
        "cpu_seconds": round(time.process_time() - cpu, 4),  # hardly depends on other processes
        **results.pop("timing", {}),
    }
    return {
        "experiment": task.experiment, "sensor": task.sensor, "method": task.method, "seed": task.seed,
        **results, "timing": timing,
    }  # fmt: skip


def short(value: Any) -> Any:
    """Numbers to seven digits for JSON; arrays become lists, NaN and infinity null."""
    if isinstance(value, np.ndarray | list | tuple):
        return [short(v) for v in value]
    number = float(value)
    return float(f"{number:.7g}") if math.isfinite(number) else None


# offline ------------------------------------------------------------------------------------------------------


def _table1(task: Task, settings: Settings) -> dict[str, Any]:
    flight = fly(settings, task.seed)
    error = flight.estimate - flight.truth
    record: dict[str, Any] = {}
    for name, columns in (("position", slice(0, 3)), ("angles", slice(6, 9))):
        # errors per axis: the printed sd over mean is 0.755 = sqrt(pi / 2 - 1), the ratio for |Gaussian| numbers
        size = np.abs(error[:, columns])
        record[name] = {"mean": short(size.mean()), "sd": short(size.std()), "max": short(size.max())}
    # Fig. 5: share of all components inside the limits of the text
    record["velocity_within"] = short(np.mean(np.abs(error[:, 3:6]) < 3e-2))
    record["rate_within"] = short(np.mean(np.abs(error[:, 9:12]) < 0.15))
    return record


def _offline_published(task: Task, settings: Settings) -> dict[str, Any]:
    flight = fly(settings, task.seed)
    theta = published_offline(flight, task.sensor, iterations=OFFLINE_ITERATIONS)
    record: dict[str, Any] = {"theta": short(theta), "final": short(theta[-1])}
    if task.sensor == "C":
        theta = published_offline(flight, "C", angles="dead-reckoned", iterations=OFFLINE_ITERATIONS)
        record["dead_reckoned"] = short(theta[-1])
    return record


def _offline_crazyem(task: Task, settings: Settings) -> dict[str, Any]:
    fit = product_offline(fly(settings, task.seed), task.sensor)
    return {
        "final": short(fit.value), "sd": short(fit.sd), "ci95": short(fit.ci95), "converged": bool(fit.converged),
        "theta": short(fit.history),
    }  # fmt: skip


def _bounds(flight: Flight, sensor: str, first: int, last: int) -> dict[str, Any]:
    free = bound(flight, sensor, first, last)
    return {
        "bound": short(free.sd),
        "bound_noise_known": short(free.under("known").sd),
        "bound_noise_single": short(free.under("single").sd),
    }


# online -------------------------------------------------------------------------------------------------------


def window_ends(settings: Settings) -> list[int]:
    """End rows (exclusive) of disjoint windows, placed from the end, that begin after 8 s; at least the last window."""
    ends = list(range(settings.steps + 1, settings.window, -settings.window))
    late = [end for end in ends if (end - settings.window) * settings.dt >= SETTLED_SECONDS]
    return (late or ends[:1])[::-1]


def thin(count: int) -> list[int]:
    """Indices of the updates whose intervals are stored: the first 50, then every tenth, and the last."""
    return sorted({*range(min(count, _DENSE)), *range(0, count, _EVERY), *([count - 1] if count else [])})


def _fly_online(
    flight: Flight, update: Callable[[Flight], tuple[float, Any]], after: Callable[[], None] | None = None
) -> tuple[NDArray, list[float]]:
    """Fly from m0 and I0: repeat 4 steps, an update, its result to the controller, until the end or a crash.

    Returns: (updates, 4) mass kg, Ixx, Iyy, Izz kg m^2; duration of each update [s].
    """
    s = flight.settings
    mass, inertia = s.mass_start, np.array(s.inertia_start)
    theta, seconds = [], []
    while flight.size <= s.steps:
        flight.advance(s.every, mass=mass, inertia=inertia)
        begin = time.perf_counter()
        mass, inertia = update(flight)
        seconds.append(time.perf_counter() - begin)
        theta.append((float(mass), *(float(i) for i in inertia)))
        if after is not None:
            after()
        if len(theta) % _CRASH_CHECK_PERIOD == 0 and flight.crashed:
            break
    return np.array(theta), seconds


def _online_published(task: Task, settings: Settings) -> dict[str, Any]:
    """The published method as printed; after a crash a second flight with `clamp`, which the record notes."""
    flight = Flight(settings, task.seed)
    theta, seconds = _fly_online(flight, PublishedOnline(settings, task.sensor).update)
    crashed_after = short((flight.size - 1) * settings.dt) if flight.crashed else None
    if flight.crashed:
        flight = Flight(settings, task.seed)
        theta, seconds = _fly_online(flight, PublishedOnline(settings, task.sensor, clamp=True).update)
    record = _online_record(task, flight, theta, seconds)
    return {**record, "crashed_as_printed_after_s": crashed_after}


def _online_crazyem(task: Task, settings: Settings) -> dict[str, Any]:
    flight = Flight(settings, task.seed)
    product = ProductOnline(settings, task.sensor)
    intervals: list[Any] = []

    def keep() -> None:
        estimate = product.estimate
        intervals.append(None if estimate is None else [estimate[name].ci95 for name in PARAMETERS])

    theta, seconds = _fly_online(flight, product.update, keep)
    record = _online_record(task, flight, theta, seconds)
    rows = thin(len(intervals))
    record["interval_rows"] = rows
    record["intervals"] = [None if intervals[i] is None else short(intervals[i]) for i in rows]
    for window in record["windows"]:
        ci95 = intervals[window["update"]]
        window["ci95"] = None if ci95 is None else short(ci95)
    own = list(product.update_seconds)
    if own:  # time of the estimator alone, without handing over samples
        record["timing"] |= {f"estimator_{k}": v for k, v in _quantiles(own).items()}
    return record


def _online_record(task: Task, flight: Flight, theta: NDArray, seconds: list[float]) -> dict[str, Any]:
    s = flight.settings
    windows = []
    for end in window_ends(s):
        update = -(-(end - 1) // s.every) - 1
        if flight.crashed or update >= len(theta):
            continue
        last = min(1 + s.every * (update + 1), flight.size)
        bounds = _bounds(flight, task.sensor, last - s.window, last)
        windows.append({"update": update, "value": short(theta[update]), **bounds})
    step = max(1, s.steps // PATH_POINTS)
    return {
        "theta": short(theta),
        "windows": windows,
        "crashed": bool(flight.crashed),
        "flown_s": short((flight.size - 1) * s.dt),
        "tracking_rms_m": _tracking(flight),
        "tracking_rms_known_m": _tracking(fly(s, task.seed)),
        "times": _times(theta, s),
        "path": [[round(float(v), 4) for v in row] for row in np.nan_to_num(flight.truth[: flight.size : step, :3])],
        "timing": {f"update_{k}": v for k, v in _quantiles(seconds).items()},
    }


def _tracking(flight: Flight) -> float | None:
    """Rms distance from the reference [m] after one window (during the first window the parameters converge)."""
    first = min(flight.settings.window, flight.size // 2)
    error = flight.truth[first : flight.size, :3] - flight.reference[first : flight.size, :3]
    result: float | None = short(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    return result


def _times(theta: NDArray, settings: Settings) -> dict[str, Any]:
    """Times [s] from the start: first update inside each convergence band, and update after which all are inside."""
    truth = np.array([settings.mass, *settings.inertia])
    times = np.minimum(settings.every * (np.arange(len(theta)) + 1), settings.steps) * settings.dt
    found: dict[str, Any] = {}
    for name, (column, share) in CONVERGENCE_BANDS.items():
        inside = np.abs(theta[:, column] / truth[column] - 1) <= share  # NaN is outside
        outside = np.flatnonzero(~inside)
        stays = outside[-1] + 1 if outside.size else 0
        found[name] = {
            "first": short(times[np.argmax(inside)]) if inside.any() else None,
            "stays": short(times[stays]) if stays < len(theta) else None,
        }
    return found


def _quantiles(seconds: list[float]) -> dict[str, float]:
    ms = 1e3 * np.array(seconds)
    return {"median_ms": round(float(np.median(ms)), 4), "p99_ms": round(float(np.percentile(ms, 99)), 4)}
