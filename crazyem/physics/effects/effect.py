"""What an effect is: a named group of parameters with neutral values, and the places where it changes the rigid body.

The rigid body is every effect at its neutral value. An effect is one file in this folder that makes an `Effect`; the
catalogue finds it there. All functions are vectorised over n moments (steps of a flight, or starts of a prediction)
and take the parameters as keywords. `crazyem/physics/motion.py` puts them together.
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

LONGEST_STEP = 0.1  # s: across a longer one nothing is interpolated


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    Attributes:
        name, unit: SI.
        neutral: the value at which the effect is absent; NaN: the vehicle's own value (see `Effect.neutral`).
        low, high: what is admitted.
        scale: a change that is visible but small, for finite differences and for starting points.
        chosen: a discrete choice (a rotor, a stream, a length from a list), searched and not differentiated.
        among: the value is a list of some of these; `chosen` are the lists that are searched.
        needs, without: as in `Effect`, for this parameter alone.
        usual: how far from neutral it usually is where the effect is there (0: five times `scale`).
        words: for people; "": the name with spaces.
        phrase: what it adds to the effect's words where it has a value, "" if nothing: "of rotor {}".
        spoken: value of a choice -> words for the phrase.
        remark: what goes with a finding of this parameter alone, as a clause.
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
    def said(self) -> str:
        """Its name for people."""
        return self.words or self.name.replace("_", " ")

    def phrase_of(self, value: Any) -> str:
        """What a value adds to the effect's words."""
        if isinstance(value, float):
            value = f"{value:.2f}"
        each = value if isinstance(value, list | tuple) else [value]
        return self.phrase.format(" and ".join(self.spoken.get(str(v), str(v)) for v in each))

    @property
    def width(self) -> float:
        """How far from neutral it usually is, by which it costs a model that it can be anything (`evidence.tuning`)."""
        return self.usual or 5.0 * self.scale


@dataclass(frozen=True)
class Body:
    """What is accelerated. mass kg; inertia (3, 3) kg m^2 about the centre of mass; centre (3,) m from the origin O.

    O is the middle of the rotors; position and velocity of the drone are those of O.
    """

    mass: float
    inertia: NDArray
    centre: NDArray


@dataclass(frozen=True)
class Path:
    """A path at n moments: position (n, 3) m, velocity (n, 3) m/s, world; rotation (n, 3, 3) body to world; body rate
    (n, 3) rad/s. Each is known but for a constant: only what changes from row to row has a meaning."""

    position: NDArray
    velocity: NDArray
    rotation: NDArray
    body_rate: NDArray


