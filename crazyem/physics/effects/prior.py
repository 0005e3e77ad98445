"""How large the parameters of an effect are: where it is missing from a vehicle file, and in every recording anyway.

Two standard deviations about neutral, of a normal distribution cut to the range of the parameter:

    own    of an effect that a vehicle file lacks: one number for all recordings of the drone;
    usual  of recordings of drones that lack nothing: the day's trim, the offset of a sensor, the lag of a filter. Each
           recording has its own deviation, whether the effect is missing or not.

They stand with the effects, each with its source. Diagnosis knows nothing else of an effect's size.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Logged:
    """What the usual spread of a recording depends on.

    Attributes:
        measured: rotor speeds were measured; else commands are all that is known of the rotors.
        onboard: pose and velocity come from a filter on board.
        voltage: the battery's voltage was recorded.
        filed: names of the effects that the vehicle file has.
        speed: (3,) m/s, root mean square of the velocity, world axes.
        period: s between commands (or speeds) of the rotors.
    """

    measured: bool = False
    onboard: bool = True
    voltage: bool = True
    filed: frozenset[str] = frozenset()
    speed: NDArray = field(default_factory=lambda: np.ones(3))
    period: float = 0.01

    @property
    def coarse(self) -> float:
        """Period of the commands over 10 ms, 0.5 to 2: what a loop does between two of them looks like other inertias,
        torques, lags and dampings, the more the longer it is. Sizes at 100 Hz are those of `fitting/nuisances.py`."""
        return min(max(self.period / 0.01, 0.5), 2.0)

    @property
    def dated(self) -> bool:
        """Whether the vehicle file holds the trim of another day: it is the file of one drone, not of its kind."""
        return "trim" in self.filed


Sizes = Mapping[str, float]  # parameter -> standard deviation
Least = Mapping[str, float | tuple[float, float]]  # parameter -> departure from neutral: either way, or below and above


@dataclass(frozen=True)
class Prior:
    """Standard deviations of an effect's parameters about neutral.

    Attributes:
        own: where the effect is missing; empty: nobody asks for it.
        usual: from recording to recording; or as a function of what was logged.
        per: what the sizes of a parameter are shares of: "mass" or "inertia" (about x) of the vehicle, or
            "neutral", the parameter's own neutral value; SI where absent.
        freedom: degrees of freedom of Student's t distribution, which `usual` is the scale of; infinite: a normal one.
        together: correlation of `own` between the parameters.
        least: departures that filters, the sampling of a log and the air of a room look like: less is no finding. Or
            as a function of the choices (`Parameter.chosen`), and of whether a filter on board made the state.
        unnamed: stands for what no effect of the catalogue is: it competes, and is told as unexplained.
    """

    own: Sizes = field(default_factory=dict)
    usual: Sizes | Callable[[Logged], Sizes] = field(default_factory=dict)
    per: Mapping[str, str] = field(default_factory=dict)
    freedom: float = math.inf
    together: float = 0.0
    least: Least | Callable[[Mapping[str, Any], bool], Least] = field(default_factory=dict)
    unnamed: bool = False

    def usual_in(self, logged: Logged) -> Sizes:
        """From recording to recording, for one as it was logged."""
        return self.usual(logged) if callable(self.usual) else self.usual

    def least_in(self, chosen: Mapping[str, Any], *, onboard: bool) -> dict[str, tuple[float, float]]:
        """Parameter -> smallest departures below and above neutral that are a finding, in the units of `own`."""
        least = self.least(chosen, onboard) if callable(self.least) else self.least
        return {n: size if isinstance(size, tuple) else (size, size) for n, size in least.items()}

    def share(self, name: str, *, mass: float, inertia: float, neutral: float) -> float:
        """What the sizes of a parameter are shares of, of a vehicle of that mass [kg] and inertia about x [kg m^2]; 1
        where they are in SI units."""
        return {"mass": mass, "inertia": inertia, "neutral": neutral}.get(self.per.get(name, ""), 1.0)


def alike(names: str, size: float) -> dict[str, float]:
    """The same size for several parameters, named with spaces between."""
    return dict.fromkeys(names.split(), size)


def in_turn(names: str, *sizes: float) -> dict[str, float]:
    """Sizes of several parameters, named with spaces between."""
    return dict(zip(names.split(), sizes, strict=True))
