"""The same estimate as a moving-horizon problem: CasADi builds it, IPOPT (MUMPS) solves it.

Decision variables are the 12 states at every sample, the six impulses of every step, and the logarithms of mass and the
three moments of inertia; the cost is the negative log-posterior of measurements and impulses with the noise scales
given. The solution is the joint mode of states and parameters over one window; EM uses expectations of states instead.
Multiple shooting, exact Hessians, same midpoint rule as the estimator, roll-pitch-yaw for the attitude.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from window import Window, euler_measurements, euler_prior


@dataclass(frozen=True)
class Solution:
    """Result of one solve: theta (4,) mass [kg], Ixx, Iyy, Izz [kg m^2]; IPOPT's iterations; whether it succeeded."""

    theta: NDArray
    iterations: int
    success: bool


def make(window: Window) -> Callable[[], Solution]:
    """A call that solves the window from the measurements and the window's parameters (a warm start).

    Raises:
        ImportError: casadi is not installed.
    """
    import casadi as ca

    n = len(window.time)
    start = np.array([window.mass, *np.diag(window.inertia)])
    x, w, ratio, u = ca.SX.sym("x", 12), ca.SX.sym("w", 6), ca.SX.sym("ratio", 4), ca.SX.sym("u", 5)
    theta = ca.DM(start) * ca.exp(ratio)
    dt, force, torque = u[0], u[1], u[2:5]

    def rates(e: ca.SX, rate: ca.SX) -> ca.SX:
        s, c = ca.sin(e[0]), ca.cos(e[0])
        across = s * rate[1] + c * rate[2]
        return ca.vertcat(rate[0] + ca.tan(e[1]) * across, c * rate[1] - s * rate[2], across / ca.cos(e[1]))

    p, v, euler, omega = x[0:3], x[3:6], x[6:9], x[9:12]
    e = euler + 0.5 * dt * rates(euler, omega)
    sr, sp, sy = (ca.sin(e[i]) for i in range(3))
    cr, cp, cy = (ca.cos(e[i]) for i in range(3))
    turn = ca.vertcat(
        ca.horzcat(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        ca.horzcat(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        ca.horzcat(-sp, cp * sr, cp * cr),
    )
    scale = np.sqrt(window.q * float(np.median(np.diff(window.time))))  # so that w is of order one
    v2 = v + dt * (turn[:, 2] * force / theta[0] - ca.vertcat(0, 0, 9.81)) + turn @ (scale[:3] * w[:3])
    moments = theta[1:4]
    omega2 = omega + dt * (torque - ca.cross(omega, moments * omega)) / moments + scale[3:] * w[3:]
    e2 = euler + dt * rates(e, 0.5 * (omega + omega2))
    step = ca.Function("step", [x, u, w, ratio], [ca.vertcat(p + 0.5 * dt * (v + v2), v2, e2, omega2)])

    states, impulses, ratios = ca.MX.sym("X", 12, n), ca.MX.sym("W", 6, n - 1), ca.MX.sym("ratio", 4)
    inputs = np.column_stack([np.diff(window.time), window.thrust[1:], window.torque[1:]]).T
    reached = step.map(n - 1)(states[:, :-1], inputs, impulses, ca.repmat(ratios, 1, n - 1))
    y = euler_measurements(window)
    mean, cov = euler_prior(window)
    information = np.linalg.inv(cov)
    residual = (states - y.T) / np.sqrt(window.r)[:, None]
    first = states[:, 0] - mean
    cost = 0.5 * (ca.sumsqr(residual) + ca.sumsqr(impulses) + ca.dot(first, ca.mtimes(information, first)))
    problem = {
        "x": ca.veccat(states, impulses, ratios),
        "f": cost,
        "g": ca.vec(states[:, 1:] - reached),
    }
    options = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.max_iter": 100, "expand": False}
    solver = ca.nlpsol("mhe", "ipopt", problem, options)
    guess = np.concatenate([y.ravel(), np.zeros(6 * (n - 1) + 4)])

    def run() -> Solution:
        result = solver(x0=guess, lbg=0.0, ubg=0.0)
        found = start * np.exp(np.asarray(result["x"]).ravel()[-4:])
        statistics = solver.stats()
        return Solution(found, int(statistics["iter_count"]), bool(statistics["success"]))

    return run
