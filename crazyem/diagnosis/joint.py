"""The joint posterior of all parameters of a fitted vehicle file.

Standard deviations are those of the document, which contain systematic errors, too. Correlations are those of the fit.
Nuisances of the drone are part of the posterior, because no file gives them exactly.
"""

import math
from collections.abc import Iterator

import numpy as np

from crazyem.diagnosis.diagnose import Diagnosis
from crazyem.diagnosis.fitting.nuisances import solved
from crazyem.physics.effects.catalogue import CATALOGUE
from crazyem.vehicle import Posterior


def posterior_of(diagnosis: Diagnosis) -> Posterior | None:
    """The joint posterior of the parameters of the drone; None if nothing is fitted."""
    mean: dict[str, float] = {}
    sd: dict[str, float] = {}
    for effect in diagnosis.effects:
        if effect.of_recording or effect.name not in diagnosis.fitted_vehicle.effects:
            continue
        for name, value in effect.parameters.items():
            if math.isfinite(value.value) and math.isfinite(value.sd) and value.sd > 0.0:
                mean[f"{effect.name}.{name}"], sd[f"{effect.name}.{name}"] = float(value.value), float(value.sd)
    correlation: dict[tuple[str, str], float] = {}
    fitted = diagnosis.selection.fitted
    covariance = solved(fitted)[0].covariance
    spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    columns = list(_columns(diagnosis))
    for i, (key, number) in enumerate(columns):
        if key and key not in mean and spread[i] > 0.0:
            mean[key], sd[key] = number, float(spread[i])
    for i, (first, _) in enumerate(columns):
        for j, (second, _) in enumerate(columns):
            if first in mean and second in mean and spread[i] * spread[j] > 0.0:
                correlation[first, second] = float(covariance[i, j] / (spread[i] * spread[j]))
    if not mean:
        return None
    names = tuple(mean)
    matrix = np.array([[correlation.get((a, b), float(a == b)) for b in names] for a in names])
    np.fill_diagonal(matrix, 1.0)
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    matrix = (vectors * np.maximum(values, 1e-9)) @ vectors.T
    scale = np.array([sd[n] for n in names])
    joint = matrix * np.outer(scale, scale)
    return Posterior(names, tuple(mean[n] for n in names), tuple(tuple(float(v) for v in row) for row in joint))


def _columns(diagnosis: Diagnosis) -> Iterator[tuple[str, float]]:
    """The columns of the fit: "effect.parameter" for parameters of the drone, else ""; and the value."""
    fitted = diagnosis.selection.fitted
    seen = set()
    for candidate in (*fitted.candidates, *fitted.nuisances):
        values = candidate.values(fitted.point)
        effect = CATALOGUE.get(candidate.effect)
        for name in candidate.free:
            key = f"{candidate.effect}.{name}"
            of_drone = effect is not None and effect.belongs_to == "vehicle"
            yield (key if of_drone and key not in seen else ""), float(values[name])
            seen.add(key)
