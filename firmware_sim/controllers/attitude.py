"""Attitude geometry that the geometric controllers share: the wanted rotation and the rotation error."""

import math

import numpy as np

from firmware_sim.commander import setpoint as sp
from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.quaternion import roll_pitch_yaw


@kernel
def desired_yaw(setpoint, estimate, dt):
    """Desired yaw [rad]: given, from the quaternion, or the present yaw plus the rate times dt."""
    if setpoint[sp.MODE_YAW] == sp.VELOCITY:
        _, _, yaw = roll_pitch_yaw(estimate, at.E_QUAT)
        return yaw + math.radians(setpoint[sp.RATE_YAW]) * dt
    if setpoint[sp.MODE_YAW] == sp.ABSOLUTE:
        return math.radians(setpoint[sp.YAW])
    if setpoint[sp.MODE_QUAT] == sp.ABSOLUTE:
        q = np.empty(4)
        q[0], q[1], q[2], q[3] = setpoint[sp.QW], setpoint[sp.QX], setpoint[sp.QY], setpoint[sp.QZ]
        return roll_pitch_yaw(q, 0)[2]
    return 0.0


@kernel
def position_error(setpoint, estimate, axis, yaw):
    """Position and velocity error of an axis; an axis under velocity control has no position error.

    Returns (m, m/s), world. Velocities may be given in the yaw-aligned body frame.
    """
    mode = setpoint[sp.MODE_X + axis]
    e_pos = setpoint[sp.X + axis] - estimate[at.E_POS + axis] if mode == sp.ABSOLUTE else 0.0
    wanted = setpoint[sp.VX + axis]
    if setpoint[sp.VELOCITY_BODY] > 0.0 and axis < 2:
        c, s = math.cos(yaw), math.sin(yaw)
        vx, vy = setpoint[sp.VX], setpoint[sp.VY]
        wanted = c * vx - s * vy if axis == 0 else s * vx + c * vy
    e_vel = wanted - estimate[at.E_VEL + axis] if mode != sp.DISABLE else 0.0
    return e_pos, e_vel


@kernel
def any_absolute(setpoint):
    """Whether the setpoint gives a position along any axis."""
    return (
        setpoint[sp.MODE_X] == sp.ABSOLUTE or setpoint[sp.MODE_Y] == sp.ABSOLUTE or setpoint[sp.MODE_Z] == sp.ABSOLUTE
    )


@kernel
def align(force, yaw, D):
    """D (3x3): rotation whose z axis is along `force` and whose x axis points towards yaw [rad].

    No force gives the upright attitude.
    """
    n = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    zx, zy, zz = 0.0, 0.0, 1.0
    if n > 1e-9:
        zx, zy, zz = force[0] / n, force[1] / n, force[2] / n
    cx, cy = math.cos(yaw), math.sin(yaw)
    yx, yy, yz = -zz * cy, zz * cx, zx * cy - zy * cx
    m = math.sqrt(yx * yx + yy * yy + yz * yz)
    if m > 1e-9:
        yx, yy, yz = yx / m, yy / m, yz / m
    else:
        yx, yy, yz = 0.0, 1.0, 0.0
    D[0, 0], D[1, 0], D[2, 0] = yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx
    D[0, 1], D[1, 1], D[2, 1] = yx, yy, yz
    D[0, 2], D[1, 2], D[2, 2] = zx, zy, zz


@kernel
def from_angles(roll, pitch, yaw, D):
    """D (3x3) = Rz(yaw) Ry(pitch) Rx(roll), right-handed rad."""
    cr, sr, cp, sp_, cy, sy = (
        math.cos(roll),
        math.sin(roll),
        math.cos(pitch),
        math.sin(pitch),
        math.cos(yaw),
        math.sin(yaw),
    )
    D[0, 0], D[0, 1], D[0, 2] = cy * cp, cy * sp_ * sr - sy * cr, cy * sp_ * cr + sy * sr
    D[1, 0], D[1, 1], D[1, 2] = sy * cp, sy * sp_ * sr + cy * cr, sy * sp_ * cr - cy * sr
    D[2, 0], D[2, 1], D[2, 2] = -sp_, cp * sr, cp * cr


@kernel
def rotation_error(D, R, e):
    """e = vee(D'R - R'D) / 2 (Lee, Leok, McClamroch 2010, eq. 10)."""
    for i in range(3):
        a, b = (i + 2) % 3, (i + 1) % 3  # element (a, b) of the skew matrix
        s = 0.0
        for k in range(3):
            s += D[k, a] * R[k, b] - R[k, a] * D[k, b]
        e[i] = 0.5 * s


@kernel
def angles(D):
    """Roll, pitch, yaw in rad of a rotation matrix."""
    return (
        math.atan2(D[2, 1], D[2, 2]),
        math.asin(min(1.0, max(-1.0, -D[2, 0]))),
        math.atan2(D[1, 0], D[0, 0]),
    )


@kernel
def desired_rate(setpoint, mass, thrust, R, D, wr):
    """wr (3, rad/s): the rate of the desired rotation D from jerk and yaw rate, in the body axes of R.

    Thrust [N] over mass [kg] is the acceleration along body z (Mellinger and Kumar 2011, h_omega).
    """
    along = 0.0
    hx, hy = 0.0, 0.0
    if thrust > 1e-6:
        for i in range(3):
            along += D[i, 2] * setpoint[sp.JX + i]
        for i in range(3):
            h = mass / thrust * (setpoint[sp.JX + i] - along * D[i, 2])
            hx += h * D[i, 0]
            hy += h * D[i, 1]
    rate = math.radians(setpoint[sp.RATE_YAW]) * D[2, 2]
    for i in range(3):
        wr[i] = 0.0
        for k in range(3):
            wr[i] += R[k, i] * (D[k, 0] * -hy + D[k, 1] * hx + D[k, 2] * rate)
