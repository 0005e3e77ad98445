"""Which parameters of the drone a recording can identify: a verdict, a reason and an expected error for each.

The limits are those of the estimator (crazyem.estimation.verdict): below 15 % the verdict is "yes"; an inertia far from
those of similar drones is rejected. The regressions are in excitation.py.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.doctor import excitation
from crazyem.doctor.excitation import Steps
from crazyem.doctor.kinematics import continuous
from crazyem.doctor.regression import Fit, linear_fit
from crazyem.physics.effects.timing import INPUT_DELAY
from crazyem.physics.rotations import rotation_matrix
from crazyem.recordings.airborne import Airtime
from crazyem.recordings.finding import percent
from crazyem.recordings.ordering import Array, held, sound_signal
from crazyem.recordings.recording import Recording
from crazyem.recordings.thrust import UNKNOWN_VOLTAGE_ERROR, Inputs, inputs_of
from crazyem.vehicle import GRAVITY, Vehicle

IDENTIFIABLE = 0.15  # relative standard deviation below which a parameter counts as identified
WEAKLY_IDENTIFIABLE = 0.5  # the same below which the data add information to the prior
# |log| of an inertia over the nominal one, above which it is rejected: 3 sd of the estimator's prior
IMPLAUSIBLE_INERTIA = 1.5
DOUBTFUL_INERTIA = 1.0  # the same above which the verdict is "weak"
WINDOW_SAMPLES = 800  # default window of the estimator
SHORTEST_AIRTIME = 2.0  # s in the air
ACCELEROMETER_OFFSET = 0.02  # of gravity: 20 mg, typical zero-g offset of a BMI088
TYPICAL_DRAG = 0.2  # 1/s, force per mass and speed: typical rotor drag of a Crazyflie (Foerster 2015)
SCALE_REASON = "only its ratio to the rotors' thrust scale is seen"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether one parameter can be identified."""

    name: str  # one of `VERDICT_NAMES`
    verdict: str  # "yes", "weak" (little information) or "no"
    reason: str  # of the verdict, one clause
    # expected standard deviation from the whole flight, over the value; None if unknown, or if the value may be zero
    relative_sd: float | None = None
    window_relative_sd: float | None = None  # the same for the estimator's default window of 800 samples
    sd: float | None = None  # expected standard deviation in `unit`; None if unknown
    value: float | None = None  # in `unit`, at which the error is computed; a rough fit, not an estimate to use
    unit: str = ""

    def line(self) -> str:
        """For a terminal."""
        size = ""
        if self.relative_sd is not None:
            size = percent(self.relative_sd) if self.relative_sd <= 10.0 else "over 1000 %"
        elif self.sd is not None:
            size = f"{self.sd:.2g} {self.unit}"
        return f"  {self.name:<20} {self.verdict:<5} {size:>12}  {self.reason}"


def identifiability(recording: Recording, vehicle: Vehicle, air: Airtime) -> tuple[Verdict, ...]:
    """Verdicts on mass, inertias, lag, delay, torque offsets, drag and battery law, in this order."""
    if air.seconds < SHORTEST_AIRTIME:
        why = f"only {air.seconds:.1f} s in the air" + (f": {air.reason}" if air.reason else "")
        return tuple(Verdict(name, "no", why) for name in VERDICT_NAMES)
    inputs = inputs_of(recording, vehicle)
    turning, turn_from = _rates(recording, air)
    if isinstance(inputs, str):
        rotation = tuple(Verdict(name, "no", inputs) for name in VERDICT_NAMES[1:7])
        return (Verdict("mass", "no", inputs), *rotation, _drag(recording, air), Verdict("battery_law", "no", inputs))
    fit = excitation.rotation_fit(inputs, turning, vehicle) if turning is not None else None
    tau = math.exp(fit.value[3]) if fit is not None and inputs.lagged else vehicle.motor_time_constant
    delay = fit.value[4] * 1e-3 if fit is not None else 0.0
    vertical = _vertical(recording, air)
    rotation = _rotation(fit, inputs, turning, turn_from, vehicle)
    return (
        _mass(vertical, inputs, tau=tau, delay=delay),
        *rotation,
        _drag(recording, air),
        _battery(recording, vertical, inputs, tau=tau, delay=delay),
    )


