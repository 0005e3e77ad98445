"""The estimator's inner loops in plain numpy and textbook form: the slow reference of the kernels in tests.

Extended Kalman filter with dense matrices and joint measurement updates; Rauch-Tung-Striebel smoother with the
covariance of the state at both ends of a step (lag-one); expectations taken from those. With an
accelerometer the state is augmented by the impulse of the step, of which the measurement is a component. With the
kernels it shares the model only (rigid_body.py).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rigid_body import State, angular_acceleration, bridge_covariance, step, step_jacobians

from crazyem.physics.rotations import quaternion_conjugate, quaternion_product, rotation_vector_from_quaternion


class Filtered(NamedTuple):
    """States and covariances before (predicted) and after (filtered) each sample; log-likelihood; transitions."""

    predicted: list[State]
    predicted_cov: NDArray  # (n, 12, 12)
    filtered: list[State]
    filtered_cov: NDArray  # (n, 12, 12)
    log_likelihood: float
    transition: NDArray  # (n, 12, 12), of the step that ends at each sample
    noise: NDArray  # (n, 12, 6)


class Smoothed(NamedTuple):
    """Smoothed errors relative to the filtered states, covariances, and the smoothed impulse of each step."""

    states: list[State]
    cov: NDArray  # (n, 12, 12)
    impulse: NDArray  # (n, 6), of the step that ends at each sample
    impulse_cov: NDArray  # (n, 6, 6)


def difference(a: State, b: State) -> NDArray:
    """Error (12,) that takes b to a."""
    turn = rotation_vector_from_quaternion(quaternion_product(quaternion_conjugate(b.attitude), a.attitude))
    return np.concatenate([a.position - b.position, a.velocity - b.velocity, turn, a.body_rate - b.body_rate])


def state_of(row: NDArray) -> State:
    """State from 13 numbers."""
    return State(row[0:3], row[3:6], row[6:10], row[10:13])


def extended_kalman_filter(
    time: NDArray, y: NDArray, thrust: NDArray, torque: NDArray, *, prior: State, prior_cov: NDArray,
    mass: float, inertia: NDArray, q: NDArray, r: NDArray, lead: float = 0.5,
) -> Filtered:  # fmt: skip
    """Filter over all samples; y (n, 13) with NaN where missing; thrust (n,), torque (n, 3) means of the steps.

    q (6,) impulse variances per second in units of acceleration, r (12,) measurement variances; `lead` as in
    rigid_body.py.
    """
    n = len(time)
    predicted: list[State] = []
    filtered: list[State] = []
    pp, pf = np.empty((n, 12, 12)), np.empty((n, 12, 12))
    transitions, noises = np.zeros((n, 12, 12)), np.zeros((n, 12, 6))
    log_likelihood = 0.0
    for k in range(n):
        if k == 0:
            x, cov = prior, prior_cov
        else:
            dt = time[k] - time[k - 1]
            phi, g = step_jacobians(filtered[-1], thrust[k], torque[k], dt=dt, mass=mass, inertia=inertia, lead=lead)
            x = step(filtered[-1], thrust[k], torque[k], dt=dt, mass=mass, inertia=inertia, lead=lead)
            cov = phi @ pf[k - 1] @ phi.T + g @ np.diag(q * dt) @ g.T + bridge_covariance(g, q, dt=dt, lead=lead)
            transitions[k], noises[k] = phi, g
        predicted.append(x)
        pp[k] = cov
        innovation = difference(state_of(y[k]), x)
        seen = ~np.isnan(innovation)
        h = np.eye(12)[seen]
        s = h @ cov @ h.T + np.diag(r[seen])
        gain = np.linalg.solve(s, h @ cov).T
        pf[k] = (np.eye(12) - gain @ h) @ cov
        filtered.append(x.plus(gain @ innovation[seen]))
        log_likelihood -= 0.5 * (
            innovation[seen] @ np.linalg.solve(s, innovation[seen]) + np.linalg.slogdet(2 * np.pi * s)[1]
        )
    return Filtered(predicted, pp, filtered, pf, log_likelihood, transitions, noises)


def rauch_tung_striebel(time: NDArray, filtered: Filtered, *, q: NDArray) -> Smoothed:
    """Smoother over a filter's result, with the smoothed impulse E[u | y], cov[u | y] of each step."""
    n = len(time)
    cov = filtered.filtered_cov.copy()
    states = list(filtered.filtered)
    impulse, impulse_cov = np.zeros((n, 6)), np.zeros((n, 6, 6))
    ahead = np.zeros(12)  # smoothed minus predicted at k + 1
    for k in range(n - 2, -1, -1):
        phi, g = filtered.transition[k + 1], filtered.noise[k + 1]
        pp = filtered.predicted_cov[k + 1]
        ahead = difference(states[k + 1], filtered.predicted[k + 1])
        gain = np.linalg.solve(pp, phi @ filtered.filtered_cov[k]).T
        states[k] = filtered.filtered[k].plus(gain @ ahead)
        cov[k] = filtered.filtered_cov[k] + gain @ (cov[k + 1] - pp) @ gain.T
        qd = np.diag(q * (time[k + 1] - time[k]))
        gain_u = np.linalg.solve(pp, g @ qd).T
        impulse[k + 1] = gain_u @ ahead
        impulse_cov[k + 1] = qd + gain_u @ (cov[k + 1] - pp) @ gain_u.T
    return Smoothed(states, cov, impulse, impulse_cov)


