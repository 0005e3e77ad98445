"""The manoeuvre of largest merit within limits, by sequential quadratic programming from several starts.

Frequencies are fixed. Each axis has bands of two lines; every line has a whole number of cycles, and no two lines the
same number, so that signals of different axes are uncorrelated. Free are the powers of the bands: information and
squared limits are nearly linear in them (optimal input design; Mehra 1974). Phases are drawn at random for each start;
they affect only the peaks.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from crazyem.control.harmonics import Axis, Harmonics
from crazyem.control.plan_file import HIGHEST_FREQUENCY
from crazyem.planning.closed_loop import Flown, fly
from crazyem.planning.limits import Limits
from crazyem.vehicle import Vehicle

# Hz, lower ends of the bands. Slow motion shows effects that depend on position, speed and heading. Inertia and lag
# need torque, which the loop gives above its attitude bandwidth of about 1 Hz, up to the resonance with the rotor lag
# near 5 Hz.
BANDS = (0.0, 0.7, 1.5, 2.8)
LINES = 2  # lines of a band
RAMP = 1.0  # s
BESIDE = 0.3  # share of the start power that is spread over all bands; the rest is in the chosen bands
SMALL = 0.1  # m/s^2, rad/s^2: rms of a single band, from which its amplitude at the limit is extrapolated
STEP = 0.02  # of a power, for finite differences
NEAR, CANDIDATES = 1.5, 4  # largest squared share of a limit of points that are scaled to the limits; their number
IDLE = 1e-4  # power below which a band is left out of the plan
ITERATIONS = 15  # of sequential quadratic programming from each start

Merit = Callable[[Flown], float]  # to be maximised; nats


@dataclass(frozen=True)
class Found:
    """A manoeuvre, its simulated flight, its merit, and the used shares (8,) of the limits."""

    manoeuvre: Harmonics
    flown: Flown
    merit: float
    used: NDArray[np.float64]


def lines_of(duration: float) -> list[list[tuple[float, ...]]]:
    """Frequencies [Hz] by axis (x, y, z, yaw) and band, all different, with whole cycles in `duration` [s].

    In a short manoeuvre a band may have one line: a second one would be faster than `HIGHEST_FREQUENCY`.
    """
    base = 1.0 / duration
    taken: set[int] = set()
    found: list[list[tuple[float, ...]]] = [[] for _ in range(4)]
    for begin in BANDS:
        cycles = max(1, math.ceil(begin / base))
        for line in range(LINES):
            for axis in range(4):
                while cycles in taken:
                    cycles += 1
                taken.add(cycles)
                if line == 0:
                    found[axis].append((cycles * base,))
                elif cycles * base <= HIGHEST_FREQUENCY:
                    found[axis][-1] = (*found[axis][-1], cycles * base)
            if begin:
                cycles += max(1, round(0.25 * begin / base))  # the second line of a band is a quarter higher
    return found


@dataclass(frozen=True)
class Family:
    """Manoeuvres of one duration with one draw of phases.

    A point (16,) holds the power of each band, axis by axis: its squared rms acceleration over the square of `full`.
    """

    duration: float
    ramp: float
    lines: list[list[tuple[float, ...]]]
    phases: NDArray[np.float64]  # (4, bands, lines) rad
    full: NDArray[np.float64]  # (16,) m/s^2 or rad/s^2, rms acceleration at which a band alone reaches a limit

    @classmethod
    def drawn(cls, duration: float, random: np.random.Generator, vehicle: Vehicle, limits: Limits) -> "Family":
        """A family with random phases."""
        count = 4 * len(BANDS)
        phases = random.uniform(0.0, 2.0 * math.pi, (4, len(BANDS), LINES))
        family = cls(duration, min(RAMP, duration / 4), lines_of(duration), phases, np.full(count, SMALL))
        full = np.empty(count)
        for k, alone in enumerate(np.eye(count)):
            manoeuvre = family.manoeuvre(alone)
            full[k] = SMALL / limits.used(manoeuvre, fly(manoeuvre, vehicle), vehicle).max()
        return replace(family, full=full)

    @property
    def size(self) -> int:
        return 4 * len(BANDS)

    def manoeuvre(self, point: NDArray[np.float64]) -> Harmonics:
        """The manoeuvre of a point (16,)."""
        axes = []
        for a, (bands, phases) in enumerate(zip(self.lines, self.phases)):
            frequency, cosine, sine = [], [], []
            for b, band in enumerate(bands):
                at = a * len(BANDS) + b
                rms = math.sqrt(max(float(point[at]), 0.0)) * float(self.full[at])
                for f, phase in zip(band, phases[b]) if rms > 0.0 else ():
                    size = rms * math.sqrt(2.0 / len(band)) / (2.0 * math.pi * f) ** 2
                    frequency.append(f)
                    cosine.append(size * math.cos(phase))
                    sine.append(size * math.sin(phase))
            axes.append(Axis(tuple(frequency), tuple(cosine), tuple(sine)))
        return Harmonics(self.duration, self.ramp, (axes[0], axes[1], axes[2], axes[3]))


def optimise(
    merit: Merit,
    vehicle: Vehicle,
    limits: Limits,
    *,
    duration: float,
    starts: int = 3,
    seed: int = 0,
    iterations: int = ITERATIONS,
    say: Callable[[str], None] = lambda text: None,
) -> Found:
    """The best manoeuvre of several starts.

    Args:
        merit: function of a simulated flight.
        duration: s.
        starts: number of draws of phases and start amplitudes.
        seed: of these draws; the same seed gives the same plan.

    Raises:
        UsageError: the drone has no reserve of thrust.
    """
    random = np.random.default_rng(seed)
    best: Found | None = None
    for start in range(starts):
        family = Family.drawn(duration, random, vehicle, limits)
        # every second start has random powers: with several goals, the best band of each axis is not enough
        begin = random.dirichlet(np.ones(family.size))
        if start % 2 == 0:
            begin = _begin(family, merit, vehicle, random, first=start == 0)
        found = _from(begin, family, merit, vehicle, limits, iterations)
        say(f"start {start + 1} of {starts}: merit {found.merit:.2f} nats")
        if best is None or found.merit > best.merit:
            best = found
    assert best is not None
    return best


def _begin(
    family: Family, merit: Merit, vehicle: Vehicle, random: np.random.Generator, *, first: bool
) -> NDArray[np.float64]:
    """Start point (16,) of a search: on each axis mostly the band with the largest merit alone, later a random band.

    Peaks of bands add up by amplitude and not by power. So a mixture of two bands is worse than either, and a search
    stays near its first band.
    """
    shape = 4, len(BANDS)
    alone = np.array([merit(fly(family.manoeuvre(e), vehicle)) for e in np.eye(family.size)]).reshape(shape)
    odds = np.exp(alone - alone.max(1, keepdims=True))
    share = np.full(shape, BESIDE / alone.size)
    for axis in range(4):
        chosen = (
            int(np.argmax(alone[axis])) if first else int(random.choice(len(BANDS), p=odds[axis] / odds[axis].sum()))
        )
        share[axis, chosen] += (1.0 - BESIDE) / 4
    return share.ravel()


def _from(
    begin: NDArray[np.float64], family: Family, merit: Merit, vehicle: Vehicle, limits: Limits, iterations: int
) -> Found:
    seen: dict[bytes, tuple[float, NDArray[np.float64]]] = {}

    def look(point: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Merit and squared shares of the limits."""
        key = point.tobytes()
        if key not in seen:
            manoeuvre = family.manoeuvre(point)
            flown = fly(manoeuvre, vehicle)
            used = limits.used(manoeuvre, flown, vehicle)
            seen[key] = merit(flown), used**2
        return seen[key]

    slopes: dict[bytes, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}

    def slope(point: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        key = point.tobytes()
        if key not in slopes:
            value, used = look(point)
            there = [look(point + STEP * e) for e in np.eye(point.size)]
            slopes[key] = (
                np.array([t[0] - value for t in there]) / STEP,
                np.array([t[1] - used for t in there]).T / STEP,
            )
        return slopes[key]

    result = minimize(
        lambda x: -look(x)[0],
        begin / max(1.0, float(look(begin)[1].max())),
        jac=lambda x: -slope(x)[0],
        method="SLSQP",
        bounds=[(0.0, 1.0)] * family.size,
        constraints=[{"type": "ineq", "fun": lambda x: 1.0 - look(x)[1], "jac": lambda x: -slope(x)[1]}],
        options={"maxiter": iterations, "ftol": 1e-3},
    )
    # the search may end at a lower merit or outside the limits: the best points near the limits compete after scaling
    near = sorted((value, key) for key, (value, used) in seen.items() if used.max() <= NEAR)[-CANDIDATES:]
    points = [np.asarray(result.x), *(np.frombuffer(key) for _, key in near)]
    inside = [within(family.manoeuvre(np.where(point < IDLE, 0.0, point)), merit, vehicle, limits) for point in points]
    return max(inside, key=lambda found: found.merit)


def within(manoeuvre: Harmonics, merit: Merit, vehicle: Vehicle, limits: Limits) -> Found:
    """The manoeuvre, scaled down until it keeps all limits."""
    for _ in range(20):
        flown = fly(manoeuvre, vehicle)
        used = limits.used(manoeuvre, flown, vehicle)
        if used.max() <= 1.0:
            break
        manoeuvre = manoeuvre.scaled(0.99 / float(used.max()))
    return Found(manoeuvre, flown, merit(flown), used)
