"""Effects as data: named groups of parameters with neutral values, and functions that change the rigid body.

With every effect at its neutral value, the model is the rigid body. A module in this folder defines an `Effect`, and
the catalogue finds it there. All functions are vectorised over n moments (steps of a flight, or starts of a prediction)
and take the parameters as keywords. `crazyem/physics/motion.py` combines them.
"""

import math
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyem.physics.effects.prior import Prior
from crazyem.vehicle import Vehicle

Values = Mapping[str, Any]  # one effect: parameter -> value
Effects = Mapping[str, Values]  # effect -> its parameters; as in a vehicle file

LONGEST_STEP = 0.1  # s; a longer step is a break, without interpolation


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    Attributes:
        name, unit: SI.
        neutral: the value at which the effect is absent; NaN: the vehicle's own value (see `Effect.neutral`).
        low, high: range of allowed values.
        scale: a visible but small change, for finite differences and start values.
        chosen: values of a discrete choice (a rotor, a stream, a length from a list), searched and not differentiated.
        among: the value is a list of some of these; `chosen` are the lists that are searched.
        needs, without: as in `Effect`, for this parameter alone.
        usual: typical distance from neutral if the effect is present (0: five times `scale`).
        words: name for people; "": the name with spaces.
        phrase: text that a value adds to the effect's words, as "of rotor {}"; "" for none.
        spoken: value of a choice -> words for the phrase.
        remark: clause that is added to a finding of this parameter alone.
    """

    name: str
    unit: str
    neutral: Any
    low: float
    high: float
    scale: float
    chosen: tuple[Any, ...] = ()
    among: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    usual: float = 0.0
    words: str = ""
    phrase: str = ""
    spoken: Mapping[str, str] = field(default_factory=dict)
    remark: str = ""

    @property
    def description(self) -> str:
        """Name for people."""
        return self.words or self.name.replace("_", " ")

    def phrase_of(self, value: Any) -> str:
        """Text that a value adds to the effect's words."""
        if isinstance(value, float):
            value = f"{value:.2f}"
        each = value if isinstance(value, list | tuple) else [value]
        return self.phrase.format(" and ".join(self.spoken.get(str(v), str(v)) for v in each))

    @property
    def width(self) -> float:
        """Typical distance from neutral: the width of the prior in the cost of a parameter (`evidence.occam_cost`)."""
        return self.usual or 5.0 * self.scale


@dataclass(frozen=True)
class Body:
    """The rigid body: mass kg; inertia (3, 3) kg m^2 about the centre of mass; centre (3,) m, position of it from O.

    O is the middle of the rotors; position and velocity of the drone are those of O.
    """

    mass: float
    inertia: NDArray
    centre: NDArray


@dataclass(frozen=True)
class Path:
    """A path at n moments: position (n, 3) m, velocity (n, 3) m/s, world; rotation (n, 3, 3) body to world; body rate
    (n, 3) rad/s. Only changes from row to row have a meaning, since each contains an unknown constant."""

    position: NDArray
    velocity: NDArray
    rotation: NDArray
    body_rate: NDArray


