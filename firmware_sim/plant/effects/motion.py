"""Forces and torques on a body with effects, about its centre of mass c; with effects they replace plain contact.

Floor, air, cable and the forces of `external` act at the geometric origin, b = -c from the centre of mass: the force
stays, and the torque gains b x force. The state's position and velocity are those of the centre of mass; `origin` and
`origin_velocity` give those of the geometric origin, to which positions, truth files and feet refer.
"""

import numpy as np

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.air import add_cable_force, air_forces
from firmware_sim.plant.quaternion import matrix
from firmware_sim.plant.rigid_body import contact


@kernel
def act(truth, x, u, force, torque, ambient, R, f, t, v):
    """Set f [N, world] and t [N m, body, about the centre of mass] of a body in state x, without weight and load.

    u: [F, Mx, My, Mz] of the rotors. force, torque: held over the step, at the origin. ambient: velocity of the air
    [m/s, world] and the rotors' angular momentum [N m s]. v = velocity of the origin. Returns the feet on the floor.
    """
    w, p, at_origin = x[10:13], np.empty(3), np.empty(3)
    shift(truth, x[0:3], x[3:6], R, w, p, v)
    for i in range(3):
        at_origin[i] = force[i]
        f[i] = R[i, 2] * u[0]
        t[i] = u[1 + i] + torque[i]
    touching = contact(truth, p, v, R, w, at_origin, t)
    air_forces(truth, R, v, w, ambient, at_origin, t)
    add_cable_force(truth, p, at_origin)
    for i in range(3):
        f[i] += at_origin[i]
    gx = R[0, 0] * at_origin[0] + R[1, 0] * at_origin[1] + R[2, 0] * at_origin[2]
    gy = R[0, 1] * at_origin[0] + R[1, 1] * at_origin[1] + R[2, 1] * at_origin[2]
    gz = R[0, 2] * at_origin[0] + R[1, 2] * at_origin[1] + R[2, 2] * at_origin[2]
    cx, cy, cz = truth[at.COM], truth[at.COM + 1], truth[at.COM + 2]
    t[0] -= cy * gz - cz * gy
    t[1] -= cz * gx - cx * gz
    t[2] -= cx * gy - cy * gx
    t[0] -= w[1] * ambient[3]
    t[1] += w[0] * ambient[3]
    return touching


@kernel
def shift(truth, p, v, R, w, p_origin, v_origin):
    """Position and velocity of the geometric origin from those of the centre of mass (world)."""
    cx, cy, cz = truth[at.COM], truth[at.COM + 1], truth[at.COM + 2]
    ux, uy, uz = w[1] * cz - w[2] * cy, w[2] * cx - w[0] * cz, w[0] * cy - w[1] * cx
    for i in range(3):
        p_origin[i] = p[i] - (R[i, 0] * cx + R[i, 1] * cy + R[i, 2] * cz)
        v_origin[i] = v[i] - (R[i, 0] * ux + R[i, 1] * uy + R[i, 2] * uz)


@kernel
def origin(truth, state, p, v):
    """p, v: position [m] and velocity [m/s] of the geometric origin, world."""
    R = np.empty((3, 3))
    matrix(state, at.QUAT, R)
    shift(truth, state[at.POS : at.POS + 3], state[at.VEL : at.VEL + 3], R, state[at.OMEGA : at.OMEGA + 3], p, v)


@kernel
def ambient_forces(truth, state, ambient):
    """ambient = velocity of the air [m/s, world] and the rotors' angular momentum along body z [N m s]."""
    for i in range(3):
        ambient[i] = truth[at.WIND + i] + state[at.GUST + i]
    ambient[3] = state[at.SPIN]


@kernel
def static_forces(truth, state, ambient, force, torque, out_force, out_torque):
    """Forces on a drone that stands still, without floor and weight: external, air and cable."""
    R, p, v = np.empty((3, 3)), np.empty(3), np.empty(3)
    matrix(state, at.QUAT, R)
    origin(truth, state, p, v)
    for i in range(3):
        out_force[i], out_torque[i] = force[i], torque[i]
    air_forces(truth, R, v, state[at.OMEGA : at.OMEGA + 3], ambient, out_force, out_torque)
    add_cable_force(truth, p, out_force)
