"""A cold start in closed loop: the controller uses the estimates from the start, without knowing the parameters.

The paper (XI) starts controller and estimator with a mass of 1 g for a drone of 180 g, and gives the drone new
parameters every 20 ms. Here the estimator is the product's own, unchanged; its inputs are measurements and commands.
The drone starts in the air at rest, as in the paper, or on a floor. From the floor, thrust ramps up until the position
sensor shows lift-off. Then the controller takes over, but not before the first estimate.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import UsageError
from crazyem.estimation.result import Estimate
from crazyem.paper.bound import bound
from crazyem.paper.flight import Flight
from crazyem.paper.product import estimator_for
from crazyem.paper.settings import Settings

NAMES = ("mass", "Ixx", "Iyy", "Izz")
SENSORS = "ABC"
EARLY_SECONDS = 2.5  # s after lift-off at which the estimate is compared with the Cramer-Rao bound
SETTLED_SECONDS = 4.0  # s after lift-off: the window is full; tracking is compared from here on
BANDS = {"mass within 5 %": (slice(0, 1), 0.05), "mass within 1 %": (slice(0, 1), 0.01),
         "inertia within 25 %": (slice(1, 4), 0.25)}  # fmt: skip


# Default settings.
SMOOTH_SETTINGS = replace(Settings(), smooth=True)
STEP_SETTINGS = Settings()


@dataclass(frozen=True)
class Settling:
    """Time at which an estimate enters a band around the truth [s after lift-off]; infinity for never.

    Attributes:
        first: first time inside.
        stays: time from which on it is inside until the window is full.
        leaves_later: whether it is outside at any later time. This is the spread of a full window, not of a cold start.
    """

    first: float
    stays: float
    leaves_later: bool


@dataclass(frozen=True)
class ColdStart:
    """One flight with unknown parameters.

    Attributes:
        seed, sensor, ground, smooth: of the flight.
        crashed: upside down, far below the start, or not a number.
        lift_off: s, time at which the controller takes over; 0 without a floor.
        left_floor: s, time at which the drone truly leaves the floor; 0 without one.
        settling: band -> Settling.
        sag: m, largest fall below the height at which the controller takes over.
        highest_mass: largest estimate after lift-off over the truth.
        rms: m, position error from 4 s after lift-off on; NaN if the flight ended before.
        rms_known: m, the same of a controller that knows the parameters, with the same noise.
        touch_downs: number of returns to the floor after lift-off.
        contact_used: samples on the floor that the estimator used as flight.
        largest_tilt: rad, of roll and pitch after lift-off.
        bound: (4,) Cramer-Rao bound of mass, Ixx, Iyy, Izz, relative, of the first 2.5 s after lift-off; NaN if the
            flight ended before.
        over_bound: (4,) error of the estimate at that time, as a logarithm, over the bound.
        time: (n,) s after lift-off of each estimate that was fed back.
        ratio: (n, 4) mass, Ixx, Iyy, Izz estimated over the truth.
        heights: (m,) m, true, every row from lift-off on.
    """

    seed: int
    sensor: str
    ground: bool
    smooth: bool
    crashed: bool
    lift_off: float
    left_floor: float
    settling: Mapping[str, Settling]
    sag: float
    highest_mass: float
    rms: float
    rms_known: float
    touch_downs: int
    contact_used: int
    largest_tilt: float
    bound: tuple[float, ...]
    over_bound: tuple[float, ...]
    time: NDArray
    ratio: NDArray
    heights: NDArray

    def to_json(self) -> dict[str, Any]:
        """Everything but the three series; infinity and NaN become null."""
        said = {k: v for k, v in asdict(self).items() if k not in ("time", "ratio", "heights")}
        return {k: _plain(v) for k, v in said.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value


class Loop:
    """Drone, controller and estimator, row by row; in each row the controller uses the newest estimate.

    Attributes:
        flight: up to the present row.
        estimator: the product's, started from the paper's values.
        history: row and mass, Ixx, Iyy, Izz of every estimate that was fed back; row 0 is the start.
        contact_used: samples on the floor that the estimator took for flight.
    """

    def __init__(self, settings: Settings, seed: int, sensor: str, *, ground: bool) -> None:
        self.flight = Flight(settings, seed, ground=ground)
        self.sensor = sensor
        self.estimator = estimator_for(settings, sensor)
        self.history: list[tuple[float, ...]] = [(0, settings.mass_start, *settings.inertia_start)]
        self.contact_used = 0
        self._judged = 0

    def advance(self) -> Estimate | None:
        """Fly one step and give its samples to the estimator; returns the estimate if an update was due."""
        flight = self.flight
        _, mass, *inertia = self.history[-1]
        waits = flight.ground and len(self.history) == 1
        flight.advance(1, mass=None if waits else mass, inertia=np.array(inertia))
        said = None
        # the newest row again, now with its wrench: samples with one time stamp make one node
        for sample in flight.samples(self.sensor, flight.size - 2):
            said = self.estimator.feed(sample) or said
        if self.estimator.counters.nodes > self._judged:
            self._judged = self.estimator.counters.nodes
            self.contact_used += self.estimator.airborne and bool(flight.contact[self._judged - 1])
        if said is None or not said.samples:
            return None
        self.history.append((flight.size - 1, *(said[name].value for name in NAMES)))
        return said


def cold_start(
    seed: int, sensor: str, *, ground: bool = False, smooth: bool = True, settings: Settings | None = None
) -> ColdStart:
    """Fly once with unknown parameters and once with known ones.

    Args:
        seed: of all noise; the two flights share it.
        sensor: A (position, specific force, body rate), B (full state) or C (position, velocity, body rate).
        ground: start on a floor.
        smooth: whether the reference between waypoints is smooth or has steps.
        settings: of the simulation, `SMOOTH_SETTINGS` or `STEP_SETTINGS` by default; `smooth` overrides its own.

    Raises:
        UsageError: there is no such sensor or seed.
    """
    if sensor not in tuple(SENSORS):
        raise UsageError(f"there is no sensor '{sensor}' (known: {', '.join(SENSORS)})")
    if seed < 0:
        raise UsageError(f"a seed is not negative, {seed} is")
    settings = replace(settings or (SMOOTH_SETTINGS if smooth else STEP_SETTINGS), smooth=smooth)
    loop = Loop(settings, seed, sensor, ground=ground)
    flight, crashed = loop.flight, False
    while flight.size <= settings.steps and not crashed:
        if loop.advance() is not None:
            crashed = flight.crashed
    known = Flight(settings, seed, ground=ground)
    known.advance(settings.steps, mass=settings.mass, inertia=settings.inertia)
    return _judge(loop, known, seed=seed, crashed=crashed or flight.crashed)


def _judge(loop: Loop, known: Flight, *, seed: int, crashed: bool) -> ColdStart:
    flight, settings = loop.flight, loop.flight.settings
    begin = max(flight.lift_off, 0) if flight.ground else 0
    history = np.array(loop.history)
    ratio = history[:, 1:] / np.array([settings.mass, *settings.inertia])
    time = (history[:, 0] - begin) * settings.dt
    lifted = not flight.ground or flight.lift_off >= 0
    contact = flight.contact[begin : flight.size]
    truth = flight.truth[begin : flight.size]
    limit, error = _against_bound(loop, begin, time, ratio)
    return ColdStart(
        seed=seed,
        sensor=loop.sensor,
        ground=flight.ground,
        smooth=settings.smooth,
        crashed=crashed,
        lift_off=begin * settings.dt if lifted else math.inf,
        left_floor=_left_floor(flight) * settings.dt if lifted else math.inf,
        settling={
            name: settling(time, np.all(np.abs(ratio[:, part] - 1) < width, axis=1))
            for name, (part, width) in BANDS.items()
        },
        sag=float(max(0.0, truth[0, 2] - np.nanmin(truth[:, 2]))),
        highest_mass=float(np.max(ratio[time >= 0, 0], initial=0.0)),
        rms=_tracking(flight),
        rms_known=_tracking(known),
        touch_downs=int(np.count_nonzero(contact[1:] & ~contact[:-1])),
        contact_used=loop.contact_used,
        largest_tilt=float(np.nanmax(np.abs(truth[:, 6:8]))),
        bound=limit,
        over_bound=error,
        time=time,
        ratio=ratio,
        heights=truth[:, 2].copy(),
    )


def settling(time: NDArray, inside: NDArray, *, until: float = SETTLED_SECONDS) -> Settling:
    """Time at which a series enters a band, and time from which on it stays there.

    Args:
        time: (n,) s after lift-off, increasing; an estimate before lift-off counts from lift-off on.
        inside: (n,) bool; each holds until the next.
        until: s; later times count for `leaves_later` alone.
    """
    begun = max(0, int(np.searchsorted(time, 0.0, "right")) - 1)  # the estimate in use at lift-off
    time, inside = np.maximum(time[begun:], 0.0), np.asarray(inside, bool)[begun:]
    n = int(np.searchsorted(time, until, "right"))
    early, late = inside[:n], inside[n:]
    if not early.any():
        return Settling(math.inf, math.inf, bool(np.any(~late)))
    outside = np.flatnonzero(~early)
    last = int(outside[-1]) + 1 if len(outside) else 0
    stays = float(time[last]) if last < n else math.inf
    return Settling(float(time[np.argmax(early)]), stays, bool(np.any(~late)))


def _against_bound(loop: Loop, begin: int, time: NDArray, ratio: NDArray) -> tuple[tuple[float, ...], ...]:
    """Bound of the first rows after lift-off, (4,) relative, and the error of the estimate there over the bound."""
    flight = loop.flight
    end = begin + round(EARLY_SECONDS / flight.settings.dt)
    if end >= flight.size or (flight.ground and flight.lift_off < 0):
        return (math.nan,) * 4, (math.nan,) * 4
    limit = bound(flight, loop.sensor, begin, end).sd
    error = np.log(ratio[int(np.searchsorted(time, EARLY_SECONDS, "right")) - 1])
    return tuple(limit.tolist()), tuple((error / limit).tolist())


def _left_floor(flight: Flight) -> int:
    """Row of the last step on the floor before the controller took over."""
    stood = np.flatnonzero(flight.contact[: max(flight.lift_off, 0) + 1])
    return int(stood[-1]) if len(stood) else 0


def _tracking(flight: Flight) -> float:
    """rms position error [m] from 4 s after lift-off to the end, NaN if the flight ended earlier."""
    begin = max(flight.lift_off, 0)
    first = begin + round(SETTLED_SECONDS / flight.settings.dt)
    rows = np.arange(first, flight.size)
    if len(rows) < 2 or (flight.ground and flight.lift_off < 0):
        return math.nan
    error = flight.truth[rows, :3] - flight.reference[rows - begin, :3]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def spread(values: Sequence[float], *, largest_is_worst: bool = True) -> dict[str, float]:
    """Median, 95th percentile and worst. Infinities count; a percentile is one of the values."""
    ordered = np.sort(np.asarray(values, float))
    if not largest_is_worst:
        ordered = ordered[::-1]
    n = len(ordered)
    return {
        "median": float(ordered[(n - 1) // 2]),
        "p95": float(ordered[min(n - 1, math.ceil(0.95 * n) - 1)]),
        "worst": float(ordered[-1]),
    }


def summarise(flights: Sequence[ColdStart]) -> dict[str, Any]:
    """Summary of the flights of one kind: counts, and spreads over the flights without a crash."""
    flew = [f for f in flights if not f.crashed]
    out: dict[str, Any] = {
        "flights": len(flights),
        "crashed": [f.seed for f in flights if f.crashed],
        "contact_used": sum(f.contact_used for f in flights),
        "touch_downs": sum(f.touch_downs for f in flights),
    }
    if not flew:
        return out
    for name in BANDS:
        times = [f.settling[name] for f in flew]
        out[name] = {
            "first": spread([s.first for s in times]),
            "stays": spread([s.stays for s in times]),
            "leaves_later": sum(s.leaves_later for s in times),
        }
    out["sag"] = spread([f.sag for f in flew])
    out["highest_mass"] = spread([f.highest_mass for f in flew])
    out["largest_tilt"] = spread([f.largest_tilt for f in flew])
    out["tracking_ratio"] = spread([f.rms / f.rms_known for f in flew])
    out["bound"] = np.median([f.bound for f in flew], axis=0).tolist()
    out["rms_over_bound"] = np.sqrt(np.mean(np.square([f.over_bound for f in flew]), axis=0)).tolist()
    out["rms"] = float(np.sqrt(np.mean([f.rms**2 for f in flew])))
    out["rms_known"] = float(np.sqrt(np.mean([f.rms_known**2 for f in flew])))
    if flights[0].ground:
        out["lift_off"] = spread([f.lift_off for f in flew])
        out["after_floor"] = spread([f.lift_off - f.left_floor for f in flew])
    return _plain(out)