@dataclass(frozen=True)
class Situation:
    """State and inputs of the drone at n moments; inputs are means over the steps that end at these moments.

    Attributes:
        time: (n,) s, clock of the recording.
        flown: (n,) s since take-off.
        step: (n,) s, length of each step.
        position: (n, 3) m, world.
        height: (n,) m above the floor, not below 0.
        velocity: (n, 3) m/s, world.
        rotation: (n, 3, 3) body to world.
        body_rate: (n, 3) rad/s, body.
        specific_force: (n, 3) m/s^2, body, as last computed by the model (0 where unknown).
        angular_acceleration: (n, 3) rad/s^2, body, likewise.
        thrust: (n, 4) N of each rotor, after the lag.
        thrust_rate: (n, 4) N/s, its mean derivative over the step.
        voltage: (n,) V; NaN where unknown.
        rotor_constant: N/(rad/s)^2 or NaN.
        air: (n, 3) m/s, world: velocity of the air (wind).
        shaken: whether an effect couples the air to the body (a drag); otherwise wind is a constant force.
        lagged: (n, 4) N after the lag, before effects that change thrust at the same rotor speed; None: as `thrust`.
        swing: (n, 6) direction of a load's string (unit, world) and its derivative [1/s]; None: computed from the rows.
        integrated: path by integration of rates and accelerations; None: the rows themselves. Rows of a filter contain
            the noise of the same sample that a delayed stream would have to explain.
        seen: (n, 3) m/s^2, body: measured specific force in each step, NaN where unknown; None: not known. An effect
            may use only rows before its own.
        unrest: (3,) m/s^2 sqrt(s): intensity of the random part of `seen`.
        fused: whether the measured attitude comes from an onboard filter with the gyro (`onboard_estimate.py`).
        model_force: (n, 3) m/s^2, body: specific force by the model alone; None: as `specific_force`, which may contain
            corrections by measurements.
        tilt: (n, 3) rad, body: error of the onboard filter's attitude by other effects; None: no error.
    """

    time: NDArray
    flown: NDArray
    step: NDArray
    position: NDArray
    height: NDArray
    velocity: NDArray
    rotation: NDArray
    body_rate: NDArray
    specific_force: NDArray
    angular_acceleration: NDArray
    thrust: NDArray
    thrust_rate: NDArray
    voltage: NDArray
    rotor_constant: float
    air: NDArray
    shaken: bool = False
    lagged: NDArray | None = None
    swing: NDArray | None = None
    integrated: "Path | None" = None
    seen: NDArray | None = None
    unrest: NDArray | None = None
    fused: bool = False
    model_force: NDArray | None = None
    tilt: NDArray | None = None

    @property
    def size(self) -> int:
        return len(self.time)

    @property
    def airspeed(self) -> NDArray:
        """(n, 3) m/s: velocity of O through the air, body axes."""
        return np.einsum("nji,nj->ni", self.rotation, self.velocity - self.air)

    def to_body(self, world: NDArray) -> NDArray:
        """(n, 3) or (3,) world vectors in body axes (n, 3)."""
        return np.einsum("nji,nj->ni", self.rotation, np.broadcast_to(world, (self.size, 3)))

    def with_thrust(self, thrust: NDArray) -> "Situation":
        return replace(self, thrust=thrust)


@dataclass(frozen=True)
class Wrench:
    """Force (n, 3) N acting at O and torque (n, 3) N m, body axes."""

    force: NDArray
    torque: NDArray


@dataclass(frozen=True)
class Offset:
    """Errors of measurements (shown less true values) at n moments.

    Attributes:
        state: (n, 12) position m and velocity m/s (world), attitude rad (body: shown = true * exp(offset)), rate rad/s.
        specific_force: (n, 3) m/s^2, body.
        tilt: (n, 3) rad, body: the part of the attitude's error that the onboard filter has itself; None: all of it.
    """

    state: NDArray
    specific_force: NDArray
    tilt: NDArray | None = None

    @property
    def filter_tilt(self) -> NDArray:
        """(n, 3) rad, body: error of the attitude in the onboard filter. A log that is late adds to the error shown."""
        shown: NDArray = self.state[:, 6:9]
        return shown if self.tilt is None else self.tilt


