"""Gains of the LQG controller: discrete linear-quadratic regulators at 500 Hz from the weights in ctrlLqg.*.

Position, one axis: x = [p, v], u = acceleration.  Attitude, one axis: x = [angle, rate, angular acceleration] with the
rotor lag tau between the commanded and the actual angular acceleration. Cost: sum of q x^2 and r u^2. The onboard
filter supplies the state (certainty equivalence), so mass and inertia scale only the output (Zhao, eq. 79-84).
Default weights: 1 m/s^2 is worth about 0.14 m; 30 rad/s^2 about 0.1 rad.
"""

import numpy as np
from scipy.linalg import expm, solve_discrete_are

DT = 0.002  # s


def design(
    *,
    tau: float,
    q_pos: float,
    q_vel: float,
    r_acc: float,
    q_att: float,
    q_rate: float,
    r_ang: float,
    q_yaw: float,
    q_yawrate: float,
    r_yaw: float,
) -> np.ndarray | None:
    """[K_p 1/s^2, K_v 1/s, roll and pitch: K 1/s^2, 1/s, -, yaw: K 1/s^2, 1/s, -] (8), or None for senseless weights.

    tau: rotor lag in s; q_*: weights of the state (>= 0, those of position and angles > 0); r_*: of the input (> 0).
    """
    positive = (tau, q_pos, r_acc, q_att, r_ang, q_yaw, r_yaw)
    if not all(np.isfinite([*positive, q_vel, q_rate, q_yawrate])) or min(positive) <= 0.0:
        return None
    integrator = np.array([[0.0, 1.0], [0.0, 0.0]])
    rotor = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / tau]])
    try:
        gains = np.concatenate(
            [
                regulator(integrator, np.array([0.0, 1.0]), np.array([q_pos, q_vel]), r_acc),
                regulator(rotor, np.array([0.0, 0.0, 1.0 / tau]), np.array([q_att, q_rate, 0.0]), r_ang),
                regulator(rotor, np.array([0.0, 0.0, 1.0 / tau]), np.array([q_yaw, q_yawrate, 0.0]), r_yaw),
            ]
        )
    except (np.linalg.LinAlgError, ValueError):
        return None
    return gains if np.all(np.isfinite(gains)) else None


def regulator(A: np.ndarray, b: np.ndarray, q: np.ndarray, r: float) -> np.ndarray:
    """Gain K (n) of u = -K x for dx = A x + b u held over DT, cost diag(q), r."""
    n = len(b)
    M = expm(DT * np.block([[A, b[:, None]], [np.zeros((1, n + 1))]]))
    Ad, Bd = M[:n, :n], M[:n, n:]
    P = solve_discrete_are(Ad, Bd, np.diag(q), np.array([[r]]))
    return np.linalg.solve(r + Bd.T @ P @ Bd, Bd.T @ P @ Ad)[0]
