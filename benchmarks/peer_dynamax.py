"""The E-step with dynamax 1.x: its extended Kalman filter and smoother, jit-compiled by JAX for the CPU, 64 bit.

Same window, same parameters, same midpoint discretisation, with roll, pitch and yaw for the attitude (dynamax has no
manifolds). The process noise, which depends on the state, is computed from the measured attitude outside the measured
time. dynamax has no lag-one statistics and no M-step, so it does less than the pass of the comparison.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from window import Window, euler_from_quaternion, euler_measurements, euler_prior, euler_rates, rotation


def make(window: Window) -> Callable[[], float]:
    """A call that runs filter and smoother over the window and returns the log-likelihood.

    Raises:
        ImportError: dynamax is not installed.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_smoother

    mass, inertia, inverse = window.mass, jnp.asarray(window.inertia), jnp.asarray(np.linalg.inv(window.inertia))
    gravity = jnp.array([0.0, 0.0, 9.81])

    def rates(euler: Any, w: Any) -> Any:
        s, c, t = jnp.sin(euler[0]), jnp.cos(euler[0]), jnp.tan(euler[1])
        across = s * w[1] + c * w[2]
        return jnp.array([w[0] + t * across, c * w[1] - s * w[2], across / jnp.cos(euler[1])])

    def dynamics(x: Any, u: Any) -> Any:
        p, v, euler, w = x[0:3], x[3:6], x[6:9], x[9:12]
        dt, force, torque = u[0], u[1], u[2:5]
        e = euler + 0.5 * dt * rates(euler, w)
        (sr, sp, sy), (cr, cp, cy) = jnp.sin(e), jnp.cos(e)
        up = jnp.array([cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr])
        v2 = v + dt * (up * force / mass - gravity)
        w2 = w + dt * inverse @ (torque - jnp.cross(w, inertia @ w))
        e2 = euler + dt * rates(e, 0.5 * (w + w2))
        return jnp.concatenate([p + 0.5 * dt * (v + v2), v2, e2, w2])

    mean, cov = euler_prior(window)
    steps = np.diff(window.time, prepend=window.time[0])
    params = ParamsNLGSSM(
        initial_mean=jnp.asarray(mean),
        initial_covariance=jnp.asarray(cov),
        dynamics_function=dynamics,
        dynamics_covariance=jnp.asarray(process_noise(window)),
        emission_function=lambda x, u: x,
        emission_covariance=jnp.asarray(np.diag(window.r)),
    )
    inputs = jnp.asarray(np.column_stack([steps, window.thrust, window.torque]))
    y = jnp.asarray(euler_measurements(window))

    # parameters are arguments, as in an EM iteration, so that the compiler cannot treat them as constants
    @jax.jit
    def smooth(mean: Any, cov: Any, q: Any, r: Any, y: Any, inputs: Any) -> Any:
        p = params._replace(initial_mean=mean, initial_covariance=cov, dynamics_covariance=q, emission_covariance=r)
        posterior = extended_kalman_smoother(p, y, inputs=inputs)
        return posterior.marginal_loglik, posterior.smoothed_means, posterior.smoothed_covariances

    def run() -> float:
        result = smooth(
            params.initial_mean, params.initial_covariance, params.dynamics_covariance, params.emission_covariance, y,
            inputs,
        )  # fmt: skip
        jax.block_until_ready(result)
        return float(result[0])

    run()  # compiles
    return run


def process_noise(window: Window) -> np.ndarray:
    """Covariances (n, 12, 12) of the steps that end at each sample, in roll-pitch-yaw coordinates."""
    n = len(window.time)
    euler = euler_from_quaternion(window.y[:, 6:10])
    euler[1:] = euler[:-1].copy()  # attitude at the start of the step
    turn, rate = rotation(euler), euler_rates(euler)
    dt = np.diff(window.time, prepend=window.time[0])[:, None, None]
    force = turn @ np.diag(window.q[:3]) @ turn.transpose(0, 2, 1)
    spin = np.broadcast_to(np.diag(window.q[3:]), (n, 3, 3))
    out = np.zeros((n, 12, 12))
    third = dt**3 / 3.0  # impulse at the ends of the step, and the bridge between them
    out[:, 0:3, 0:3] = third * force
    out[:, 0:3, 3:6] = out[:, 3:6, 0:3] = dt**2 / 2 * force
    out[:, 3:6, 3:6] = dt * force
    out[:, 6:9, 6:9] = third * rate @ spin @ rate.transpose(0, 2, 1)
    out[:, 6:9, 9:12] = dt**2 / 2 * rate @ spin
    out[:, 9:12, 6:9] = out[:, 6:9, 9:12].transpose(0, 2, 1)
    out[:, 9:12, 9:12] = dt * spin
    out[0] = np.eye(12)
    return out
