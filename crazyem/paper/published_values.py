"""Values printed in the paper (tables, ranges in the text, captions of figures), and the necessary corrections.

Source: Zhao, "Online parameter estimation for the Crazyflie quadcopter through an EM algorithm". SI units throughout.
Everything without a correction is as printed, even where it is wrong.
"""

import tomllib
from dataclasses import dataclass
from importlib import resources

PARAMETERS = ("mass", "Ixx", "Iyy", "Izz")
UNITS = {"mass": "kg", "Ixx": "kg m^2", "Iyy": "kg m^2", "Izz": "kg m^2"}
SENSORS = {"A": "state estimation from EKF", "B": "full state observation", "C": "partial state observation"}

# Table I, column "Our system": metres and radians
TABLE_I = {
    "position": {"mean": 1.02e-2, "sd": 0.77e-2, "max": 5.24e-2},
    "angles": {"mean": 1.04e-2, "sd": 0.83e-2, "max": 8.67e-2},
}

# Tables II, III (offline) and IV, V (online): ranges of the converged values over 20 cycles
PUBLISHED_RANGES: dict[tuple[str, str], dict[str, tuple[float, float]]] = {
    ("offline", "A"): {
        "mass": (0.1797, 0.1802), "Ixx": (2.418e-4, 2.75e-4), "Iyy": (2.93e-4, 3.32e-4), "Izz": (1.912e-4, 2.255e-4),
    },
    ("offline", "B"): {
        "mass": (0.1788, 0.1801), "Ixx": (2.383e-4, 2.755e-4), "Iyy": (3.037e-4, 3.286e-4), "Izz": (1.955e-4, 2.214e-4),
    },
    ("offline", "C"): {
        "mass": (0.1896, 0.196), "Ixx": (2.373e-4, 2.718e-4), "Iyy": (2.974e-4, 3.284e-4), "Izz": (1.898e-4, 2.198e-4),
    },
    ("online", "A"): {
        "mass": (0.1795, 0.1806), "Ixx": (2.0e-4, 3.15e-4), "Iyy": (2.65e-4, 3.75e-4), "Izz": (1.7e-4, 2.6e-4),
    },
    ("online", "B"): {
        "mass": (0.1793, 0.1807), "Ixx": (2.0e-4, 3.2e-4), "Iyy": (2.5e-4, 4.0e-4), "Izz": (1.65e-4, 2.6e-4),
    },
    ("online", "C"): {
        "mass": (0.1825, 0.196), "Ixx": (2.0e-4, 3.5e-4), "Iyy": (2.5e-4, 4.2e-4), "Izz": (1.7e-4, 3.2e-4),
    },
}  # fmt: skip

# Settling times in the paper are in iterations; online one iteration is one update of 4 steps.
CONVERGENCE = {
    ("offline", "mass"): "around the 4th iteration (text to Fig. 14)",
    ("online", "all"): "around the 200th iteration (text to Fig. 26, 29, 31, 37)",
}
ONLINE_ITERATIONS = 200


def table_of(experiment: str, parameter: str) -> str:
    """The paper's table that holds a cell: II to V."""
    if experiment == "offline":
        return "II" if parameter == "mass" else "III"
    return "IV" if parameter == "mass" else "V"


@dataclass(frozen=True)
class PaperFigure:
    """One figure of the paper.

    Attributes:
        number: as printed.
        kind: state, estimate, error, path or convergence.
        experiment: "table1" (Fig. 3-5), "offline" or "online".
        sensor: A, B or C.
        parameter: of a convergence plot, else "".
        caption: description in the paper's words.
    """

    number: int
    kind: str
    experiment: str
    sensor: str
    parameter: str
    caption: str


def _figures() -> tuple[PaperFigure, ...]:
    found = [
        PaperFigure(3, "state", "table1", "A", "", "True state from quadcopter"),
        PaperFigure(4, "estimate", "table1", "A", "", "Estimated state from EKF"),
        PaperFigure(5, "error", "table1", "A", "", "Error between estimated state and true state"),
    ]
    number = 8
    for experiment in ("offline", "online"):
        for sensor, words in SENSORS.items():
            found.append(
                PaperFigure(number, "path", experiment, sensor, "", f"Quadcopter flight trajectory based on {words}")
            )
            found += [
                PaperFigure(number + 1 + i, "convergence", experiment, sensor, p, f"Estimated {p} based on {words}")
                for i, p in enumerate(PARAMETERS)
            ]
            number += 1 + len(PARAMETERS)
    return tuple(found)


FIGURES = _figures()
NOT_RESULTS = {
    1: "hidden Markov model (diagram)",
    2: "coordinate systems (diagram)",
    6: "block diagram of the offline simulation",
    7: "block diagram of the online simulation",
}


@dataclass(frozen=True)
class Correction:
    """One correction of the paper.

    Attributes:
        equation: number or section.
        printed, used: the form in the paper, and the form in this program.
        why: reason why the printed form does not run, or the choice that was necessary.
    """

    equation: str
    printed: str
    used: str
    why: str


_TEXT = (resources.files("crazyem.paper") / "corrections.toml").read_text(encoding="utf-8")
CORRECTIONS = tuple(Correction(**entry) for entry in tomllib.loads(_TEXT)["correction"])
