"""What had to be corrected or decided in the paper's algorithm before it ran; all else was kept, wrong or not."""

from dataclasses import dataclass


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