@dataclass(frozen=True)
class Situation:
    """Where the drone is and what it does, at n moments; the means over the steps that end there.

    Attributes:
        time: (n,) s, clock of the recording.
        flown: (n,) s since the feet left the floor.
        step: (n,) s, length of each step.
        position: (n, 3) m, world.
        height: (n,) m above the floor, not below 0.
        velocity: (n, 3) m/s, world.
        rotation: (n, 3, 3) body to world.
        body_rate: (n, 3) rad/s, body.
        specific_force: (n, 3) m/s^2, body, of the rigid body as last computed (0 where unknown).
        angular_acceleration: (n, 3) rad/s^2, body, likewise.
        thrust: (n, 4) N of each rotor, after the lag.
        thrust_rate: (n, 4) N/s, its mean derivative over the step.
        voltage: (n,) V; NaN where unknown.
        rotor_constant: N/(rad/s)^2 or NaN.
        air: (n, 3) m/s, world: velocity of the air (wind).
        shaken: whether some effect couples the air to the body (a drag); without, wind is a constant force.
        lagged: (n, 4) N after the lag, before what changes thrust at the same rotor speed; None: as `thrust`.
        swing: (n, 6) direction of a load's string (unit, world) and its derivative [1/s]; None: found along the rows.
        integrated: the path that motion alone makes of rates and accelerations; None: the rows themselves. Rows of a
            filter hold the noise of the very sample that a late stream would explain.
        seen: (n, 3) m/s^2, body: specific force that the drone was seen to have in each step, NaN where it was not;
            None: not known. An effect may go by rows before its own only.
        unrest: (3,) m/s^2 sqrt(s): how much of it comes and goes at random.
        fused: whether the attitude that is shown was made on board, from the gyro (`onboard_estimate.py`).
        model_force: (n, 3) m/s^2, body: specific force by the model alone; None: as `specific_force`, which may hold
            what measurements corrected.
        tilt: (n, 3) rad, body: by how much the attitude that is shown is turned, by other effects; None: not at all.
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
    """What a measurement shows beyond the truth, at n moments.

    Attributes:
        state: (n, 12) position m and velocity m/s (world), attitude rad (body: shown = true * exp(offset)), rate rad/s.
        specific_force: (n, 3) m/s^2, body.
    """

    state: NDArray
    specific_force: NDArray


@dataclass(frozen=True)
class Effect:
    """A named group of parameters and what it does; the functions that are None it leaves alone.

    Attributes:
        name: in vehicle files, reports, `--candidates`.
        parameters: see `Parameter`.
        order: effects act in this order (then by name) where several change the same thing.
        commanded: (thrust (m, 4) N settled, before the lag, at m stamps; time (m,), flown (m,), voltage (m,); hover: N
            of one rotor in hover; limit: N of one rotor at most; **parameters) -> (m, 4). Not applied to measured
            rotor speeds.
        timing: (lag s, delay s; **parameters) -> (lag, delay) of the rotors' thrust.
        speed: (thrust (m, 4) N from measured rotor speeds; **parameters) -> (m, 4). Only where speeds are measured.
        rotors: (situation; **parameters) -> (n, 4) thrust after the lag [N].
        turning: (torque (n, 3) of the rotors about O; **parameters) -> (n, 3).
        body: (body; **parameters) -> body.
        air: (situation; **parameters) -> (n, 3) velocity of the air, world, added up.
        couples_air: whether the effect lets moving air act on the drone.
        external: (situation; body; **parameters) -> Wrench, added up.
        tied: the same, for a force that itself answers to the drone's acceleration: here `situation.specific_force`
            is that at O under everything else.
        measured: (situation; **parameters) -> Offset, added up.
        uses_force: whether `measured` goes by `situation.model_force` and `situation.tilt`: then effects on forces and
            on the attitude that is shown change what it shows, too.
        needs: at least one of these signals must be recorded, else nothing can be said: "voltage", "rotor_speed",
            "motor_command", "specific_force", "position", "attitude", "body_rate", "velocity".
        without: signals with which it cannot be (sag in time only matters where no voltage is known).
        separates: what would tell it from its look-alikes, in words; see `advice`.
        spared: signal -> the words of `separates` that ask for it.
        alike: correlation of how far its parameters usually are from neutral (`Parameter.usual`).
        nudge: small values at which every parameter matters (a ground effect's height says nothing at strength 0);
            the fit begins with derivatives there. Empty: neutral will do.
        amplitude: the parameter without which the others say nothing ("strength"); "" if there is none.
        alternatives: sets of parameters that are fitted together, one of which is enough; empty: all of them.
        beginnings: parameter -> values to begin from, where the likelihood may have several maxima.
        sizes: values of the amplitude with which beginnings are compared in full, where a small one says little.
        words: the effect for people; "": the name with spaces.
        belongs_to: "vehicle", or "recording" where each recording has its own: what a sensor or a filter on board shows
            on that day, which no vehicle file is to have; or "day": the air or the link of that day, which a vehicle
            file has, and a simulator's file has not.
        prior: how large its parameters are.
        needs_torques: told by torques from sample to sample, of which commands on another clock say nothing.
        steady_force: told by forces that last, which no torque at random looks like.
        steady_torque: whether it makes a torque that lasts, as a trim does.
        shifts_centre: whether it moves the centre of mass.
        slow_torque: whether it acts by a torque that goes with velocity, which commands on another clock still show.
        imbalance: what it does to the steady thrust and torque of a drone: "thrust", all rotors lack a share; "mean
            thrust", so on average over a flight; "rotor", one rotor lacks a share; "load", a weight sits on board;
            "air", a torque about x and y; "", nothing that is known.
        lifts: whether it acts up and down as a weight does.
        needs_voltage: whether nothing can be said of its size without the voltage of the battery.
        twins: effects that are nearly the same to every signal: fitted where it is fitted, and never beside it.
        never_beside: sets of effects that together are the same as it.
        same_as: effects that are exactly the same to every signal -> their choices with which they are.
        common_factor: the effect that it is where all its parameters change by one factor; "": none.
        fixed_beside: effects found beside which it is not free within what is usual: both go along a ridge.
        mistaken_for: effects that are named where it is there, which is itself never named.
        imitators: effects that may look like it although derivatives at nothing say nothing of them -> where such a fit
            begins.
        own_likelihood: whether another likelihood than that of the filter speaks of it, or none.
        on_request: whether it is looked for only if asked for.
        of_healthy_rotors: whether flights of the healthy drone give the vehicle file its values.
        admitted: choices -> (low, high) of parameters while they are fitted, less than a file may have.
        most_per_mass: of a parameter over the drone's mass, in its unit over kg: more is something else.
        unphysical: (values; vehicle) -> whether they are more than a drone of this mass and size can have.
        linear_range: departures of its parameters from neutral that one pass of a fit finds; 0: none.
        random: a random process, which adds nothing to the mean motion.
        gain: "thrust" or "torque" where its one parameter multiplies that of all rotors.
        own: vehicle -> values of the parameters whose neutral value is the vehicle's.
        constants: parameter -> the constant of a simulator's file that is the same (`simulators/constants.py`).
        about: constants of simulators' files that look wrong without it, the nearest first.
        controllers: whether a controller of the firmware has a parameter for it, which the online estimator has not.
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

    def said(self, values: Values) -> str:
        """The effect in words, with those of its values that say which: "rotor fault of rotor 3"."""
        named = [p.phrase_of(values[p.name]) for p in self.parameters if p.phrase and values.get(p.name) is not None]
        return " ".join([self.words or self.name.replace("_", " "), *named])

    def advice(self, recorded: Container[str]) -> str:
        """What would tell it from its look-alikes, without asking for what is recorded."""
        text = self.separates
        for signal, words in self.spared.items():
            if signal in recorded:
                text = text.replace(words, "")
        return text

    def complete(self, values: Values, own: Values) -> dict[str, Any]:
        """All parameters: those given, else neutral; `own` are the vehicle's values for those whose neutral is NaN."""
        found = {}
        for p in self.parameters:
            neutral = own.get(p.name, 0.0) if isinstance(p.neutral, float) and math.isnan(p.neutral) else p.neutral
            found[p.name] = values.get(p.name, neutral)
        return found


def stretches(situation: Situation) -> tuple[NDArray, NDArray]:
    """Which rows hang together: where a path is broken, nothing before it acts on what comes after.

    Returns: (n,) s from the row before to each row (0 at breaks), (n,) whether a break.
    """
    gap = np.diff(situation.time, prepend=situation.time[:1])
    broken = ~((situation.step > 0) & (situation.step <= LONGEST_STEP) & (gap > 0) & (gap <= LONGEST_STEP))
    broken[:1] = True
    return np.where(broken, 0.0, gap), broken