VERDICT_NAMES = (
    "mass", "Ixx", "Iyy", "Izz", "motor_time_constant", INPUT_DELAY.name, "torque_offsets", "drag", "battery_law",
)  # fmt: skip


def replay_objection(recording: Recording, vehicle: Vehicle) -> str:
    """Why `crazyem replay` cannot use the recording; empty if it can."""
    inputs = inputs_of(recording, vehicle)
    if isinstance(inputs, str):
        return inputs
    lacking = [name for name in ("position", "attitude") if sound_signal(recording, name) is None]
    lacking += [] if inputs.voltage_known else ["voltage"]
    return f"it has no {' and no '.join(lacking)}" if lacking else ""


# mass ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Vertical:
    """Specific force along body z over steps: response (k,) for each stretch, and its relative systematic error."""

    steps: Steps
    response: list[Array]
    source: str
    systematic: float


def _vertical(recording: Recording, air: Airtime) -> _Vertical | None:
    velocity, attitude = sound_signal(recording, "velocity"), sound_signal(recording, "attitude")
    if velocity is not None:
        steps = excitation.steps_of(*_with_attitude(velocity, attitude), air)
        if steps is not None:
            response = []
            for t, v in zip(steps.nodes, steps.values):
                force = np.diff(v[:, :3], axis=0) / np.diff(t)[:, None] + np.array([0.0, 0.0, GRAVITY])
                turned = rotation_matrix(_unit(0.5 * (v[1:, 3:] + v[:-1, 3:]))) if attitude is not None else np.eye(3)
                response.append(np.sum(force * turned[..., :, 2], axis=1))
            if attitude is not None:
                return _Vertical(steps, response, "velocity and attitude", 0.0)
            # without the tilt, the thrust is off by the mean square of horizontal acceleration over g
            lean = [np.mean((_slow(t, v[:, :2]) / GRAVITY) ** 2) for t, v in zip(steps.nodes, steps.values)]
            return _Vertical(steps, response, "velocity, taken as upright", 0.005 + float(np.max(lean)))
    force = sound_signal(recording, "specific_force")
    if force is not None:
        steps = excitation.steps_of(force[0], force[1], air)
        if steps is not None:
            mean = [0.5 * (v[1:, 2] + v[:-1, 2]) for v in steps.values]
            return _Vertical(steps, mean, "the accelerometer alone", ACCELEROMETER_OFFSET)
    return None


def _mass(vertical: _Vertical | None, inputs: Inputs, *, tau: float, delay: float) -> Verdict:
    if vertical is None:
        return Verdict("mass", "no", "neither velocity nor specific force is known in the air")
    thrust = _thrust(vertical, inputs, tau=tau, delay=delay)
    fit = linear_fit(vertical.response, [f[:, None] for f in thrust], share=vertical.steps.share, parts=4)
    if fit is None or not fit.value[0] > 0.0:
        return Verdict("mass", "no", "thrust and acceleration have no common stretch long enough")
    mass = 1.0 / fit.value[0]
    fixed = math.hypot(vertical.systematic, 0.0 if inputs.voltage_known else UNKNOWN_VOLTAGE_ERROR)
    random = float(fit.sd[0] * mass)
    relative = math.hypot(random, fixed)
    reason = f"{SCALE_REASON}; from {vertical.source}"
    if not inputs.voltage_known:
        reason += "; the battery voltage is not logged, which alone costs 15 %"
    elif vertical.systematic > random:
        reason += f", which alone may be off by {percent(vertical.systematic)}"
    return Verdict(
        "mass", _grade(relative), reason, relative, math.hypot(random * _stretch(vertical.steps), fixed),
        relative * mass, mass, "kg",
    )  # fmt: skip


def _thrust(vertical: _Vertical, inputs: Inputs, *, tau: float, delay: float) -> list[Array]:
    tau = tau if inputs.lagged else 0.0
    return [mean[:, 0] for mean, _, _ in excitation.lagged(inputs, vertical.steps, tau=tau, delay=delay)]


def _slow(time: Array, velocity: Array) -> Array:
    """Horizontal acceleration over 0.2 s: over this time noise does not matter."""
    far = max(1, round(0.2 / float(np.median(np.diff(time)))))
    if time.size <= far:
        return np.zeros((1, velocity.shape[1]))
    return (velocity[far:] - velocity[:-far]) / (time[far:] - time[:-far])[:, None]


