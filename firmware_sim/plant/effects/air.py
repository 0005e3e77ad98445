"""Forces on the body from outside: drag, moments, wind and gusts; hidden ones: vibration, cable_spring.

    v_a = R' (v - wind - gust)                      the origin's velocity through the air, body axes
    force  = -D v_a - Q |v_a| v_a                   body axes, at the geometric origin (D, Q diagonal)
    torque = (roll_per_vy v_ay, pitch_per_vx v_ax, 0) - B w
    without any drag: force = WIND_DRAG (wind + gust), world axes, so that wind 0 has no effect
    gust <- gust exp(-dt/T) + sd sqrt(1 - exp(-2 dt/T)) N(0, 1)   each world axis, stationary from the start

Sources: Foerster 2015 and Faessler et al., RA-L 2018 (linear rotor drag); the Ornstein-Uhlenbeck process, exactly.

vibration (not in the catalogue): torque A (cos p, sin p, 0) in body axes that turns with one rotor, dp/dt = +- ratio
* rotor speed; its exact average over each step. cable_spring (also not there): force stiffness (r - length) on the
geometric origin towards a fixed point of the world at distance r; zero when slack (r < length); undamped.
"""

import math

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at


@kernel
def gusts_step(truth, state, noise, dt):
    """Advance the gusts by dt."""
    keep = math.exp(-dt / truth[at.GUST_TIME]) if state[at.CLOCK] > 0.0 else 0.0
    kick = truth[at.GUST_SD] * math.sqrt(1.0 - keep * keep)
    for i in range(3):
        state[at.GUST + i] = keep * state[at.GUST + i] + kick * noise[at.N_GUST + i]


@kernel
def air_forces(truth, R, v, w, air, force, torque):
    """Add force [N, world] and torque [N m, body] of the air that moves with `air` [m/s, world].

    v: velocity of the geometric origin [m/s, world]; w: body rate [rad/s].
    """
    sx, sy, sz = v[0] - air[0], v[1] - air[1], v[2] - air[2]
    ax = R[0, 0] * sx + R[1, 0] * sy + R[2, 0] * sz
    ay = R[0, 1] * sx + R[1, 1] * sy + R[2, 1] * sz
    az = R[0, 2] * sx + R[1, 2] * sy + R[2, 2] * sz
    speed = math.sqrt(ax * ax + ay * ay + az * az)
    d, q = at.LINEAR_DRAG, at.QUADRATIC_DRAG
    fx = -(truth[d] + truth[q] * speed) * ax
    fy = -(truth[d + 1] + truth[q + 1] * speed) * ay
    fz = -(truth[d + 2] + truth[q + 2] * speed) * az
    for i in range(3):
        force[i] += R[i, 0] * fx + R[i, 1] * fy + R[i, 2] * fz + truth[at.WIND_DRAG] * air[i]
        torque[i] -= truth[at.RATE_DAMPING + i] * w[i]
    torque[0] += truth[at.ROLL_PER_VY] * ay
    torque[1] += truth[at.PITCH_PER_VX] * ax


@kernel
def vibration_step(truth, state, dt, torque):
    """Add the vibration's mean torque [N m, body] over dt and advance its phase."""
    i = int(truth[at.VIBRATION_ROTOR]) - 1
    speed = truth[at.VIBRATION_RATIO] * math.sqrt(max(state[at.ROTOR + i], 0.0) / truth[at.ROTOR_CONSTANT])
    half = 0.5 * speed * dt if i % 2 == 0 else -0.5 * speed * dt  # M1 and M3 counter-clockwise from above
    if half != 0.0:
        mean = truth[at.VIBRATION_TORQUE] * math.sin(half) / half
        torque[0] += mean * math.cos(state[at.PHASE] + half)
        torque[1] += mean * math.sin(state[at.PHASE] + half)
        state[at.PHASE] = (state[at.PHASE] + 2.0 * half) % (2.0 * math.pi)


@kernel
def add_cable_force(truth, p, force):
    """Add the spring's force [N, world] on the geometric origin at p [m, world]."""
    k = at.CABLE_POINT
    dx, dy, dz = truth[k] - p[0], truth[k + 1] - p[1], truth[k + 2] - p[2]
    r = math.sqrt(dx * dx + dy * dy + dz * dz)
    if r > truth[at.CABLE_LENGTH] and r > 0.0:
        pull = truth[at.CABLE_STIFFNESS] * (r - truth[at.CABLE_LENGTH]) / r
        force[0] += pull * dx
        force[1] += pull * dy
        force[2] += pull * dz
