"""Possible changes in flight, as data: columns (effect of a change of size one) and hypotheses (groups of columns).

The detector reads these tables and knows no names. If the catalogue (docs: effects.md) has the effect, the hypothesis
has its name. A column acts on the body (force, torque), on a sensor, or as a single impulse on the body.
"""

from dataclasses import dataclass, replace

from crazyem.estimation.in_step import PERIOD
from crazyem.physics.effects import sensing
from crazyem.physics.effects.external_force import WIND
from crazyem.physics.effects.mass_properties import PAYLOAD
from crazyem.physics.effects.rotors import ROTOR_FAULT, THRUST_SCALE, TRIM
from crazyem.vehicle import Vehicle

# Kinds of column; the second number of a column is its axis or rotor.
ROTOR, MASS, CENTRE, THRUST, FORCE, TORQUE, KICK, TURN = range(8)  # acts on the body
POSITION, VELOCITY, ATTITUDE, RATE, VELOCITY_SCALE, RATE_SCALE = range(8, 14)  # acts on a sensor
UNKNOWN_FORCE, FIX_DELAY = 14, 15  # acts on the onboard filter: a force it does not know; later fixes of the pose
ONBOARD = (UNKNOWN_FORCE, FIX_DELAY)
ONCE = (KICK, TURN)
# Sizes without a fault over the typical sizes of a change. The estimate of an onboard filter wanders: in undisturbed
# flights (benchmarks/monitor) its velocity by 1.5 cm/s, its position by 5 mm. That is 3 to 5 % of a typical change. A
# report needs eight times the normal size.
NORMAL_SHARE = 0.01
# Force of a draught [N]: 0.15 m/s (ASHRAE: still air is slower) on a drag of 7 mN s/m (Foerster 2015: 3 to 9).
DRAUGHT = 1e-3
SCALE_WANDER = 0.02  # of the scale of velocities of an onboard filter in undisturbed flights (benchmarks/monitor)


@dataclass(frozen=True)
class Column:
    """A change of size one.

    Attributes:
        kind, index: kind of column, and its axis (0 to 2: x, y, z) or rotor (0 to 3).
        label: of the size in a report. unit: of the size.
        sd: standard deviation of the prior of the size, in this unit: a typical size of the change.
        usual: standard deviation of what happens in a sound flight, too; 0 for `NORMAL_SHARE` of `sd`. A column whose
            usual size is `sd` is no change, but makes others less sure.
    """

    kind: int
    index: int
    label: str
    unit: str
    sd: float
    usual: float = 0.0

    @property
    def changes(self) -> bool:
        """Whether the column is a change."""
        return self.usual < self.sd


@dataclass(frozen=True)
class Hypothesis:
    """A possible change, with the columns that change together; all names have the same prior probability.

    A change that an onboard filter either knows or does not know is two hypotheses of one name.

    Attributes:
        effect: name; rotor: 1 to 4, or None. text: words for people.
        normal: whether it also happens in a sound flight, and is not reported.
        followed: whether the estimator restarts by itself and finds the new value, so that pushes need not stop.
    """

    effect: str
    text: str
    columns: tuple[Column, ...]
    rotor: int | None = None
    followed: bool = False
    normal: bool = False

    @property
    def name(self) -> str:
        """Effect and rotor in one word."""
        return self.effect if self.rotor is None else f"{self.effect} {self.rotor}"


def _axes(kind: int, labels: str, unit: str, sd: float, usual: float = 0.0) -> tuple[Column, ...]:
    return tuple(Column(kind, i, label, unit, sd, usual) for i, label in enumerate(labels.split()))


def _wander(columns: tuple[Column, ...]) -> tuple[Column, ...]:
    return tuple(replace(c, sd=NORMAL_SHARE * c.sd, usual=NORMAL_SHARE * c.sd) for c in columns)


def hypotheses_for(vehicle: Vehicle) -> tuple[Hypothesis, ...]:
    """Hypotheses for a vehicle; faults of single rotors only if its file contains the rotor geometry.

    The priors of sizes are those of changes that matter to a pilot: a third of a rotor's thrust, a fifth of the mass,
    a wind that tilts the drone by some degrees, sensor errors of ten times their noise.
    """
    weight = vehicle.mass * 9.81
    arm = max(vehicle.arm) or 0.05
    force = ("force_x force_y force_z", "N", 0.05 * weight, DRAUGHT)
    rotors = tuple(
        Hypothesis(ROTOR_FAULT.name, f"rotor {k + 1} lost thrust", (Column(ROTOR, k, "loss", "", 0.3),), k + 1)
        for k in range(4)
    )
    body = (
        Hypothesis(THRUST_SCALE.name, "all rotors lost thrust, as of a failing battery", (
            Column(THRUST, 0, "loss", "", 0.2),
        )),
        Hypothesis(PAYLOAD.name, "the mass changed", (
            Column(MASS, 0, "mass", "kg", 0.2 * vehicle.mass),
        ), followed=True),
        Hypothesis("payload_off_centre", "mass and its centre changed", (
            Column(MASS, 0, "mass", "kg", 0.2 * vehicle.mass), *_axes(CENTRE, "x y", "m", 0.1 * arm),
        ), followed=True),
        Hypothesis(WIND.name, "a force set in", _axes(FORCE, *force)),
        Hypothesis(WIND.name, "a force set in", _axes(UNKNOWN_FORCE, *force)),
        Hypothesis(TRIM.name, "a torque set in", (
            *_axes(TORQUE, "torque_x torque_y torque_z", "N m", 0.05 * weight * arm),
        )),
        Hypothesis("impact", "the drone was hit", (
            *_axes(KICK, "velocity_x velocity_y velocity_z", "m/s", 0.3),
            *_axes(TURN, "rate_x rate_y rate_z", "rad/s", 3.0),
        )),
    )  # fmt: skip
    velocity, rate = _axes(VELOCITY, "x y z", "m/s", 0.3), _axes(RATE, "x y z", "rad/s", 0.2)
    sensors = (
        Hypothesis("position_offset", "the position jumped", _axes(POSITION, "x y z", "m", 0.2)),
        Hypothesis("velocity_offset", "the velocity jumped", velocity),
        Hypothesis("attitude_offset", "the attitude jumped", _axes(ATTITUDE, "roll pitch yaw", "rad", 0.1)),
        Hypothesis(sensing.GYRO_BIAS.name, "the body rates are biased", rate),
        Hypothesis(sensing.VELOCITY_SCALE.name, "velocities have another scale", (
            Column(VELOCITY_SCALE, 0, "scale_error", "", 0.5, SCALE_WANDER), *_wander(velocity),
        )),
        Hypothesis("gyro_scale", "body rates have another scale", (
            Column(RATE_SCALE, 0, "scale_error", "", 0.5), *_wander(rate),
        )),
    )  # fmt: skip
    # The firmware's filter adds a fix to the newest prediction, which is up to 10 ms old (PERIOD). Where a prediction
    # slips past a fix, this age jumps.
    slip = Hypothesis("pose_delay", "fixes of the pose became later", (
        *(Column(FIX_DELAY, i, "delay", "s", PERIOD) for i in range(2)),
    ), normal=True)  # fmt: skip
    geometry = vehicle.arm[0] > 0 and vehicle.arm[1] > 0 and vehicle.torque_per_thrust > 0
    return (*(rotors if geometry else ()), *body, *sensors, slip)
