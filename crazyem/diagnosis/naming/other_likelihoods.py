"""Effects that are no column of the regression, and tests by signals that the filter does not use.

Gusts, random motion of the air with memory, have no deterministic term. The filter has a disturbing specific force
(Ornstein-Uhlenbeck, body axes) as states. Its stationary standard deviation is fitted with the other noise scales for
several correlation times. A parabola of the log-likelihood over the log of this time gives the best time and its error.
Where only the accelerometer shows lateral forces (`fitting/specific_force.py`), its noise gives their size and gain.

The filter does not use the accelerometer, whose low pass is part of no model. Only a regression shows its tilt: the
residual is regressed on the tilt, with a bias and a lag of the sensor as nuisances. Errors come from the scatter of
blocks.

Late inputs and late measurements are the same to the filter. The accelerometer has no delay but its own low pass. So
its lag behind the forces of a model without delay contains the delay of late inputs, but not that of late measurements.
A weak rotor and a wrong rotor sensor are the same to the filter, too. Commands separate them: they give the speed that
the other rotors show at the same command.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.gram import Gram, Solution
from crazyem.diagnosis.fitting.model import Model, Noise, Point
from crazyem.diagnosis.fitting.specific_force import LATERAL, noise_of
from crazyem.diagnosis.flights.alignment import band_passed, delay_of, delays_within, products, standard_error
from crazyem.diagnosis.naming import rotor_response
from crazyem.diagnosis.naming.answer import Named, Value, confidence_factor
from crazyem.diagnosis.naming.evidence import usual_gusts
from crazyem.diagnosis.naming.trials import presence, presence_by_odds
from crazyem.diagnosis.naming.unexplained import Unexplained
from crazyem.diagnosis.settings import ACCELEROMETER, CLOCKS, CONFIDENCE, RECORDINGS, SELECTION, WIND
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.drag import LINEAR_DRAG
from crazyem.physics.effects.external_force import GUSTS
from crazyem.physics.effects.sensing import ACCELEROMETER_MISALIGNMENT
from crazyem.physics.effects.timing import INPUT_DELAY, MOTOR_LAG
from crazyem.recordings.airborne import airtime
from crazyem.recordings.ordering import ordered
from crazyem.recordings.recording import Recording
from crazyem.vehicle import Vehicle


@dataclass(frozen=True)
class Gusts:
    """A disturbing force with memory.

    Attributes:
        gain: nats over white noise.
        spread: (3,) standard deviation of specific force, body [m/s^2].
        memory: s, with `memory_sd` of its logarithm.
        moving_air: whether the disturbance is similar on all axes.
        speed: m/s, standard deviation of the air's velocity, with `speed_sd`.
    """

    gain: float
    spread: NDArray
    memory: float
    memory_sd: float
    moving_air: bool
    speed: float
    speed_sd: float


def lateral_force(residuals: Sequence[tuple[NDArray, float]], memory: float) -> tuple[float, float]:
    """Gain [nats] over white noise and standard deviation [m/s^2] of a force with a memory [s].

    residuals: (n,) of an accelerometer along one axis in each flight, with the time between rows [s].
    """
    gain, spreads = 0.0, []
    for residual, period in residuals:
        noise = noise_of(residual, decay=float(np.exp(-period / memory)))
        gain += noise.loglik - noise_of(residual, decay=0.0).loglik
        spreads.append(noise.spread(residual))
    return gain, float(np.sqrt(np.mean(np.square(spreads))))


def find_gusts(data: Data, point: Point) -> Gusts | None:
    """The disturbing force with memory; None if its gain or its size is too small."""
    white = data.loglik(point, passes=2)
    hidden = [m for m in data.models if m.force_axes == LATERAL]
    left = [(m.force_residuals(point), float(np.median(np.diff(m.flight.time)))) for m in hidden]
    lateral = [[(residual[:, axis], period) for residual, period in left] for axis in range(2)] if left else []

    def fitted(memory: float, start: Noise, spread: NDArray) -> tuple[float, Point]:
        found_lateral = [lateral_force(residuals, memory) for residuals in lateral]
        if lateral:  # the filter finds the force along z alone
            spread = np.array([0.0, 0.0, spread[2]])
        torques = point.noise.disturbance[3:], np.broadcast_to(np.asarray(point.noise.memory, float), (6,))[3:]
        noise = replace(start, disturbance=np.concatenate([spread, torques[0]]),
                        memory=np.concatenate([np.full(3, memory), torques[1]]))  # fmt: skip
        found = data.fit_noise(replace(point, noise=noise))
        value = data.loglik(found, passes=2) + sum(gain for gain, _ in found_lateral)
        sizes = [size for _, size in found_lateral] or found.noise.disturbance[:2]
        disturbance = np.concatenate([sizes, found.noise.disturbance[2:]])
        return value, replace(found, noise=replace(found.noise, disturbance=disturbance))

    first = fitted(1.0, point.noise, np.full(3, 0.1))
    if first[0] - white < 0.5 * WIND.min_gain or first[1].noise.disturbance[:3].max() < 0.7 * WIND.min_spread:
        return None
    reached = first[1].noise
    tried = {1.0: first}
    for m in WIND.memories:
        if m != 1.0:
            tried[m] = fitted(m, reached, np.sqrt(m) * reached.disturbance[:3])
    best = max(tried, key=lambda m: tried[m][0])
    gain = tried[best][0] - white
    spread = tried[best][1].noise.disturbance[:3]
    # a likelihood that still rises at the shortest memory is that of a force without one: errors of an onboard filter
    if gain < WIND.min_gain or spread.max() < WIND.min_spread or best == WIND.memories[0]:
        return None
    logs = np.log(np.array(sorted(tried)))
    heights = np.array([tried[m][0] for m in sorted(tried)])
    near = np.argsort(np.abs(logs - np.log(best)))[:3]
    curve = np.polyfit(logs[near], heights[near], 2)
    memory = float(np.exp(np.clip(-curve[1] / (2 * curve[0]), logs[0], logs[-1]))) if curve[0] < 0 else best
    seconds = sum(f.duration for f in data.flights)
    independent = max(3.0 * seconds / (2.0 * memory), 2.0)
    scatter = max(1.0 / np.sqrt(max(-2 * curve[0], 1e-9)), np.sqrt(2.0 / independent))
    memory_sd = np.hypot(scatter, WIND.log_memory_sd)
    size = float(np.median(spread))  # the median: errors of thrust add to the force along z
    speed = size * point.vehicle.mass / push_of(point)
    alike = bool(spread.max() < WIND.max_axis_ratio * spread.min())
    speed_sd = speed * float(np.hypot(1.0 / np.sqrt(2 * independent), WIND.spread_sd))
    return Gusts(gain, spread, memory, float(memory_sd), alike, speed, speed_sd)


def push_of(point: Point) -> float:
    """Force by air speed [N s/m]: the mean linear drag if one was found, else `WIND.drag`."""
    drag = point.effects.get(LINEAR_DRAG.name)
    mean = float(np.mean([drag[a] for a in "xyz"])) if drag else 0.0
    return mean if mean > WIND.known_drag else WIND.drag


MISALIGNED = ACCELEROMETER_MISALIGNMENT.name
ANGLES = ("roll", "pitch", "yaw")


def tilt(data: Data, point: Point) -> Solution | None:
    """Angles (roll, pitch, yaw first in theta) of the accelerometer [rad]; None without one."""
    if "specific_force" not in data.signals:
        return None
    grams = [_of(model, point) for model in data.models]
    if any(g.score.shape[0] < 8 or not np.isfinite(g.information).all() for g in grams):
        return None
    gram = Gram.joined(grams)
    precision = np.array(
        [0.0] * 2 + [ACCELEROMETER.yaw_sd**-2] + [ACCELEROMETER.bias_sd**-2] * 3 + [ACCELEROMETER.lag_sd**-2]
    )
    solution = gram.solve(range(7), precision=precision, tested=range(2))
    more = np.diag([ACCELEROMETER.angle_sd**2] * 2 + [0.0] * 5)
    return replace(solution, covariance=solution.covariance + more)


def held_out_gain(data: Data, point: Point, angles: NDArray, *, yaw_sd: float) -> float:
    """Gain of the angles on other flights [nats], with bias and lag fitted there.

    The yaw is fitted there, too, about the value found and within `yaw_sd` [rad]: a hover does not determine it, and a
    quick flight does.
    """
    total, dispersion = 0.0, gram_dispersion(data, point)
    bare = [3, 4, 5, 6]
    known = {2: yaw_sd**-2, **dict.fromkeys((3, 4, 5), ACCELEROMETER.bias_sd**-2), 6: ACCELEROMETER.lag_sd**-2}
    for model in data.models:
        # the dispersion applies to the residuals, not to the priors
        b, a = (v / dispersion for v in _of(model, point).total(range(7)))
        shift = np.array([*angles])
        total += float(b[:3] @ shift - 0.5 * shift @ a[:3, :3] @ shift)
        total += _fitted(b - a[:, :3] @ shift, a, known) - _fitted(b, a, {i: known[i] for i in bare})
    return total


def _fitted(score: NDArray, information: NDArray, known: Mapping[int, float]) -> float:
    """Gain of the parameters `known` (index -> precision of the prior) [nats]; the others stay as they are."""
    at = list(known)
    inner = information[np.ix_(at, at)] + np.diag([known[i] for i in at])
    return 0.5 * float(score[at] @ np.linalg.solve(inner, score[at]))


def gram_dispersion(data: Data, point: Point) -> float:
    """Variance of the scores over that of white residuals; at least 1."""
    found = tilt(data, point)
    return max(1.0, found.dispersion) if found else 1.0


def _of(model: Model, point: Point) -> Gram:
    flight = model.flight
    acceleration, situation = model.accelerations(point)
    force = acceleration[:, :3]
    shown = np.full_like(flight.force, np.nan)  # mean over the step, as in the model
    shown[1:] = 0.5 * (flight.force[1:] + flight.force[:-1])
    residual = shown - force
    usable = np.all(np.isfinite(residual), axis=1) & ~flight.starts & (situation.step > 0)
    columns = np.zeros((7, flight.time.size, 3))
    measured = ACCELEROMETER_MISALIGNMENT.measured
    assert measured is not None
    there = replace(situation, specific_force=force)
    for i, angle in enumerate(ANGLES):
        values = {**dict.fromkeys(ANGLES, 0.0), angle: ACCELEROMETER.step}
        columns[i] = measured(there, **values).specific_force / ACCELEROMETER.step
    for i in range(3):
        columns[3 + i, :, i] = 1.0
    columns[6] = -np.gradient(force, flight.time, axis=0)
    blocks = flight.blocks
    score, information = np.zeros((blocks, 7)), np.zeros((blocks, 7, 7))
    rows = np.flatnonzero(usable)
    if rows.size < 50:
        return Gram(np.zeros((0, 7)), np.zeros((0, 7, 7)), np.zeros(0, int))
    centred = residual[rows] - np.median(residual[rows], axis=0)
    variance = np.square(1.4826 * np.median(np.abs(centred), axis=0)) + 1e-6
    kept = rows[np.all(np.abs(centred) < 6 * np.sqrt(variance), axis=1)]
    for b in range(blocks):
        mine = kept[flight.block[kept] == b]
        for c in range(3):
            d = columns[:, mine, c] / np.sqrt(variance[c])
            r = residual[mine, c] / np.sqrt(variance[c])
            score[b] += d @ r
            information[b] += d @ d.T
    return Gram(score, information, np.zeros(blocks, int))


def late_measurements(data: Data, nominal: Point, delay: float) -> float | None:
    """Nats for late measurements against late inputs, with this `delay` [s]; None without an accelerometer.

    `nominal` has no delay. None also with measured rotor speeds, because their own lag is not known.
    """
    if data.flights[0].inputs.measured:
        return None
    lags = [found for found in (_lag_of(model, nominal) for model in data.models) if found is not None]
    if not lags:
        return None
    weight = sum(variance**-1 for _, variance in lags)
    lag, variance = (
        sum(lag / variance for lag, variance in lags) / weight,
        1.0 / weight + CLOCKS.accelerometer_lag_sd**2,
    )
    return ((lag - CLOCKS.accelerometer_lag - delay) ** 2 - (lag - CLOCKS.accelerometer_lag) ** 2) / (2.0 * variance)


def _lag_of(model: Model, point: Point) -> tuple[float, float] | None:
    """Lag [s] of the accelerometer behind the thrust of one flight's commands, and its variance; None without one."""
    flight = model.flight
    thrust = model.accelerations(point)[0][:, 2]
    known, shown = np.isfinite(thrust) & ~flight.starts, np.isfinite(flight.force[:, 2])
    grid = np.arange(flight.time[0], flight.time[-1], CLOCKS.grid)
    margin = round((CLOCKS.max_sensor_delay + CLOCKS.filter_half) / CLOCKS.grid)
    if min(known.sum(), shown.sum()) < 2 or grid.size < 2 * margin + CLOCKS.min_blocks * RECORDINGS.block / CLOCKS.grid:
        return None
    middle = flight.time - 0.5 * np.diff(flight.time, prepend=flight.time[0])  # thrust is the mean of the step before
    cause = band_passed(np.interp(grid, middle[known], thrust[known])[:, None])
    wanted = band_passed(np.interp(grid, flight.time[shown], flight.force[shown, 2])[:, None])
    index = np.arange(margin, grid.size - margin)
    block = ((grid[index] - grid[margin]) / RECORDINGS.block).astype(int)
    delays = delays_within(CLOCKS.max_sensor_delay)
    sums = np.stack([products(index, block, wanted, cause, [], d) for d in delays], 2)
    total = sums.sum(1)
    lag, variance = delay_of(delays, total)[0], standard_error(delays, sums, total) ** 2
    return (lag, variance) if np.isfinite([lag, variance]).all() and variance > 0.0 else None