# rotation ------------------------------------------------------------------------------------------------------


def _rates(recording: Recording, air: Airtime) -> tuple[Steps | None, str]:
    rate = sound_signal(recording, "body_rate")
    if rate is not None:
        return excitation.steps_of(rate[0], rate[1], air), "body rate"
    attitude = sound_signal(recording, "attitude")
    if attitude is not None and attitude[0].size > 2:
        return excitation.steps_of(*excitation.rates_of_attitude(*attitude), air), "attitude alone"
    return None, ""


def _rotation(
    fit: Fit | None, inputs: Inputs, steps: Steps | None, turn_from: str, vehicle: Vehicle
) -> tuple[Verdict, ...]:
    if fit is None or steps is None:
        why = (
            "neither body rate nor attitude is known" if not turn_from else f"too little of the {turn_from} in the air"
        )
        return tuple(Verdict(name, "no", why) for name in VERDICT_NAMES[1:7])
    rate = 1.0 / steps.period
    where = f"{turn_from} at {rate:.0f} Hz, {inputs.signal} at {1.0 / float(np.median(np.diff(inputs.time))):.0f} Hz"
    inertias = [_inertia(i, fit, inputs, steps, vehicle, where) for i in range(3)]
    far = np.abs(fit.value[:3] - np.log(vehicle.inertia))
    believed = bool(np.all(far[:2] <= IMPLAUSIBLE_INERTIA))  # torque about z is too small to judge Izz
    doubtful = math.hypot(*far) > 1.3 * DOUBTFUL_INERTIA
    return (
        *inertias,
        _lag(fit, inputs, steps, believed=believed, doubtful=doubtful),
        _delay(fit, inputs, believed),
        _offsets(fit, vehicle),
    )


def _inertia(i: int, fit: Fit, inputs: Inputs, steps: Steps, vehicle: Vehicle, where: str) -> Verdict:
    name, axis, value = VERDICT_NAMES[1 + i], "xyz"[i], math.exp(fit.value[i])
    far = np.abs(fit.value[:3] - np.log(vehicle.inertia))
    fixed = 0.0 if inputs.voltage_known else UNKNOWN_VOLTAGE_ERROR
    relative = math.hypot(fit.total(i), fixed)
    window = math.hypot(fit.total(i, stretch=1.0 / _stretch(steps) ** 2), fixed)
    verdict, reason = _grade(relative), where
    if verdict != "yes":
        reason = _objection(axis, relative, fit.total(i), float(fit.bias[i]))
    if far[i] > IMPLAUSIBLE_INERTIA or (i < 2 and far[1 - i] > IMPLAUSIBLE_INERTIA):
        worst = i if far[i] > IMPLAUSIBLE_INERTIA else 1 - i
        relative, window, verdict = max(relative, float(far[worst])), max(window, float(far[worst])), "no"
        ratio = math.exp(fit.value[worst]) / vehicle.inertia[worst]
        reason = (
            f"the data ask for {ratio:.2g} times the nominal inertia about {'xyz'[worst]}: the logged commands do not "
            "explain its rotation"
        )
    elif verdict == "yes" and (
        far[i] > DOUBTFUL_INERTIA or far.max() > IMPLAUSIBLE_INERTIA or math.hypot(*far) > 1.3 * DOUBTFUL_INERTIA
    ):
        times = ", ".join(f"{math.exp(f - math.log(n)):.2g}" for f, n in zip(fit.value[:3], vehicle.inertia))
        verdict = "weak"
        reason = f"the data ask for {times} times the nominal inertias, which is hard to believe of such a drone"
    return Verdict(name, verdict, reason, relative, window, relative * value, value, "kg m^2")


def _objection(axis: str, relative: float, random: float, bias: float) -> str:
    """Why an inertia is not identified."""
    if bias > IDENTIFIABLE:
        return (
            f"the logged commands are mostly noise between their stamps: torque about {axis} that acted cannot be told "
            "from them at this logging rate"
        )
    if random < IDENTIFIABLE:
        return "the battery voltage is not logged, which alone costs 15 %"
    if relative > 10.0:
        return f"no excitation: torque about {axis} says nothing of it"
    return f"too little excitation: torque about {axis} determines it only within {196 * relative:.0f} % (95 %)"