@dataclass(frozen=True)
class Effect:
    """A named group of parameters, with the functions by which it changes the model (None: no change).

    Attributes:
        name: in vehicle files, reports, `--candidates`.
        parameters: see `Parameter`.
        order: effects that change the same quantity act in this order, then by name.
        commanded: (thrust (m, 4) N settled, before the lag, at m stamps; time (m,), flown (m,), voltage (m,); hover: N
            of one rotor in hover; **parameters) -> (m, 4). Not applied to measured rotor speeds.
        timing: (lag s, delay s; **parameters) -> (lag, delay) of the rotors' thrust.
        speed: (thrust (m, 4) N from measured rotor speeds; **parameters) -> (m, 4). Only where speeds are measured.
        rotors: (situation; **parameters) -> (n, 4) thrust after the lag [N].
        turning: (torque (n, 3) of the rotors about O; **parameters) -> (n, 3).
        body: (body; **parameters) -> body.
        air: (situation; **parameters) -> (n, 3) velocity of the air, world, added up.
        couples_air: whether the effect lets moving air act on the drone.
        external: (situation; body; **parameters) -> Wrench, added up.
        tied: the same, for a force that depends on the drone's acceleration; here `situation.specific_force` is the one
            at O under all other forces.
        measured: (situation; **parameters) -> Offset, added up.
        uses_force: whether `measured` uses `situation.model_force` and `situation.tilt`; then its result depends on
            effects on forces and on the measured attitude, too.
        needs: at least one of these signals must be recorded for the effect to be tested: "voltage", "rotor_speed",
            "motor_command", "specific_force", "position", "attitude", "body_rate", "velocity".
        without: signals that must not be recorded (sag in time only matters where no voltage is known).
        separates: advice in words: how to distinguish it from its look-alikes; see `advice`.
        spared: signal -> the words of `separates` that ask for this signal.
        alike: prior correlation between the distances of its parameters from neutral (`Parameter.usual`).
        nudge: small values at which every parameter matters (at strength 0 the height of a ground effect does not); the
            first derivatives of a fit are taken there. Empty: neutral values are used.
        amplitude: the parameter without which the others have no effect ("strength"); "" if there is none.
        alternatives: sets of parameters that are fitted together; one set is enough. Empty: all parameters.
        beginnings: parameter -> start values, where the likelihood may have several maxima.
        sizes: values of the amplitude at which start values are compared in full, where a small one is not enough.
        words: name for people; "": the name with spaces.
        belongs_to: "vehicle"; or "recording": a sensor or an onboard filter in one recording, never part of a vehicle
            file; or "day": the air or the link of a day, part of a vehicle file but not of a simulator's file.
        prior: sizes of its parameters.
        needs_torques: determined by torques from sample to sample; commands on another clock carry no information.
        steady_force: determined by lasting forces, which random torques cannot imitate.
        steady_torque: whether it makes a lasting torque, as a trim does.
        shifts_centre: whether it moves the centre of mass.
        slow_torque: whether it acts by a torque that depends on velocity, which commands on another clock still show.
        imbalance: its effect on the steady thrust and torque: "thrust", all rotors lack a share; "mean thrust", the
            same on average over a flight; "rotor", one rotor lacks a share; "load", a weight on board; "air", a torque
            about x and y; "", unknown.
        lifts: whether it acts up and down as a weight does.
        needs_voltage: whether its size cannot be known without the voltage of the battery.
        twins: effects with nearly the same signals: always compared with it, never in one model with it.
        never_beside: sets of effects that together have its signals: never in one model with it.
        same_as: effects with exactly its signals -> the choices of these effects.
        common_factor: the effect to which it is equal if all its parameters change by one factor; "": none.
        fixed_beside: if one of these effects is found, this one is no free nuisance: together they form a ridge.
        mistaken_for: effects that may be named in its place; it is itself never named.
        imitators: effects that may look like it although their derivative at neutral does not show this -> start values
            of their fit.
        own_likelihood: whether another likelihood than the filter's determines it, or none.
        on_request: whether it is tested only on request.
        of_healthy_rotors: whether flights of the healthy drone determine its values in the vehicle file.
        admitted: choices -> (low, high) of parameters in a fit, narrower than in a file.
        most_per_mass: largest value of a parameter over the drone's mass, in its unit over kg; more is another effect.
        unphysical: (values; vehicle) -> whether the values are impossible for a drone of this mass and size.
        linear_range: distance of its parameters from neutral within which one pass of a fit is enough; 0: none.
        random: a random process without effect on the mean motion.
        gain: "thrust" or "torque" if its one parameter multiplies the thrust or torque of all rotors.
        own: vehicle -> values of the parameters whose neutral value is the vehicle's.
        constants: parameter -> the same constant in a simulator's file (`simulators/constants.py`).
        about: constants of simulators' files that look wrong without it, the nearest first.
        controllers: whether a controller of the firmware has a parameter for it, and the online estimator has none.
    """

    name: str
    parameters: tuple[Parameter, ...]
    order: int = 50
    commanded: Callable[..., NDArray] | None = None
    timing: Callable[..., tuple[float, float]] | None = None
    speed: Callable[..., NDArray] | None = None
    rotors: Callable[..., NDArray] | None = None
    turning: Callable[..., NDArray] | None = None
    body: Callable[..., Body] | None = None
    air: Callable[..., NDArray] | None = None
    couples_air: bool = False
    external: Callable[..., Wrench] | None = None
    tied: Callable[..., Wrench] | None = None
    measured: Callable[..., Offset] | None = None
    uses_force: bool = False
    needs: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    separates: str = ""
    spared: Mapping[str, str] = field(default_factory=dict)
    alike: float = 0.0
    nudge: Values = field(default_factory=dict)
    amplitude: str = ""
    alternatives: tuple[tuple[str, ...], ...] = ()
    beginnings: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    sizes: tuple[float, ...] = ()
    words: str = ""
    belongs_to: str = "vehicle"
    prior: Prior = field(default_factory=Prior)
    needs_torques: bool = False
    steady_force: bool = False
    steady_torque: bool = False
    shifts_centre: bool = False
    slow_torque: bool = False
    imbalance: str = ""
    lifts: bool = False
    needs_voltage: bool = False
    twins: tuple[str, ...] = ()
    never_beside: tuple[frozenset[str], ...] = ()
    same_as: Mapping[str, Values] = field(default_factory=dict)
    common_factor: str = ""
    fixed_beside: tuple[str, ...] = ()
    mistaken_for: tuple[str, ...] = ()
    imitators: Mapping[str, Values] = field(default_factory=dict)
    own_likelihood: bool = False
    on_request: bool = False
    of_healthy_rotors: bool = False
    admitted: Callable[[Values], Mapping[str, tuple[float, float]]] = lambda chosen: {}
    most_per_mass: float = math.inf
    unphysical: Callable[[Values, Vehicle], bool] | None = None
    linear_range: float = 0.0
    random: bool = False
    gain: str = ""
    own: Callable[[Vehicle], dict[str, float]] | None = None
    constants: Mapping[str, str] = field(default_factory=dict)
    about: tuple[str, ...] = ()
    controllers: bool = False

    def description(self, values: Values) -> str:
        """The effect in words, with the values that specify it: "rotor fault of rotor 3"."""
        named = [p.phrase_of(values[p.name]) for p in self.parameters if p.phrase and values.get(p.name) is not None]
        return " ".join([self.words or self.name.replace("_", " "), *named])

    def advice(self, recorded: Container[str]) -> str:
        """Advice how to distinguish it from its look-alikes, without words that ask for a recorded signal."""
        text = self.separates
        for signal, words in self.spared.items():
            if signal in recorded:
                text = text.replace(words, "")
        return text

    def complete(self, values: Values, own: Values) -> dict[str, Any]:
        """Values of all parameters: given ones, else neutral ones; where neutral is NaN, the vehicle's values `own`."""
        found = {}
        for p in self.parameters:
            neutral = own.get(p.name, 0.0) if isinstance(p.neutral, float) and math.isnan(p.neutral) else p.neutral
            found[p.name] = values.get(p.name, neutral)
        return found


def stretches(situation: Situation) -> tuple[NDArray, NDArray]:
    """Time steps and breaks of the rows; rows before a break have no effect on rows after it.

    Returns: (n,) s from the row before to each row (0 at breaks); (n,) bool, whether a row is a break.
    """
    gap = np.diff(situation.time, prepend=situation.time[:1])
    broken = ~((situation.step > 0) & (situation.step <= LONGEST_STEP) & (gap > 0) & (gap <= LONGEST_STEP))
    broken[:1] = True
    return np.where(broken, 0.0, gap), broken
