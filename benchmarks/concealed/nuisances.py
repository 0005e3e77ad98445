"""Priors of nuisances from worlds drawn at random: their spread over recordings whose hidden effects are known.

Each flight is fitted under the true model, so that a nuisance stands for nothing hidden. For a nuisance with values
v_i, standard deviations s_i and a prior N(m, t^2), the maximum of

    sum_i log N(v_i; m, t^2 + s_i^2)

over m and t is the prior that these recordings suggest (empirical Bayes; Efron, Large-Scale Inference, 2010, ch. 1).
v_i and s_i are without the prior of the fit, so wrong priors of the code do not confirm themselves.
"""

from collections import defaultdict
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize

from crazyem.diagnosis.fitting.fit import Data, nominal
from crazyem.diagnosis.fitting.model import OWN, Point
from crazyem.diagnosis.fitting.noise import start_noise
from crazyem.diagnosis.fitting.nuisances import solved
from crazyem.diagnosis.flights.flight import flight_of
from crazyem.errors import CrazyemError
from crazyem.recordings.registry import open_recording

from .ideal import best_fit, known_effects, options_of
from .paths import FLIGHTS, Study, read, write
from .report import unhidden

MIN_RECORDINGS = 4  # of a nuisance in the table
MAX_SD = 0.995  # of the prior's standard deviation; a value that is known no better says nothing

Row = dict[str, Any]


def fit_all(study: Study, *, part: tuple[int, int] = (0, 1)) -> None:
    """Fit the nuisances of every flight of the study; kept in OUT/nuisances."""
    for case in study.cases()[part[0] :: part[1]]:
        truth = read(study.truth(case))
        for flight in FLIGHTS:
            file = study.folder / "nuisances" / f"{case}_{flight}.json"
            if truth["hidden"] or file.is_file() or not study.recording(case, flight).is_file():
                continue
            try:
                write(file, _of_flight(study, case, flight))
            except CrazyemError as error:
                print(f"{case} {flight}: {error}")


def _of_flight(study: Study, case: str, flight: str) -> Row:
    """The nuisances of a flight under the true model, in units of their priors."""
    truth = read(study.truth(case))
    vehicle, hidden = unhidden(study, truth, flight)
    seen = open_recording(str(study.recording(case, flight)), options_of(study.mapping(case)))
    data = Data([flight_of(seen, vehicle)])
    start = nominal(data, Point(vehicle, known_effects(vehicle), start_noise()))
    point = replace(start, effects={**known_effects(vehicle), **{n: dict(t) for n, t in hidden.items()}})
    data.settle(point)
    fitted = best_fit(data, point, hidden)
    sd, rows, at = np.sqrt(np.diag(solved(fitted)[0].covariance)), [], 0
    for c in fitted.nuisances:
        values, centre = c.values(fitted.point), c.neutral(fitted.point)
        for name in c.free:
            usual = fitted.precision[at] ** -0.5 if fitted.precision[at] > 0.0 else np.inf
            own = c.effect.startswith(OWN)
            row = {"name": c.effect.removeprefix(OWN), "parameter": name.rpartition("/")[2] if own else name}
            row |= {"value": (values[name] - centre[name]) / usual, "sd": sd[at] / usual, "usual": usual}
            rows.append({k: v if isinstance(v, str) else float(v) for k, v in row.items()})
            at += 1
    return {"onboard": bool(data.flights[0].fused), "nuisances": rows}


def spread(values: np.ndarray, sds: np.ndarray) -> tuple[float, float, float]:
    """Mean and standard deviation of the prior by maximum likelihood, and the log-likelihood gained over N(0, 1).

    values, sds: (n,) posterior under the prior N(0, 1); those that are known no better than it must be left out.
    """
    noise = 1.0 / (sds**-2.0 - 1.0)  # variance of the likelihood alone
    middle = values * (1.0 + noise)

    def cost(x: np.ndarray) -> float:
        variance = noise + np.exp(2.0 * x[1])
        return float(0.5 * np.sum(np.log(variance) + (middle - x[0]) ** 2 / variance))

    found = minimize(cost, [0.0, 0.0], method="Nelder-Mead")
    return float(found.x[0]), float(np.exp(found.x[1])), cost(np.zeros(2)) - float(found.fun)


def table(study: Study) -> str:
    """The table of nuisances, as Markdown."""
    of: dict[tuple[str, str, bool], list[Row]] = defaultdict(list)
    for file in sorted((study.folder / "nuisances").glob("*.json")):
        flight = read(file)
        for row in flight["nuisances"]:
            of[row["name"], row["parameter"], flight["onboard"]].append(row)
    lines = [
        "| nuisance | estimate | n | sd of the prior | mean, in sd | sd by these flights, in sd | nats gained |",
        "|---|---|---|---|---|---|---|",
    ]
    for (name, parameter, onboard), rows in sorted(of.items()):
        informed = [r for r in rows if r["sd"] < MAX_SD]
        if len(informed) < MIN_RECORDINGS:
            continue
        mean, sd, gain = spread(*(np.array([r[k] for r in informed]) for k in ("value", "sd")))
        usual = np.median([r["usual"] for r in informed])
        kind = "onboard" if onboard else "motion capture"
        lines.append(
            f"| {name} {parameter} | {kind} | {len(informed)} | {usual:.2g} | {mean:+.2f} | {sd:.2f} | {gain:.1f} |"
        )
    return "\n".join(lines)
