"""The rigid body: 13 states integrated with RK4 at 1 kHz, then the process noise by Euler-Maruyama; and the flat floor.

dp = v dt;  m dv = (R e3 F + f_ext - m g e3) dt + R e3 s_F dW_0;  dq = q w/2 dt;
J dw = (M + m_ext - w x J w) dt + s_M dW   (Zhao, eq. 54-55 with the full inertia matrix and R e3 = third column of R).
effects/step.py is for a body with effects; the equations are written out in both, because a call costs time here.

The drone stands on four feet under the rotors, each a spring and damper with Coulomb friction. The spring is soft
enough for a 1 ms step (see scenario.py) and its rest position is shifted so that the drone stands at exactly the
floor's height. No foot pulls, so the drone leaves when its thrust exceeds its weight.
"""

import math

import numpy as np

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.quaternion import matrix, normalise

GRAVITY = 9.81


@kernel
def contact(truth, p, v, R, w, force, torque):
    """Add the floor's force [N, world] and torque [N m, body]; returns the number of feet that touch.

    p, v: position m and velocity m/s (world) as arrays, of the geometric origin, which the torque is about; R body to
    world; w body rate rad/s.
    """
    if p[2] > truth[at.FLOOR] + truth[at.FEET_REACH]:
        return 0
    m4 = 0.25 * truth[at.STANDING_MASS]
    wc = truth[at.CONTACT_FREQUENCY]
    sag = GRAVITY / (wc * wc)
    touching = 0
    for leg in range(4):
        bx = truth[at.ARM] if leg < 2 else -truth[at.ARM]
        by = truth[at.ARM_Y] if leg % 2 == 0 else -truth[at.ARM_Y]
        rx, ry, rz = R[0, 0] * bx + R[0, 1] * by, R[1, 0] * bx + R[1, 1] * by, R[2, 0] * bx + R[2, 1] * by
        depth = truth[at.FLOOR] + sag - (p[2] + rz)
        if depth <= 0.0:
            continue
        # velocity of the foot: v + R (w x b), b = (bx, by, 0)
        ux, uy, uz = -w[2] * by, w[2] * bx, w[0] * by - w[1] * bx
        vx = v[0] + R[0, 0] * ux + R[0, 1] * uy + R[0, 2] * uz
        vy = v[1] + R[1, 0] * ux + R[1, 1] * uy + R[1, 2] * uz
        vz = v[2] + R[2, 0] * ux + R[2, 1] * uy + R[2, 2] * uz
        fz = m4 * (wc * wc * depth - 2.0 * truth[at.CONTACT_DAMPING] * wc * vz)
        if fz <= 0.0:
            continue
        touching += 1
        speed = math.sqrt(vx * vx + vy * vy)
        slip = m4 * truth[at.CONTACT_STICK]  # viscous below the Coulomb limit: sticks without a stiff spring
        if slip * speed > truth[at.FRICTION] * fz:
            slip = truth[at.FRICTION] * fz / speed
        fx, fy = -slip * vx, -slip * vy
        force[0] += fx
        force[1] += fy
        force[2] += fz
        tx, ty, tz = ry * fz - rz * fy, rz * fx - rx * fz, rx * fy - ry * fx
        for i in range(3):
            torque[i] += R[0, i] * tx + R[1, i] * ty + R[2, i] * tz
    return touching


SPEED_LIMIT = 100.0  # m/s
RATE_LIMIT = 200.0  # rad/s


@kernel
def newton_euler(truth, x, w, f, t, dx):
    """dx/dt of x = [p, v, q, w] under force f [N, world] and torque t [N m, body] about the centre of mass, and weight.

    w is x[10:13]; t gains the gyroscopic torque.
    """
    gyroscopic(truth, w, t)
    V = at.INERTIA_INV
    for i in range(3):
        dx[i] = x[3 + i]
        dx[3 + i] = f[i] / truth[at.MASS]
        dx[10 + i] = truth[V + 3 * i] * t[0] + truth[V + 3 * i + 1] * t[1] + truth[V + 3 * i + 2] * t[2]
    dx[5] -= GRAVITY
    qw, qx, qy, qz = x[6], x[7], x[8], x[9]
    dx[6] = 0.5 * (-qx * w[0] - qy * w[1] - qz * w[2])
    dx[7] = 0.5 * (qw * w[0] + qy * w[2] - qz * w[1])
    dx[8] = 0.5 * (qw * w[1] + qz * w[0] - qx * w[2])
    dx[9] = 0.5 * (qw * w[2] + qx * w[1] - qy * w[0])


