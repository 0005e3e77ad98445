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

# Relative, about z: with heavy rotors (`Conditions.heavy_rotors`) their own inertia is as sure as that of yaw.
AT_ONCE_SD = 0.25


@dataclass(frozen=True)
class Conditions:
    """What the usual spread of a recording depends on.

    Attributes:
        signals: that were recorded.
        measured_speeds: rotor speeds were measured; else commands are all that is known of the rotors.
        onboard: pose and velocity come from a filter on board.
        inferred_attitude: an attitude shows that was made from other signals.
        no_voltage: no voltage was recorded, and that of the flight's own beginning is taken for all of it.
        own_battery: one of several recordings, each with a battery of its own.
        file_effects: names of the effects that the vehicle file has.
        arm: (2,) m of the rotors. lag: s of the rotors.
        days: by how much thrust (relative) and torque over thrust about x, y, z [m] differ from day to day, and degrees
            of freedom of their distribution; None: as other drones do.
        speed: (3,) m/s, root mean square of the velocity, world axes.
        period: s between commands (or speeds) of the rotors, as a model uses them.
        unlogged_share: 0 to 1, by how much commands between the logged ones may falsify torques, relative.
        other_clock: the commands are on another clock: what turned the drone is not in them.
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
        """Whether the vehicle file holds the trim of another day: it is the file of one drone, not of its kind."""
        return "trim" in self.file_effects

    @property
    def shows_rotation(self) -> bool:
        """Whether the turning of the drone shows."""
        return bool({"body_rate", "attitude"} & self.signals)

    @property
    def heavy_rotors(self) -> bool:
        """Rotors that are heavy answer with torque at once, without the lag that hides what sampled commands miss."""
        return not self.other_clock and not self.measured_speeds and self.rotor_inertia > 0.0


Sizes = Mapping[str, float]  # parameter -> standard deviation
# parameter -> departure from neutral: either way, or below and above
Limits = Mapping[str, float | tuple[float, float]]


@dataclass(frozen=True)
class Prior:
    """Standard deviations of an effect's parameters about neutral.

    Attributes:
        own: where the effect is missing; empty: nobody asks for it.
        usual: from recording to recording; or as a function of the conditions.
        per: what the sizes of a parameter are shares of: "mass" or "inertia" (about x) of the vehicle, or
            "neutral", the parameter's own neutral value; SI where absent.
        centre: what recordings have on average anyway, where that is not neutral; or as a function of the conditions.
        freedom: degrees of freedom of Student's t distribution, which `usual` is the scale of; infinite: a normal one.
        conditional: `usual` depends on what was found, so that of one recording it may be none under some models.
        signed: `usual` goes below the physical range, too: a delay that is counted may be counted too long.
        each: whether several recordings that are fitted together have a deviation each.
        together: correlation of `own` between the parameters.
        systematic: within which a parameter is never known, whatever a fit says: what no scatter shows; SI.
        relative_error: the same as a share of the parameter, of the drone's mass where `per` says so.
        relative_error_chaotic: the same in flights that drive the effect into chaos (`divergence.py`).
        usual_named: whether what is usual is named all the same, where it explains more than none of it.
        finding: (values, neutral values, conditions) -> whether that is a finding, where no single limit says so.
        detection_limit: departures that filters, the sampling of a log and the air of a room look like; less is no
            finding. Or as a function of the choices (`Parameter.chosen`) and of the conditions.
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
        """From recording to recording, under some conditions."""
        return self.usual(conditions) if callable(self.usual) else self.usual

    def centre_in(self, conditions: Conditions) -> Sizes:
        """On average, under some conditions."""
        return self.centre(conditions) if callable(self.centre) else self.centre

    def freedom_in(self, conditions: Conditions) -> float:
        """Degrees of freedom, under some conditions."""
        return self.freedom(conditions) if callable(self.freedom) else self.freedom

    def detection_limit_in(self, chosen: Mapping[str, Any], conditions: Conditions) -> dict[str, tuple[float, float]]:
        """Parameter -> smallest departures below and above neutral that are a finding, in the units of `own`."""
        limit = self.detection_limit(chosen, conditions) if callable(self.detection_limit) else self.detection_limit
        return {n: size if isinstance(size, tuple) else (size, size) for n, size in limit.items()}

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
