"""Priors of the parameters of an effect: of effects missing from a vehicle file, and of usual deviations.

There are two standard deviations about neutral, of a normal distribution cut to the range of the parameter:

    own    of an effect that is missing from a vehicle file: one value for all recordings of the drone;
    usual  of recordings of drones without a missing effect: the trim of a day, the offset of a sensor, the lag of a
           filter. Each recording has its own deviation, with or without a missing effect.

The modules of the effects hold these numbers, each with its source. Diagnosis has no other knowledge of sizes.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Relative standard deviation, with heavy rotors (`Conditions.heavy_rotors`): of the inertia of a rotor and of yaw.
AT_ONCE_SD = 0.25


@dataclass(frozen=True)
class Conditions:
    """Conditions of a recording on which its usual deviations depend.

    Attributes:
        signals: recorded signals.
        measured_speeds: rotor speeds were measured; otherwise only commands are known.
        onboard: pose and velocity come from an onboard filter.
        inferred_attitude: the attitude was computed from other signals.
        no_voltage: no voltage was recorded, and the one at the begin of the flight is used throughout.
        own_battery: one of several recordings, each with its own battery.
        file_effects: names of the effects in the vehicle file.
        arm: (2,) m of the rotors. lag: s of the rotors.
        days: spread from day to day of thrust (relative) and of torque over thrust about x, y, z [m], and degrees of
            freedom of the distribution; None: as for other drones.
        speed: (3,) m/s, root mean square of the velocity, world axes.
        period: s between commands (or speeds) of the rotors, as a model uses them.
        unlogged_share: 0 to 1, relative error of torques because of commands between the logged ones.
        other_clock: the commands are on another clock and do not contain the torques that turned the drone.
        rotor_inertia: kg m^2, gyro_bias: rad/s; of the model.
    """

    signals: frozenset[str] = frozenset()
    measured_speeds: bool = False
    onboard: bool = True
    inferred_attitude: bool = False
    no_voltage: bool = False
    own_battery: bool = False
    file_effects: frozenset[str] = frozenset()
    arm: tuple[float, float] = (0.0, 0.0)
    lag: float = 0.05
    days: tuple[float, float, float, float, float] | None = None
    speed: NDArray = field(default_factory=lambda: np.ones(3))
    period: float = 0.01
    unlogged_share: float = 0.0
    other_clock: bool = False
    rotor_inertia: float = 0.0
    gyro_bias: float = 0.0

    @property
    def individual_file(self) -> bool:
        """Whether the vehicle file contains a trim: then it is the file of one drone, not of a type."""
        return "trim" in self.file_effects

    @property
    def shows_rotation(self) -> bool:
        """Whether body rate or attitude is recorded."""
        return bool({"body_rate", "attitude"} & self.signals)

    @property
    def heavy_rotors(self) -> bool:
        """Whether rotors have inertia: their reaction torque has no lag, so it shows the errors of sampled commands."""
        return not self.other_clock and not self.measured_speeds and self.rotor_inertia > 0.0


Sizes = Mapping[str, float]  # parameter -> standard deviation
# parameter -> distance from neutral: one number for both directions, or (below, above)
Limits = Mapping[str, float | tuple[float, float]]


@dataclass(frozen=True)
class Prior:
    """Standard deviations of an effect's parameters about neutral.

    Attributes:
        own: if the effect is missing from the vehicle file; empty: the effect is not tested.
        usual: from recording to recording; or a function of the conditions.
        per: reference of relative sizes of a parameter: "mass" or "inertia" (about x) of the vehicle, or "neutral", the
            parameter's own neutral value; without an entry, sizes are in SI units.
        centre: mean of the usual deviations, if it is not neutral; or a function of the conditions.
        freedom: degrees of freedom of Student's t distribution with the scale `usual`; infinite: a normal distribution.
        conditional: `usual` depends on the effects found, so for one recording, some models have no such nuisance.
        signed: `usual` extends below the physical range, too: a delay that is subtracted already may be too long.
        each: whether recordings that are fitted together have one deviation each.
        together: correlation of `own` between the parameters.
        systematic: systematic error of a parameter, which the scatter does not show; SI.
        relative_error: systematic error as a share of the parameter, or of the drone's mass if `per` is "mass".
        relative_error_chaotic: `relative_error` in flights in which the effect is chaotic (`Model.diverges`).
        usual_named: whether an effect of usual size is named, if it explains more than no effect.
        finding: (values, neutral values, conditions) -> whether the values are a finding, where a limit is not enough.
        detection_limit: distances from neutral that filters, sampling of a log and the air of a room imitate; smaller
            ones are no finding. Or a function of the choices (`Parameter.chosen`) and of the conditions.
    """

    own: Sizes = field(default_factory=dict)
    usual: Sizes | Callable[[Conditions], Sizes] = field(default_factory=dict)
    per: Mapping[str, str] = field(default_factory=dict)
    centre: Sizes | Callable[[Conditions], Sizes] = field(default_factory=dict)
    freedom: float | Callable[[Conditions], float] = math.inf
    conditional: bool = False
    signed: bool = False
    each: Callable[[Conditions], bool] = lambda conditions: False
    together: float = 0.0
    systematic: Sizes = field(default_factory=dict)
    relative_error: Sizes = field(default_factory=dict)
    relative_error_chaotic: Sizes = field(default_factory=dict)
    usual_named: bool = False
    finding: Callable[[Mapping[str, Any], Mapping[str, Any], Conditions], bool] | None = None
    detection_limit: Limits | Callable[[Mapping[str, Any], Conditions], Limits] = field(default_factory=dict)

    def usual_in(self, conditions: Conditions) -> Sizes:
        """`usual` under the given conditions."""
        return self.usual(conditions) if callable(self.usual) else self.usual

    def centre_in(self, conditions: Conditions) -> Sizes:
        """`centre` under the given conditions."""
        return self.centre(conditions) if callable(self.centre) else self.centre

    def freedom_in(self, conditions: Conditions) -> float:
        """`freedom` under the given conditions."""
        return self.freedom(conditions) if callable(self.freedom) else self.freedom

    def detection_limit_in(self, chosen: Mapping[str, Any], conditions: Conditions) -> dict[str, tuple[float, float]]:
        """Parameter -> smallest distances below and above neutral that are a finding, in the units of `own`."""
        limit = self.detection_limit(chosen, conditions) if callable(self.detection_limit) else self.detection_limit
        return {n: size if isinstance(size, tuple) else (size, size) for n, size in limit.items()}

    def share(self, name: str, *, mass: float, inertia: float, neutral: float) -> float:
        """Reference of the relative sizes of a parameter, for a vehicle's mass [kg] and inertia about x [kg m^2]; 1
        for sizes in SI units."""
        return {"mass": mass, "inertia": inertia, "neutral": neutral}.get(self.per.get(name, ""), 1.0)


def alike(names: str, size: float) -> dict[str, float]:
    """The same size for several parameters; their names are separated by spaces."""
    return dict.fromkeys(names.split(), size)


def in_turn(names: str, *sizes: float) -> dict[str, float]:
    """Sizes of several parameters; their names are separated by spaces."""
    return dict(zip(names.split(), sizes, strict=True))
