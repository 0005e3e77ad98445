"""gusts: random motion of the air with memory, found by the likelihood of a disturbing force with memory.

Gusts have no deterministic term, so they are no column of the regression. The filter has a disturbing specific force
(Ornstein-Uhlenbeck, body axes) as states. Its stationary standard deviation is fitted with the other noise scales for
several correlation times. A parabola of the log-likelihood over the log of this time gives the best time and its error.
Where only the accelerometer shows lateral forces (`fitting/specific_force.py`), its noise gives their size and gain.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.model import Noise, Point
from crazyem.diagnosis.fitting.specific_force import LATERAL, noise_of
from crazyem.diagnosis.settings import WIND
from crazyem.physics.effects.drag import LINEAR_DRAG


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
