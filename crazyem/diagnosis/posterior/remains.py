"""What no named effect explains: members of the best model that have no name, and structure that it leaves."""

from dataclasses import replace

import numpy as np

from crazyem.diagnosis.fitting.fit import Data
from crazyem.diagnosis.fitting.model import Point
from crazyem.diagnosis.locating.heading import heading_by_place
from crazyem.diagnosis.locating.locate import AXES, Finding, Located, locate, strongest
from crazyem.diagnosis.locating.place import slope_finding
from crazyem.diagnosis.locating.random_torques import erratic_rotor, humps, memoryless
from crazyem.diagnosis.naming.unexplained import STRUCTURE, Unexplained, lines, notable
from crazyem.diagnosis.posterior.study import Fit, Study
from crazyem.physics.effects.catalogue import CATALOGUE


def located(fit: Fit) -> Located:
    """Where all flights part from a model."""
    parts = [_settled(d, p) for d, p in zip(fit.data, fit.points, strict=True)]
    findings = sorted((f for p in parts for f in p.findings), key=lambda f: -f.nats)
    white: dict[str, list[float]] = {}
    for p in parts:
        for name, value in p.whiteness.items():
            white.setdefault(name, []).append(value)
    return Located(
        tuple(findings), tuple(d for p in parts for d in p.disturbances),
        {n: min(1.0, min(v) * len(v)) for n, v in white.items()},
    )  # fmt: skip


def _settled(data: Data, point: Point) -> Located:
    data.settle(point)
    return locate(data, point)


def remains(study: Study, best: Fit, nothing: Fit, after: Located) -> Unexplained:
    """What the best model has without a name, and what it leaves."""
    found: list[Finding] = [*_by_place(best)]
    of_the_body = [f for f in after.findings if f.axis in AXES]
    for data, point in zip(best.data, best.points, strict=True):
        found += [f for f in strongest(of_the_body, most=40) if f.nats > STRUCTURE and notable(f, point)]
        for model in data.models:
            found += lines(model.sweep(point), model.flight.time)
            found += humps(model, replace(nothing.points[0], effects={**nothing.points[0].effects, **_named(best)}))
            data.settle(point)
        quiet = memoryless(data.twin(), point)
        data.settle(quiet)
        erratic = erratic_rotor(data.models, quiet)
        found += [erratic] if erratic and notable(erratic, point) else []
        data.settle(point)
    heading = heading_by_place(best.data[0], None)
    found += [heading] if heading else []
    found.sort(key=lambda f: -f.nats)
    return Unexplained(tuple(found[:12]), best.value - nothing.value)


def _named(fit: Fit) -> dict[str, dict[str, object]]:
    return {m.effect: dict(fit.points[0].effects[m.effect]) for m in fit.members}


def _by_place(fit: Fit) -> list[Finding]:
    """The strongest slope of a member without a name."""
    found, k = [], 0
    for m in fit.members:
        size = len(m.candidate.free)
        if CATALOGUE[m.effect].prior.unnamed and size >= 9:
            phi = fit.posterior.mean[k : k + size][-9:].reshape(3, 3)
            sd = np.sqrt(np.diag(fit.posterior.covariance)[k : k + size][-9:]).reshape(3, 3)
            nats = float(fit.posterior.gain)
            one = slope_finding(fit.data[0], phi, sd, max(nats, 0.0), fit.points[0].vehicle)
            found += [one] if one else []
        k += size
    return found
