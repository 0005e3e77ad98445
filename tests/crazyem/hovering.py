"""A hovering drone whose mass steps: level, small angles, own arithmetic; made for tests of changes in flight."""

import math

import numpy as np

from crazyem.signals.sample import Sample

G = 9.81  # m/s^2
INERTIA = (1.66e-5, 1.67e-5, 2.93e-5)  # kg m^2


def hover(masses, *, seed=0, duration=10.0, believed=0.029, gust=(math.inf, math.inf, 0.0), force_noise=1e-3, lag=0.05):
    """Samples at 100 Hz of a drone whose mass is `masses`: [(from s, kg), ...], held by a controller that believes one.

    Steps of 1 ms: white force and torque, first-order lag of thrust and torque, PD control on what is measured. `gust`:
    from s to s, a force along z [N] that is no mass.
    """
    r = np.random.default_rng(seed)
    dt, n = 1e-3, int(1000 * duration)
    inertia = np.array(INERTIA)
    p, v, angle, rate = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    command, acting = np.array([believed * G, 0, 0, 0]), np.array([masses[0][1] * G, 0, 0, 0])
    decay = math.exp(-dt / lag)
    sensor = (1e-3, 5e-3, 3e-3, 3e-3)
    out = []
    for k in range(n):
        t = k * dt
        mass = [m for since, m in masses if since <= t][-1]
        if k % 10 == 0:
            y = [x + s * r.standard_normal(3) for x, s in zip((p, v, angle, rate), sensor)]
            f = believed * (G - 7.0 * y[0][2] - 4.0 * y[1][2])
            tilt = np.array([(7.0 * y[0][1] + 4.0 * y[1][1]) / G, -(7.0 * y[0][0] + 4.0 * y[1][0]) / G, 0.0])
            torque = inertia * (350.0 * (tilt - y[2]) - 57.0 * y[3])
            torque = torque + 1e-4 * np.sin(2 * math.pi * np.array([2.1, 2.7, 1.9]) * t + np.array([0.0, 1.0, 2.0]))
            command = np.array([f, *torque])
            half = y[2] / 2
            q = np.array([*half, 1.0]) / math.sqrt(1.0 + half @ half)
            out += [
                Sample("position", t, tuple(y[0] + [0.0, 0.0, 1.0])),
                Sample("velocity", t, tuple(y[1])),
                Sample("attitude", t, tuple(q)),
                Sample("body_rate", t, tuple(y[3])),
                Sample("wrench_command", t, tuple(command)),
                Sample("flying", t, (1.0,)),
            ]
        acting = command + (acting - command) * decay
        force = acting[0] + force_noise / math.sqrt(dt) * r.standard_normal()
        torque = acting[1:] + 5e-6 / math.sqrt(dt) * r.standard_normal(3)
        a = np.array([angle[1], -angle[0], 1.0]) * force / mass - [0.0, 0.0, G]
        if gust[0] <= t < gust[1]:
            a[2] += gust[2] / mass
        p, v = p + dt * v, v + dt * a
        angle, rate = angle + dt * rate, rate + dt * torque / inertia
    return out
