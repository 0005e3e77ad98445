"""The accelerometer, which the filter does not use: what it shows against the specific force of the fitted model.

A further likelihood of effects that nothing else shows. The sensor's bias and lag are usual.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crazyem.diagnosis.fitting.candidates import Candidate
from crazyem.diagnosis.fitting.conditions import conditions_of
from crazyem.diagnosis.fitting.model import Model, Point
from crazyem.diagnosis.posterior.evidence import Gaussian, Pass, Posterior, Shared
from crazyem.diagnosis.posterior.members import ACCELEROMETER_NEEDS, prior_odds
from crazyem.diagnosis.posterior.study import Fit, Study
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.physics.effects.effect import Effect

BIAS_SD, LAG_SD = 0.03, 0.02  # m/s^2: what is left of a bias that the firmware removes at rest; s: of its low pass
STEP = 1e-3  # rad, for differences
WILD = 6.0  # standard deviations
FEWEST = 50  # rows
RESOLUTION = 1e-3  # m/s^2


@dataclass(frozen=True)
class AccelerometerEffect:
    """An effect that the accelerometer alone shows: log posterior odds, and its parameters."""

    candidate: Candidate
    odds: float
    posterior: Posterior


def accelerometer_effects(study: Study, fit: Fit) -> list[AccelerometerEffect]:
    """Every effect that the accelerometer alone shows, beside a fitted model."""
    found = []
    for effect in CATALOGUE.values():
        if effect.needs != ACCELEROMETER_NEEDS or not effect.prior.own:
            continue
        if all("specific_force" in d.signals for d in fit.data):
            one = _accelerometer_effect(effect, study, fit)
            found += [one] if one else []
    return found


def _accelerometer_effect(effect: Effect, study: Study, fit: Fit) -> AccelerometerEffect | None:
    names = tuple(effect.prior.own)
    candidate = Candidate(effect.name, (), names)
    passes = [_pass(effect, names, d.models[0], p) for d, p in zip(fit.data, fit.points, strict=True)]
    if any(p is None for p in passes):
        return None
    usual = []
    for data in fit.data:
        sizes = effect.prior.usual_in(conditions_of(data.flights, fit.points[0]))
        usual.append([*(sizes.get(n, 0.0) for n in names), BIAS_SD, BIAS_SD, BIAS_SD, LAG_SD])
    known = [p for p in passes if p is not None]
    shared = Shared(known, np.array(usual))
    neutral = candidate.neutral(fit.points[0])
    low, high = (np.array([candidate.range_of(n)[k] - neutral[n] for n in names]) for k in (0, 1))
    prior = Gaussian(np.diag(np.square([effect.prior.own[n] for n in names])), low, high)
    posterior = shared.posterior(range(len(names)), prior)
    phi = np.concatenate([posterior.mean, np.zeros(4)])
    scatter = float(np.median(Shared(shared.there(known, phi), np.array(usual)).scatter[: len(names)]))
    found = replace(posterior, covariance=scatter * posterior.covariance)
    return AccelerometerEffect(candidate, posterior.gain / scatter + prior_odds(), found)


def _pass(effect: Effect, names: Sequence[str], model: Model, point: Point) -> Pass | None:
    """Score and information of the parameters, of three biases and of a lag; None where too little was felt."""
    flight = model.flight
    acceleration, situation = model.accelerations(point)
    force = acceleration[:, :3]
    shown = np.full_like(force, np.nan)  # mean over the step, as the model has it
    shown[1:] = 0.5 * (flight.force[1:] + flight.force[:-1])
    residual = shown - force
    usable = np.isfinite(residual).all(axis=1) & ~flight.starts & (situation.step > 0)
    if usable.sum() < FEWEST:
        return None
    centred = residual - np.median(residual[usable], axis=0)
    sd = 1.4826 * np.median(np.abs(centred[usable]), axis=0) + RESOLUTION
    usable &= np.all(np.abs(centred) < WILD * sd, axis=1)
    there, k = replace(situation, specific_force=force), len(names)
    columns = np.zeros((k + 4, *force.shape))
    filed = point.vehicle.effects.get(effect.name, {})
    neutral = effect.complete(filed, {})
    assert effect.measured is not None
    base = effect.measured(there, **neutral).specific_force
    for i, name in enumerate(names):
        columns[i] = (effect.measured(there, **{**neutral, name: neutral[name] + STEP}).specific_force - base) / STEP
    for i in range(3):
        columns[k + i, :, i] = 1.0
    columns[k + 3] = -np.gradient(force, flight.time, axis=0)
    z: NDArray = np.where(usable[:, None], (residual - base) / sd, 0.0)
    slopes: NDArray = np.where(usable[:, None], columns / sd, 0.0)
    score, information = np.zeros((flight.blocks, k + 4)), np.zeros((flight.blocks, k + 4, k + 4))
    for b in range(flight.blocks):
        rows = flight.block == b
        score[b] = np.einsum("cni,ni->c", slopes[:, rows], z[rows])
        information[b] = np.einsum("cni,dni->cd", slopes[:, rows], slopes[:, rows])
    return Pass(-0.5 * float(np.sum(z * z)), score, information, np.zeros(k + 4))