def _lag(fit: Fit, inputs: Inputs, steps: Steps, *, believed: bool, doubtful: bool) -> Verdict:
    name = "motor_time_constant"
    if not inputs.lagged:
        return Verdict(name, "no", f"{inputs.signal} already includes the rotor lag", unit="s")
    tau = math.exp(fit.value[3])
    relative, window = fit.total(3), fit.total(3, stretch=1.0 / _stretch(steps) ** 2)
    if not believed:
        return Verdict(name, "no", "the logged commands do not explain the rotation", unit="s")
    verdict, reason = _grade(relative), "from the phase of rotation behind torque"
    if verdict != "yes":
        reason = f"too little excitation: commands determine it only within {196 * relative:.0f} % (95 %)"
    elif doubtful:
        verdict, reason = "weak", "the inertias that go with it are hard to believe"
    return Verdict(name, verdict, reason, relative, window, relative * tau, tau, "s")


def _delay(fit: Fit, inputs: Inputs, believed: bool) -> Verdict:
    prior = 1e3 * excitation.delay_sd(inputs)
    own = fit.total(4)
    together = own / math.hypot(1.0, own / prior)
    if not believed:
        return Verdict(INPUT_DELAY.name, "no", "the logged commands do not explain the rotation", unit="s")
    verdict = "yes" if together < 0.7 * prior else "weak" if together < 0.9 * prior else "no"
    phase, prior_only = "from the phase of rotation behind torque", "the data say no more than the prior does"
    reason = phase if verdict == "yes" else prior_only
    return Verdict(INPUT_DELAY.name, verdict, reason, sd=own * 1e-3, value=float(fit.value[4]) * 1e-3, unit="s")


def _offsets(fit: Fit, vehicle: Vehicle) -> Verdict:
    unit = excitation.offset_sd(vehicle)
    worst = max(fit.total(i) for i in (5, 6, 7))
    verdict = "yes" if worst < 0.7 * unit else "weak" if worst < unit else "no"
    reason = "from the mean torque in flight, the worst of three axes"
    return Verdict("torque_offsets", verdict, reason, sd=worst, unit="N m")


# drag and battery ----------------------------------------------------------------------------------------------


def _drag(recording: Recording, air: Airtime) -> Verdict:
    velocity, attitude = sound_signal(recording, "velocity"), sound_signal(recording, "attitude")
    if velocity is None or attitude is None:
        return Verdict("drag", "no", "needs velocity and attitude")
    force = sound_signal(recording, "specific_force")
    response, columns, source, steps = _sideways(velocity, attitude, force, air)
    if steps is None:
        return Verdict("drag", "no", "too few samples of velocity and attitude in the air")
    fit = linear_fit(response, columns, share=steps.share)
    if fit is None:
        return Verdict("drag", "no", "the speed does not vary")
    value, sd = -float(fit.value[0]), float(fit.sd[0])
    relative = sd / max(abs(value), TYPICAL_DRAG)
    reason = f"sideways force against speed, from {source}; over {max(abs(value), TYPICAL_DRAG):.2g} 1/s"
    return Verdict("drag", _grade(relative), reason, relative, relative * _stretch(steps), sd, value, "1/s")


def _sideways(
    velocity: tuple[Array, Array], attitude: tuple[Array, Array], force: tuple[Array, Array] | None, air: Airtime
) -> tuple[list[Array], list[Array], str, Steps | None]:
    """Horizontal body components of specific force, and columns for each: velocity, and a constant for each axis.

    Also the name of the source of the force, and the steps (None with too few samples).
    """
    time, both = _with_attitude(velocity, attitude)
    source = "velocity and attitude"
    if force is not None:
        good = _near(force[0], time)
        time, both = time[good], np.column_stack([both[good], _interpolated(force, time[good])])
        source = "the accelerometer"
    steps = excitation.steps_of(time, both, air)
    response: list[Array] = []
    columns: list[Array] = []
    for t, v in zip(*((steps.nodes, steps.values) if steps is not None else ((), ()))):
        matrix = rotation_matrix(_unit(0.5 * (v[1:, 3:7] + v[:-1, 3:7])))
        moving = np.einsum("kji,kj->ki", matrix, 0.5 * (v[1:, :3] + v[:-1, :3]))
        if v.shape[1] > 7:
            felt = 0.5 * (v[1:, 7:] + v[:-1, 7:])
        else:
            world = np.diff(v[:, :3], axis=0) / np.diff(t)[:, None] + np.array([0.0, 0.0, GRAVITY])
            felt = np.einsum("kji,kj->ki", matrix, world)
        for axis in (0, 1):
            constant = np.zeros((moving.shape[0], 2))
            constant[:, axis] = 1.0
            response.append(felt[:, axis])
            columns.append(np.column_stack([moving[:, axis], constant]))
    return response, columns, source, steps


