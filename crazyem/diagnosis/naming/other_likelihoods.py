"""Effects that are no column of the regression: gusts, a tilted accelerometer, rotors that follow commands late."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import logit

from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.naming import rotor_response
from crazyem.diagnosis.naming.accelerometer import ANGLES, MISALIGNED, held_out_gain, tilt
from crazyem.diagnosis.naming.answer import Named, Value, confidence_factor
from crazyem.diagnosis.naming.evidence import usual_gusts
from crazyem.diagnosis.naming.gusts import find_gusts
from crazyem.diagnosis.naming.trials import presence, presence_by_odds
from crazyem.diagnosis.naming.unexplained import Unexplained
from crazyem.diagnosis.settings import ACCELEROMETER, CONFIDENCE, SELECTION, WIND
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.external_force import GUSTS
from crazyem.physics.effects.timing import INPUT_DELAY, MOTOR_LAG
from crazyem.vehicle import Vehicle


def other_likelihoods(
    data: Data,
    apart: Data | None,
    point: Point,
    remains: Unexplained,
    wanted: Sequence[str],
    left_out: dict[str, str],
    pulled: bool,
    say: Callable[[str], None],
) -> list[Named]:
    """Gusts, unless something pulls the drone to a place (`pulled`), and a tilted accelerometer."""
    found = []
    if (not wanted or GUSTS.name in wanted) and GUSTS.name not in left_out and not pulled:
        say(GUSTS.name)
        gusts = find_gusts(data, point)
        known = gusts is not None and gusts.speed < usual_gusts(point, data)
        if gusts is not None and not known and gusts.moving_air and remains.force_nats < WIND.fixed_share * gusts.gain:
            memory_sd = gusts.memory * gusts.memory_sd
            # the interval of a memory that the flight does not determine is infinite
            p = next(p for p in GUSTS.parameters if p.name == "correlation_time")
            with np.errstate(over="ignore"):
                reach = np.exp(np.log(gusts.memory) + np.array([-1.96, 1.96]) * gusts.memory_sd)
            low, high = np.clip(reach, p.low, p.high)
            values = {
                "standard_deviation": Value.normal(gusts.speed, "m/s", gusts.speed_sd),
                "correlation_time": Value(gusts.memory, "s", memory_sd, (float(low), float(high))),
            }
            held = gusts.gain
            if apart is not None:
                there = find_gusts(apart, point)
                held = there.gain if there else 0.0
            if held > 0:
                sure = confidence_factor(remains.without_force(), held) * presence(gusts.gain, held, gusts.gain)
                found.append(Named(GUSTS.name, GUSTS.name, values, {}, held, sure, log_odds=float(logit(sure))))
    if not wanted or MISALIGNED in wanted:
        solution = tilt(data, point)
        if solution is not None:
            sd = np.sqrt(np.diag(solution.covariance)[:3])
            angles = solution.theta[:3]
            held = held_out_gain(apart or data, point, angles, yaw_sd=float(sd[2]))
            if held > SELECTION.min_evidence and np.abs(angles[:2]).max() > ACCELEROMETER.min_angle:
                found_angles = zip(ANGLES, angles.tolist(), sd.tolist(), strict=True)
                values = {n: Value.normal(a, "rad", e) for n, a, e in found_angles}
                dispersion = max(1.0, solution.dispersion)
                real = presence(solution.gain / dispersion, held, solution.gain, dispersion=dispersion)
                sure = confidence_factor(remains, held) * real  # the sensor measures a force that nothing explains
                name = MISALIGNED
                found.append(Named(name, name, values, {}, held, sure, log_odds=float(logit(real))))
    return found


def late_rotors(
    answers: Sequence[rotor_response.Answer],
    held_out: Sequence[rotor_response.Answer],
    vehicle: Vehicle,
    wanted: Sequence[str],
    left_out: dict[str, str],
    *,
    unresponsive: bool = False,
) -> tuple[list[Named], tuple[tuple[str, ...], ...]]:
    """Lag and delay of rotors with measured speeds, and the group of both where they are look-alikes.

    A rotor that ignores its command (`unresponsive`) makes all four look late or prompt, so neither effect is sure.
    """
    found = rotor_response.response(answers)
    if found is None:
        return [], ()
    left_out.pop(MOTOR_LAG.name, None)
    late = rotor_response.late_response(found, rotor_response.response(held_out), vehicle)
    if late is None or (wanted and not set(late.values) & set(wanted)):
        return [], ()
    named = []
    for name, (value, sd) in late.values.items():
        p = CATALOGUE[name].parameters[0]
        values = {p.name: Value.normal(value, p.unit, sd)}
        there = presence_by_odds(min(late.held_out, late.nats))
        sure = there * (0.5 if late.alike else 1.0)
        sure = min(sure, CONFIDENCE.doubtful) if unresponsive else sure
        named.append(Named(name, name, values, {}, late.held_out, sure, log_odds=float(logit(there))))
    return named, ((MOTOR_LAG.name, INPUT_DELAY.name),) if late.alike else ()