@kernel
def gyroscopic(truth, w, t):
    """t <- t - w x J w."""
    J = at.INERTIA
    hx = truth[J] * w[0] + truth[J + 1] * w[1] + truth[J + 2] * w[2]
    hy = truth[J + 3] * w[0] + truth[J + 4] * w[1] + truth[J + 5] * w[2]
    hz = truth[J + 6] * w[0] + truth[J + 7] * w[1] + truth[J + 8] * w[2]
    t[0] -= w[1] * hz - w[2] * hy
    t[1] -= w[2] * hx - w[0] * hz
    t[2] -= w[0] * hy - w[1] * hx


@kernel
def derivative(truth, x, u, force, torque, dx, R, f, t):
    """dx/dt of x = [p, v, q, w] (13) under u = [F, Mx, My, Mz] and an external force (world) and torque (body).

    R (3x3), f (3) and t (3) are scratch. Returns the number of feet on the floor.
    """
    matrix(x, 6, R)
    w = x[10:13]
    for i in range(3):
        f[i] = force[i] + R[i, 2] * u[0]
        t[i] = torque[i] + u[1 + i]
    touching = contact(truth, x[0:3], x[3:6], R, w, f, t)
    newton_euler(truth, x, w, f, t, dx)
    return touching


@kernel
def body_step(truth, state, u, force, torque, noise, dt):
    """Advance position, velocity, attitude and body rate by dt and set the specific force; noise only off the floor.

    For a body without effects; effects/step.py has the others.
    """
    x = state[0:13]
    R = np.empty((3, 3))
    f, t, w, before = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    k, y, total = np.empty(13), np.empty(13), np.empty(13)
    for i in range(3):
        before[i] = x[3 + i]
    if is_resting(truth, state, u, force, torque):
        matrix(x, 6, R)
        for i in range(3):
            state[at.VEL + i] = 0.0
            state[at.OMEGA + i] = 0.0
            state[at.ACC + i] = GRAVITY * R[2, i]
        state[at.ASLEEP] = 1.0
        return
    state[at.ASLEEP] = 0.0
    touching = derivative(truth, x, u, force, torque, k, R, f, t)
    for i in range(13):
        total[i] = k[i]
        y[i] = x[i] + 0.5 * dt * k[i]
    derivative(truth, y, u, force, torque, k, R, f, t)
    for i in range(13):
        total[i] += 2.0 * k[i]
        y[i] = x[i] + 0.5 * dt * k[i]
    derivative(truth, y, u, force, torque, k, R, f, t)
    for i in range(13):
        total[i] += 2.0 * k[i]
        y[i] = x[i] + dt * k[i]
    derivative(truth, y, u, force, torque, k, R, f, t)
    for i in range(13):
        x[i] += dt / 6.0 * (total[i] + k[i])
    normalise(x, 6)
    matrix(x, 6, R)
    state[at.FEET] = touching
    if touching == 0:
        root = math.sqrt(dt)
        kick = truth[at.NOISE_THRUST] / truth[at.MASS] * root * noise[at.N_THRUST]
        for i in range(3):
            x[3 + i] += R[i, 2] * kick
            w[i] = truth[at.NOISE_TORQUE + i] * root * noise[at.N_TORQUE + i]
        V = at.INERTIA_INV
        for i in range(3):
            x[10 + i] += truth[V + 3 * i] * w[0] + truth[V + 3 * i + 1] * w[1] + truth[V + 3 * i + 2] * w[2]
    for i in range(3):  # far above realistic speeds; keeps extreme scenarios finite
        x[3 + i] = min(max(x[3 + i], -SPEED_LIMIT), SPEED_LIMIT)
        x[10 + i] = min(max(x[10 + i], -RATE_LIMIT), RATE_LIMIT)
        w[i] = (x[3 + i] - before[i]) / dt
    w[2] += GRAVITY
    for i in range(3):
        state[at.ACC + i] = R[0, i] * w[0] + R[1, i] * w[1] + R[2, i] * w[2]


@kernel
def is_resting(truth, state, u, force, torque):
    """True if the drone stands still on all four feet and no force could move it: it is then not integrated."""
    if state[at.FEET] < 4:
        return False
    weight = truth[at.STANDING_MASS] * GRAVITY
    if u[0] + abs(force[0]) + abs(force[1]) + abs(force[2]) > 0.3 * weight:
        return False
    limit = 0.1 * weight * truth[at.ARM]
    for i in range(3):
        if abs(u[1 + i] + torque[i]) > limit or abs(state[at.VEL + i]) > 2e-3 or abs(state[at.OMEGA + i]) > 0.05:
            return False
    return True