def _battery(recording: Recording, vertical: _Vertical | None, inputs: Inputs, *, tau: float, delay: float) -> Verdict:
    name, voltage = "battery_law", sound_signal(recording, "voltage")
    if inputs.signal != "motor_command" or voltage is None:
        return Verdict(name, "no", "needs the duty sent to the rotors and the battery voltage")
    if vertical is None:
        return Verdict(name, "no", "neither velocity nor specific force is known in the air")
    steps = vertical.steps
    middle = np.concatenate(steps.nodes).mean()
    level = math.log(float(np.median(voltage[1])))
    columns = []
    for nodes, thrust in zip(steps.nodes, _thrust(vertical, inputs, tau=tau, delay=delay)):
        at = 0.5 * (nodes[1:] + nodes[:-1])
        volts = np.log(np.maximum(held(voltage[0], voltage[1][:, 0], at), 1e-3)) - level
        columns.append(thrust[:, None] * np.column_stack([np.ones(at.size), volts, at - middle]))
    volts = np.concatenate([held(voltage[0], voltage[1][:, 0], nodes) for nodes in steps.nodes])
    span = float(np.ptp(volts))
    if span < 0.01:
        return Verdict(name, "no", f"the voltage moves by no more than {1e3 * span:.0f} mV")
    fit = linear_fit(vertical.response, columns, share=steps.share)
    if fit is None or not fit.value[0] > 0.0:
        return Verdict(name, "no", "thrust and acceleration have no common stretch long enough")
    scale = float(fit.value[0])
    sd, value = float(fit.sd[1]) / scale, float(fit.value[1]) / scale
    reason = (
        f"exponent of the voltage in thrust at a given duty, beside a drift in time; the voltage moves by "
        f"{1e3 * span:.0f} mV"
    )
    return Verdict(name, _grade(sd / 2.0), reason, sd / 2.0, sd / 2.0 * _stretch(steps), sd, 2.0 + value, "")


# helpers -------------------------------------------------------------------------------------------------------


def _grade(relative: float) -> str:
    return "yes" if relative < IDENTIFIABLE else "weak" if relative < WEAKLY_IDENTIFIABLE else "no"


def _stretch(steps: Steps) -> float:
    """Random error in one window of the estimator over that in the whole flight; at least 1."""
    return math.sqrt(max(steps.count / steps.share / WINDOW_SAMPLES, 1.0))


def _with_attitude(velocity: tuple[Array, Array], attitude: tuple[Array, Array] | None) -> tuple[Array, Array]:
    """Velocity (n, 3) and attitude (n, 4) at the velocity's stamps that have an attitude near; or velocity alone."""
    if attitude is None:
        return velocity
    velocity = excitation.thinned(*velocity)
    good = _near(attitude[0], velocity[0])
    time = velocity[0][good]
    turned = _interpolated((attitude[0], continuous(attitude[1])), time)
    return time, np.column_stack([velocity[1][good], _unit(turned)])


def _near(stamps: Array, time: Array) -> NDArray[np.bool_]:
    """Whether each time lies between two stamps that are no more than 50 ms apart."""
    after = np.searchsorted(stamps, time, "left")
    inside = after < stamps.size
    after = np.minimum(after, stamps.size - 1)
    before = np.maximum(after - 1, 0)
    exact = stamps[after] == time
    return inside & (exact | ((stamps[before] <= time) & (stamps[after] - stamps[before] < excitation.LONGEST_STEP)))


def _interpolated(signal: tuple[Array, Array], at: Array) -> Array:
    return np.column_stack([np.interp(at, signal[0], column) for column in signal[1].T])


def _unit(q: Array) -> Array:
    norm = np.linalg.norm(q, axis=1, keepdims=True)
    return q / np.where(norm > 0.0, norm, 1.0)