def false_speed(recordings: Sequence[Recording], rotor: int, scale: float, lag: float) -> float | None:
    """Nats for a sensor of rotor 1 to 4 that shows `scale` times the speed, against a weak rotor with a right sensor.

    `lag` [s] of the rotors behind their commands. None where commands or speeds are not recorded.
    """
    blocks = [b for r in recordings for b in [_beyond(r, rotor - 1, lag)] if b is not None]
    if not blocks:
        return None
    beyond = np.concatenate(blocks)
    if beyond.size < CLOCKS.min_speed_blocks:
        return None
    mean, variance = float(beyond.mean()), float(beyond.var(ddof=1)) / beyond.size + CLOCKS.twin_speed_sd**2
    return (mean**2 - (mean - float(np.log(scale))) ** 2) / (2.0 * variance)


def _beyond(recording: Recording, rotor: int, lag: float) -> NDArray | None:
    """(b,) by blocks: logarithm of a rotor's speed over the speed of the others at its command."""
    air = airtime(recording)
    if any(n not in recording.signals for n in ("motor_command", "rotor_speed")):
        return None
    time, command = ordered(recording.signals["motor_command"])
    when, speed = ordered(recording.signals["rotor_speed"])
    flying = np.zeros(time.size, bool)
    for begin, end in air.flown:
        flying |= (time > begin + 0.5) & (time < end - 0.5)
    if time.size < 2 or when.size < 2:
        return None
    expected = command.astype(float).copy()
    for k in range(1, time.size):
        decay = np.exp(-max(time[k] - time[k - 1], 0.0) / max(lag, 1e-3))
        expected[k] = command[k - 1] + (expected[k - 1] - command[k - 1]) * decay
    seen = np.stack([np.interp(time, when, speed[:, i]) for i in range(4)], 1)
    flying &= np.all((expected > 0.01) & (seen > 1.0), axis=1)
    if flying.sum() < CLOCKS.min_speed_blocks * CLOCKS.samples_of_block:
        return None
    x, y = np.log(expected[flying]), np.log(seen[flying])
    others = [i for i in range(4) if i != rotor]
    centre = float(x.mean())
    slope = np.polynomial.Polynomial.fit(x[:, others].ravel() - centre, y[:, others].ravel(), 2)
    away = y - slope(x - centre)
    difference = away[:, rotor] - away[:, others].mean(1)  # cancels the battery's state, which all rotors share
    count = difference.size // CLOCKS.samples_of_block
    return difference[: count * CLOCKS.samples_of_block].reshape(count, CLOCKS.samples_of_block).mean(1)


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
