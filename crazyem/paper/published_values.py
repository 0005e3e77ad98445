"""What the paper prints: its tables, the ranges in its text, the captions of its figures; and what had to be corrected.

Source: Zhao, "Online parameter estimation for the Crazyflie quadcopter through an EM algorithm". SI units throughout.
All that is not among the corrections was kept, wrong or not.
"""

from dataclasses import dataclass

PARAMETERS = ("mass", "Ixx", "Iyy", "Izz")
UNITS = {"mass": "kg", "Ixx": "kg m^2", "Iyy": "kg m^2", "Izz": "kg m^2"}
SENSORS = {"A": "state estimation from EKF", "B": "full state observation", "C": "partial state observation"}
CYCLES = 20  # simulation cycles behind every range (XI-B)

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

# The paper says when a curve has settled in iterations; online one iteration is one update of 4 steps.
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
        caption: what it shows, in the paper's words.
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
    """One place of the paper.

    Attributes:
        equation: number or section.
        printed, used: the two forms.
        why: why it does not run as printed, or what had to be decided.
    """

    equation: str
    printed: str
    used: str
    why: str


CORRECTIONS: tuple[Correction, ...] = (
    Correction(
        "(46)",
        "R = Rx(roll) Ry(pitch) Rz(yaw) of passive rotations, which is world to body",
        "R = Rz(yaw) Ry(pitch) Rx(roll), its transpose",
        "Eq. 48 and 52 need body to world; with the printed form lateral thrust has the wrong sign.",
    ),
    Correction(
        "(48), (52), (55)",
        "R F with a scalar F",
        "R e3 F",
        "A matrix times a scalar is no force; thrust is along body z.",
    ),
    Correction(
        "(79)",
        "x' = A x + B u, called discretised, weights of lqr not given",
        "x_k+1 = A x_k + B u_k with acceleration held over dt; weights are settings",
        "A gain needs a model and weights.",
    ),
    Correction(
        "(83)",
        "F = (ua_z + g) m / (cos(pitch) cos(roll))",
        "the same, divisor at least 0.2, F at least 0",
        "Thrust grows without bound near 90 degrees; rotors do not pull.",
    ),
    Correction(
        "(85)",
        "E = integral of p(x|y)",
        "E[.] = integral of (.) p(x|y) dx, taken as the value at the smoothed mean",
        "The integrand is missing; eq. 107 and the appendix have no expectations either.",
    ),
    Correction(
        "(88), (94)",
        "x_k = Phi x_k-1 + w; x_p = x_k + dt x_k'",
        "x_k = x_k-1 + dt f(x_k-1, u_k-1; m, I) in both (eq. 56)",
        "Phi is a Jacobian, not the motion, and w has mean zero. The model of eq. 54 is the only one by which the "
        "estimates can go back to the E-step, as X-G says.",
    ),
    Correction(
        "(96)",
        "C = P / P_p",
        "C = P P_p^-1",
        "Matrices cannot be divided. P_p = P + Q (eq. 95) is kept, without Phi as printed.",
    ),
    Correction(
        "(97), (98)",
        "x_s on both sides without an index",
        "x_s,k = x_k + C_k (x_s,k+1 - x_p,k+1); eq. 98 is not computed",
        "The recursion needs its index; nothing reads the smoothed covariance.",
    ),
    Correction(
        "(72), III-C",
        "diag with zeros for what is not observed; nothing said about C's angles in the E-step",
        'H = 1, with C\'s angles read as zero ("zero"), or their rows dropped ("dead-reckoned")',
        "R0 is 12 by 12, and H of eq. 72 fits sensor A only. Reading zero is what gives the printed bias of C's mass.",
    ),
    Correction(
        "(107)",
        "a factor dt after the sum's bracket in the denominator",
        "none",
        "It gives m / dt, 36 kg.",
    ),
    Correction(
        "(116), (117)",
        "no bounds on the estimates",
        "with `clamp` the last mass is kept if the new one is not positive, the last inertia if the new one is beyond "
        "a factor 10 of I0; without it as printed",
        "After four samples the denominators can be of either sign and nearly zero; some flights then turn over.",
    ),
    Correction("(118)-(120)", "11 entries", "12 entries, all alike", "There are 12 states."),
    Correction(
        "XI-A2",
        "iterations per online update, state and covariance at the start of a window not given",
        "one iteration per update, from the first observation of the window with P0",
        '"200 iterations" until convergence are 800 samples at 4 each; P0 is the only covariance given.',
    ),
)
