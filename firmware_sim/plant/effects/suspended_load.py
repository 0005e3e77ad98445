"""suspended_load: a point mass m_l on a massless rod of length L (a string always taut) at the geometric origin.

States: n, unit vector from hook to load (world), and dn/dt. With b = -c the hook from the centre of mass, a_h its
acceleration, g_l = g - friction (v_l - wind), v_l = v_h + L dn/dt:

    T = m_l (n.g_l - n.a_h0 + L |dn/dt|^2) / (1 + m_l K),  K = 1/m + (b x R'n)' J^-1 (b x R'n)
    body: force T n, torque b x (R'n) T;   L d2n/dt2 = g_l - T n / m_l - a_h

a_h0: the hook's acceleration without T. Exact coupling, no stiff spring; T may push, so slack strings are outside the
model. The floor does not stop the load. Source: Newton's and Euler's equations, solved for T.
"""

import math

import numpy as np

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.rigid_body import GRAVITY, gyroscopic

SWING_LIMIT = 200.0  # 1/s; keeps extreme scenarios finite


@kernel
def add_string_force(truth, x, R, v_hook, air, f, t, dx):
    """Add the tension to force f [N, world] and torque t [N m, body]; set the derivatives dx[13:19] of the load.

    f, t: everything else that acts on the body, without weight and gyroscopic torque; v_hook [m/s, world].
    """
    m, ml, length = truth[at.MASS], truth[at.LOAD_MASS], truth[at.LOAD_LENGTH]
    w, n, swing = x[10:13], x[13:16], x[16:19]
    nu, arm, gain = np.empty(3), np.empty(3), np.empty(3)
    K = lever(truth, R, n, nu, arm, gain)
    hook, load, whole = np.empty(3), np.empty(3), t.copy()
    gyroscopic(truth, w, whole)
    hook_acceleration(truth, R, w, f, whole, hook)
    along, turning = 0.0, 0.0
    for i in range(3):
        load[i] = -truth[at.LOAD_FRICTION] * (v_hook[i] + length * swing[i] - air[i])
        if i == 2:
            load[i] -= GRAVITY
        along += n[i] * (load[i] - hook[i])
        turning += swing[i] * swing[i]
    per_mass = (along + length * turning) / (1.0 + ml * K)  # tension over the load's mass
    tension = ml * per_mass
    for i in range(3):
        f[i] += tension * n[i]
        t[i] += tension * arm[i]
    b0, b1, b2 = -truth[at.COM], -truth[at.COM + 1], -truth[at.COM + 2]
    cx, cy, cz = gain[1] * b2 - gain[2] * b1, gain[2] * b0 - gain[0] * b2, gain[0] * b1 - gain[1] * b0
    for i in range(3):
        moved = hook[i] + tension * (n[i] / m + R[i, 0] * cx + R[i, 1] * cy + R[i, 2] * cz)
        dx[13 + i] = swing[i]
        dx[16 + i] = (load[i] - per_mass * n[i] - moved) / length


@kernel
def lever(truth, R, n, nu, arm, gain):
    """K [1/kg] of the module's docstring; nu = R'n, arm = b x nu, gain = J^-1 arm."""
    c, V = at.COM, at.INERTIA_INV
    for i in range(3):
        nu[i] = R[0, i] * n[0] + R[1, i] * n[1] + R[2, i] * n[2]
    arm[0] = -truth[c + 1] * nu[2] + truth[c + 2] * nu[1]
    arm[1] = -truth[c + 2] * nu[0] + truth[c] * nu[2]
    arm[2] = -truth[c] * nu[1] + truth[c + 1] * nu[0]
    K = 1.0 / truth[at.MASS]
    for i in range(3):
        gain[i] = truth[V + 3 * i] * arm[0] + truth[V + 3 * i + 1] * arm[1] + truth[V + 3 * i + 2] * arm[2]
        K += arm[i] * gain[i]
    return K


@kernel
def hook_acceleration(truth, R, w, f, t, out):
    """out = acceleration [m/s^2, world] of the hook under force f (without gravity) and torque t about the centre."""
    V, c = at.INERTIA_INV, at.COM
    alpha = np.empty(3)
    for i in range(3):
        alpha[i] = truth[V + 3 * i] * t[0] + truth[V + 3 * i + 1] * t[1] + truth[V + 3 * i + 2] * t[2]
    bx, by, bz = -truth[c], -truth[c + 1], -truth[c + 2]
    ux, uy, uz = w[1] * bz - w[2] * by, w[2] * bx - w[0] * bz, w[0] * by - w[1] * bx
    ax = alpha[1] * bz - alpha[2] * by + w[1] * uz - w[2] * uy
    ay = alpha[2] * bx - alpha[0] * bz + w[2] * ux - w[0] * uz
    az = alpha[0] * by - alpha[1] * bx + w[0] * uy - w[1] * ux
    for i in range(3):
        out[i] = f[i] / truth[at.MASS] + R[i, 0] * ax + R[i, 1] * ay + R[i, 2] * az
    out[2] -= GRAVITY


@kernel
def share_impulse(truth, x, R, dv, dw):
    """Let the load take its part of a sudden change dv [m/s, world], dw [rad/s, body] of the body's motion."""
    n = x[13:16]
    nu, arm, gain = np.empty(3), np.empty(3), np.empty(3)
    K = lever(truth, R, n, nu, arm, gain)
    ml, c = truth[at.LOAD_MASS], at.COM
    hook = np.empty(3)
    hook_impulse(truth[c], truth[c + 1], truth[c + 2], R, dv, dw, hook)
    per_mass = -(n[0] * hook[0] + n[1] * hook[1] + n[2] * hook[2]) / (1.0 + ml * K)
    for i in range(3):
        dv[i] += ml * per_mass * n[i] / truth[at.MASS]
        dw[i] += ml * per_mass * gain[i]
    hook_impulse(truth[c], truth[c + 1], truth[c + 2], R, dv, dw, hook)
    for i in range(3):
        x[16 + i] += (-per_mass * n[i] - hook[i]) / truth[at.LOAD_LENGTH]


@kernel
def hook_impulse(cx, cy, cz, R, dv, dw, out):
    """out = dv + R (dw x b), b = -(cx, cy, cz)."""
    ux, uy, uz = -dw[1] * cz + dw[2] * cy, -dw[2] * cx + dw[0] * cz, -dw[0] * cy + dw[1] * cx
    for i in range(3):
        out[i] = dv[i] + R[i, 0] * ux + R[i, 1] * uy + R[i, 2] * uz


@kernel
def normalise_string(x):
    """Remove the drift of integration: n to unit length, dn/dt perpendicular to n and within limits."""
    size = math.sqrt(x[13] ** 2 + x[14] ** 2 + x[15] ** 2)
    along = 0.0
    for i in range(3):
        x[13 + i] /= size
        along += x[13 + i] * x[16 + i]
    for i in range(3):
        x[16 + i] = min(max(x[16 + i] - along * x[13 + i], -SWING_LIMIT), SWING_LIMIT)


@kernel
def rest_load(state):
    """Put the load vertically below the hook, at rest."""
    for i in range(3):
        state[at.LOAD + i] = -1.0 if i == 2 else 0.0
        state[at.LOAD_RATE + i] = 0.0