def expected_accelerations(
    time: NDArray, thrust: NDArray, torque: NDArray, smoothed: Smoothed, *, mass: float, inertia: NDArray
) -> tuple[NDArray, NDArray]:
    """Smoothed specific force (n, 3) m/s^2 and angular acceleration (n, 3) rad/s^2 of each step, body FLU."""
    n = len(time)
    force, acceleration = np.zeros((n, 3)), np.zeros((n, 3))
    for k in range(1, n):
        dt = time[k] - time[k - 1]
        force[k] = smoothed.impulse[k, :3] / dt + np.array([0.0, 0.0, thrust[k] / mass])
        rate = smoothed.states[k - 1].body_rate
        acceleration[k] = angular_acceleration(rate, torque[k], inertia=inertia) + smoothed.impulse[k, 3:] / dt
    return force, acceleration


class Augmented(NamedTuple):
    """Filter and smoother of state and impulse together: errors (12,) of the state, impulse (6,) of the step.

    Row k is the sample k and the step that ends there. `cov` and `impulse` of the smoother are marginals of one joint
    covariance (18, 18); the impulse's variance is in (m/s)^2 and (rad/s)^2.
    """

    filtered: list[State]
    filtered_cov: NDArray  # (n, 12, 12)
    log_likelihood: float
    smoothed: list[State]
    smoothed_cov: NDArray  # (n, 12, 12)
    impulse: NDArray  # (n, 6)
    impulse_cov: NDArray  # (n, 6, 6)


def augmented_smoother(
    time: NDArray, y: NDArray, force: NDArray, thrust: NDArray, torque: NDArray, *, prior: State, prior_cov: NDArray,
    mass: float, inertia: NDArray, q: NDArray, r: NDArray, r_force: float, lead: float = 0.5,
) -> Augmented:  # fmt: skip
    """Extended Kalman filter and Rauch-Tung-Striebel smoother with an accelerometer's readings among the measurements.

    force (n, 3) mean body-frame specific force over the step that ends at each sample [m/s^2], NaN where missing;
    r_force its variance; the rest as in `extended_kalman_filter`. The step is linearised at the impulse that the
    accelerometer alone suggests, and all measurements of a sample are one joint update.
    """
    n = len(time)
    transition, predicted_cov = np.zeros((n, 18, 18)), np.zeros((n, 18, 18))
    cov, mean = np.zeros((n, 18, 18)), np.zeros((n, 18))  # mean: of the error around (points, impulses)
    points: list[State] = []
    filtered: list[State] = []
    impulses, filtered_impulse = np.zeros((n, 6)), np.zeros((n, 6))
    log_likelihood = 0.0
    for k in range(n):
        measures = np.eye(18)[:12]
        noise = np.append(r, np.full(3, r_force))
        if k == 0:
            points.append(prior)
            predicted_cov[0, :12, :12] = prior_cov
            measured = np.append(difference(state_of(y[0]), prior), np.full(3, np.nan))
        else:
            dt = time[k] - time[k - 1]
            model = np.array([0.0, 0.0, thrust[k] / mass])
            impulses[k, :3] = np.nan_to_num(force[k] - model) * q[:3] / (q[:3] / dt + r_force)
            arguments = (filtered[-1], thrust[k], torque[k])
            points.append(step(*arguments, dt=dt, mass=mass, inertia=inertia, impulse=impulses[k], lead=lead))
            phi, g = step_jacobians(*arguments, dt=dt, mass=mass, inertia=inertia, impulse=impulses[k], lead=lead)
            transition[k, :12, :12] = phi
            both = np.vstack([g, np.eye(6)])
            predicted_cov[k] = transition[k] @ cov[k - 1] @ transition[k].T + both @ np.diag(q * dt) @ both.T
            predicted_cov[k, :12, :12] += bridge_covariance(g, q, dt=dt, lead=lead)
            mean[k] = -both @ impulses[k]
            measured = np.append(difference(state_of(y[k]), points[k]), force[k] - model - impulses[k, :3] / dt)
            measures = np.vstack([measures, np.eye(18)[12:15] / dt])
        seen = np.flatnonzero(~np.isnan(measured))
        innovation = measured[seen] - measures[seen] @ mean[k]
        s = measures[seen] @ predicted_cov[k] @ measures[seen].T + np.diag(noise[seen])
        gain = np.linalg.solve(s, measures[seen] @ predicted_cov[k]).T
        cov[k] = (np.eye(18) - gain @ measures[seen]) @ predicted_cov[k]
        error = mean[k] + gain @ innovation
        filtered.append(points[k].plus(error[:12]))
        filtered_impulse[k] = impulses[k] + error[12:]
        log_likelihood -= 0.5 * (innovation @ np.linalg.solve(s, innovation) + np.linalg.slogdet(2 * np.pi * s)[1])
    smoothed, smoothed_impulse, smoothed_cov = list(filtered), filtered_impulse.copy(), cov.copy()
    for k in range(n - 2, -1, -1):
        ahead = np.append(difference(smoothed[k + 1], points[k + 1]), smoothed_impulse[k + 1] - impulses[k + 1])
        gain = np.linalg.solve(predicted_cov[k + 1], transition[k + 1] @ cov[k]).T
        error = gain @ (ahead - mean[k + 1])
        smoothed[k] = filtered[k].plus(error[:12])
        smoothed_impulse[k] = filtered_impulse[k] + error[12:]
        smoothed_cov[k] = cov[k] + gain @ (smoothed_cov[k + 1] - predicted_cov[k + 1]) @ gain.T
    return Augmented(
        filtered, cov[:, :12, :12], log_likelihood, smoothed, smoothed_cov[:, :12, :12], smoothed_impulse,
        smoothed_cov[:, 12:, 12:],
    )  # fmt: skip
