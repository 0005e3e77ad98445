"""From a goal to a plan: the manoeuvre and its expected result, or the reason why no manoeuvre reaches the goal."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.control.harmonics import Harmonics
from crazyem.control.plan_file import LONGEST, PlanFile, plan_toml
from crazyem.errors import UsageError
from crazyem.estimation.model import NAMES, Noise
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.rotors import THRUST_SCALE
from crazyem.physics.effects.timing import INPUT_DELAY
from crazyem.planning.closed_loop import Flown
from crazyem.planning.discrimination import Odds, Pair
from crazyem.planning.information import Expectation
from crazyem.planning.limits import Limits
from crazyem.planning.optimise import ITERATIONS, Family, Found, optimise, within
from crazyem.vehicle import Vehicle

INTERVAL = 1.96  # standard deviations on each side of a 95 % interval
PARAMETERS = NAMES[:6]  # without the torque offsets, which are nuisances
DEFAULT = NAMES[:4]
SHORTEST = 3.0  # s; a shorter manoeuvre consists mainly of its two ramps
# Effects that a flight shows only in ratios with these parameters: thrust over mass, torque over inertia.
RATIOS = {THRUST_SCALE.name: NAMES[:4]}
PARALLEL = 0.999  # least correlation of parallel columns
Say = Callable[[str], None]


@dataclass(frozen=True)
class Plan:
    """A manoeuvre and its expected result.

    Attributes:
        goal: in words.
        vehicle: its name.
        limits: limits of the manoeuvre.
        manoeuvre: None if no manoeuvre reaches the goal.
        flown: its simulated flight.
        widths: parameter -> expected half width of the 95 % interval, relative (input_delay: s).
        odds: expected odds of a pair of effects.
        reason: why no manoeuvre reaches the goal, and what else would; empty if there is a manoeuvre.
        used: (8,) used shares of the limits.
        seed: of the search.
    """

    goal: str
    vehicle: str
    limits: Limits
    manoeuvre: Harmonics | None
    flown: Flown | None
    widths: dict[str, float]
    odds: Odds | None
    reason: str
    used: tuple[float, ...]
    seed: int

    def to_dict(self) -> dict[str, Any]:
        """For JSON; keys as in docs/reference/json.md."""
        odds = None
        if self.odds is not None:
            odds = {
                name: {"expected_log_odds": e, "decided": d, "wrong": w}
                for name, e, d, w in zip(
                    self.odds.effects, self.odds.expected, self.odds.decided, self.odds.wrong, strict=True
                )
            }
        return {
            "format": "crazyem-plan-summary",
            "version": 1,
            "goal": self.goal,
            "vehicle": self.vehicle,
            "possible": self.manoeuvre is not None,
            "reason": self.reason,
            "duration": None if self.manoeuvre is None else self.manoeuvre.duration,
            "expected_half_widths": dict(self.widths),
            "odds": odds,
            "correlation": None if self.odds is None else self.odds.correlation,
            "largest": self.largest(),
            "seed": self.seed,
        }

    def largest(self) -> dict[str, float] | None:
        """Extreme values of the simulated flight: m from the hover point, deg, rad/s, N; None without a manoeuvre."""
        if self.flown is None:
            return None
        far = np.abs(self.flown.state[:, :3]).max(0).tolist()
        return {
            "x": far[0], "y": far[1], "z": far[2], "tilt": math.degrees(float(self.flown.tilt.max())),
            "body_rate": float(np.abs(self.flown.state[:, 10:13]).max()),
            "least_thrust": float(self.flown.command.min()), "most_thrust": float(self.flown.command.max()),
        }  # fmt: skip

    def __str__(self) -> str:
        if self.flown is None or self.manoeuvre is None:
            return f"{self.goal}: no manoeuvre will do. {self.reason}"
        lines = [f"{self.goal}: {self.manoeuvre.duration:g} s for {self.vehicle}", "expected, before anything is flown"]
        for name, width in self.widths.items():
            said = f"{1e3 * width:.1f} ms" if name == INPUT_DELAY.name else f"{100 * width:.2g} %"
            lines.append(f"  {name:<22}95 % interval ± {said}")
        if self.odds is not None:
            for name, e, d, w in zip(self.odds.effects, self.odds.expected, self.odds.decided, self.odds.wrong):
                lines.append(
                    f"  if it is {name:<17} odds of 20 to 1 for it in {100 * d:.0f} of 100 drones, against it in "
                    f"{100 * w:.0f}; log odds {e:.3g} in the mean"
                )
        at = self.largest()
        assert at is not None
        lines.append(
            f"  at most {at['x']:.2f}, {at['y']:.2f}, {at['z']:.2f} m from the hover point, tilt {at['tilt']:.0f} deg, "
            f"{at['body_rate']:.1f} rad/s, rotors {at['least_thrust']:.3f} to {at['most_thrust']:.3f} N"
        )
        return "\n".join(lines)

    def to_toml(self) -> str:
        """The plan file. Raises UsageError: there is no manoeuvre."""
        if self.manoeuvre is None:
            raise UsageError(f"{self.goal}: no manoeuvre will do. {self.reason}")
        tilt = round(math.degrees(self.limits.tilt), 6)
        return plan_toml(PlanFile(self.manoeuvre, self.limits.box, tilt, self.vehicle), tuple(str(self).splitlines()))


def checked_duration(duration: float) -> float:
    """The duration [s], checked. Raises UsageError: too short or too long."""
    if not SHORTEST <= duration <= LONGEST:
        raise UsageError(f"a plan takes {SHORTEST:g} to {LONGEST:g} s, not {duration:g} s.")
    return duration


def plan_parameters(
    names: Sequence[str],
    vehicle: Vehicle,
    limits: Limits,
    *,
    duration: float,
    criterion: str = "D",
    noise: Noise | None = None,
    known: NDArray[np.float64] | None = None,
    starts: int = 3,
    seed: int = 0,
    iterations: int = ITERATIONS,
    foretold: bool = True,
    say: Say = lambda text: None,
) -> Plan:
    """The manoeuvre that gives the smallest intervals of parameters.

    Args:
        names: of `estimation.model.NAMES`, without torque offsets.
        criterion: "D": the volume of their joint interval; "A": the sum of their relative variances.
        noise: scales; None: the centre of the estimator's prior.
        known: (9, 9) information from earlier flight, in the estimator's coordinates.
        iterations: of the search from each start.
        foretold: whether to compute the expected widths, by simulated flights with noise.

    Raises:
        UsageError: an unknown name, a vehicle without rotors or without reserve, a duration that does not fit.
    """
    names = list(dict.fromkeys(names))
    for name in names:
        if name not in (*PARAMETERS, *RATIOS):
            raise UsageError(f"cannot plan for '{name}' (known: {', '.join((*PARAMETERS, *RATIOS))}).")
    goal = f"narrow {', '.join(names)}"
    expectation = Expectation(vehicle, noise)
    checked_duration(duration)
    scales = [n for n in names if n in RATIOS]
    if scales:
        return _none(goal, vehicle, limits, _only_ratios(scales[0]), seed)
    at = np.array([NAMES.index(n) for n in names])
    fixed = [n for n, i in zip(names, at) if not expectation.setup.free[i]]
    if fixed:
        raise UsageError(f"{vehicle.name} has no {fixed[0]} to be found.")

    def merit(flown: Flown) -> float:
        block = expectation.of(flown, known=known).covariance[np.ix_(at, at)]
        if criterion == "A":
            return -0.5 * len(at) * math.log(float(np.trace(block)))
        return -0.5 * float(np.linalg.slogdet(block)[1])

    found = optimise(
        merit, vehicle, limits, duration=duration, starts=starts, seed=seed, iterations=iterations, say=say
    )
    if not foretold:
        return _plan(goal, vehicle, limits, found, {}, None, seed)
    sd = expectation.reached(found.manoeuvre)
    unit = expectation.setup.unit
    widths = {n: INTERVAL * float(sd[i] * unit[i]) for n, i in zip(names, at)}
    return _plan(goal, vehicle, limits, found, widths, None, seed)


def plan_discrimination(
    first: str,
    second: str,
    vehicle: Vehicle,
    limits: Limits,
    *,
    duration: float,
    starts: int = 2,
    seed: int = 0,
    say: Say = lambda text: None,
) -> Plan:
    """The manoeuvre that best distinguishes two effects; no manoeuvre if even the best one does not.

    Raises:
        UsageError: an unknown effect, or an effect that no flight shows; as `plan_parameters`.
    """
    pair = Pair(first, second, vehicle, limits)
    checked_duration(duration)
    found = optimise(pair.merit, vehicle, limits, duration=duration, starts=starts, seed=seed, iterations=8, say=say)
    odds = pair.odds(found.flown)
    goal = f"tell {first} from {second}"
    if not odds.decides:
        return _none(goal, vehicle, limits, _alike(odds), seed, odds)
    return _plan(goal, vehicle, limits, found, {}, odds, seed)


def can_discriminate(first: str, second: str, vehicle: Vehicle, limits: Limits, *, duration: float = 10.0) -> bool:
    """Whether a manoeuvre without optimisation distinguishes two effects, so that a plan certainly does."""
    try:
        pair = Pair(first, second, vehicle, limits)
        random = np.random.default_rng(0)
        family = Family.drawn(duration, random, vehicle, limits)
        even = family.manoeuvre(np.full(family.size, 1.0 / family.size))
        return pair.odds(within(even, lambda flown: 0.0, vehicle, limits).flown, draws=300).decides
    except UsageError:  # an effect without columns, a drone without reserve
        return False


def _only_ratios(name: str) -> str:
    others = RATIOS[name]
    return (
        f"A flight shows thrust over mass and torque over inertia. The column of {name} is minus the sum of those of "
        f"{', '.join(others)}: they are parallel on every flight (correlation 1). What would tell: "
        f"{CATALOGUE[name].separates}."
    )


def _alike(odds: Odds) -> str:
    texts = " Or: ".join(dict.fromkeys(CATALOGUE[n].separates for n in odds.effects if CATALOGUE[n].separates))
    why = (
        f"their columns are parallel (correlation {odds.correlation:.4f})"
        if odds.correlation > PARALLEL
        else f"the best that was found decides for {min(odds.decided) * 100:.0f} of 100 drones, and their columns have "
        f"a correlation of {odds.correlation:.3f}"
    )
    return f"In this box and time {why}. What would tell: {texts}."


def _none(goal: str, vehicle: Vehicle, limits: Limits, reason: str, seed: int, odds: Odds | None = None) -> Plan:
    return Plan(goal, vehicle.name, limits, None, None, {}, odds, reason, (), seed)


def _plan(
    goal: str, vehicle: Vehicle, limits: Limits, found: Found, widths: dict[str, float], odds: Odds | None, seed: int
) -> Plan:
    return Plan(
        goal, vehicle.name, limits, found.manoeuvre, found.flown, widths, odds, "", tuple(found.used.tolist()), seed
    )
