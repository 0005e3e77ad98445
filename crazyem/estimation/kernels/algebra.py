"""Small compiled functions of filter and smoother: rotations, Euler's equation, products with the transition matrix."""

import numpy as np

from crazyem.compiled import compiled

UPRIGHT = 0.05  # least cosine of pitch for steps in Euler angles


@compiled
def half_turn(w, h, q):
    """Write the quaternion of the rotation vector w * h into q."""
    x, y, z = w[0] * h, w[1] * h, w[2] * h
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-8:
        s = 0.5 - angle2 / 48.0
        c = 1.0 - angle2 / 8.0
    else:
        angle = np.sqrt(angle2)
        s = np.sin(0.5 * angle) / angle
        c = np.cos(0.5 * angle)
    q[0], q[1], q[2], q[3] = s * x, s * y, s * z, c


@compiled
def product(p, q, out):
    """Hamilton product p * q, scalar last, normalised."""
    x = p[3] * q[0] + p[0] * q[3] + p[1] * q[2] - p[2] * q[1]
    y = p[3] * q[1] - p[0] * q[2] + p[1] * q[3] + p[2] * q[0]
    z = p[3] * q[2] + p[0] * q[1] - p[1] * q[0] + p[2] * q[3]
    w = p[3] * q[3] - p[0] * q[0] - p[1] * q[1] - p[2] * q[2]
    n = 1.0 / np.sqrt(x * x + y * y + z * z + w * w)
    out[0], out[1], out[2], out[3] = x * n, y * n, z * n, w * n


@compiled
def matrix(q, m):
    """Rotation matrix of a quaternion into m (3, 3)."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    m[0, 0], m[0, 1], m[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    m[1, 0], m[1, 1], m[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    m[2, 0], m[2, 1], m[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)


@compiled
def log(q, out):
    """Rotation vector of a quaternion, with an angle up to pi."""
    sign = 1.0 if q[3] >= 0 else -1.0
    s = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    f = 2.0 * sign if s < 1e-9 else 2.0 * sign * np.arctan2(s, sign * q[3]) / s
    out[0], out[1], out[2] = f * q[0], f * q[1], f * q[2]


@compiled
def angular_acceleration(w, torque, inertia, inverse, out):
    """Euler's equation: out = I^-1 (torque - w x I w)."""
    l0 = inertia[0, 0] * w[0] + inertia[0, 1] * w[1] + inertia[0, 2] * w[2]
    l1 = inertia[1, 0] * w[0] + inertia[1, 1] * w[1] + inertia[1, 2] * w[2]
    l2 = inertia[2, 0] * w[0] + inertia[2, 1] * w[1] + inertia[2, 2] * w[2]
    t0 = torque[0] - (w[1] * l2 - w[2] * l1)
    t1 = torque[1] - (w[2] * l0 - w[0] * l2)
    t2 = torque[2] - (w[0] * l1 - w[1] * l0)
    for i in range(3):
        out[i] = inverse[i, 0] * t0 + inverse[i, 1] * t1 + inverse[i, 2] * t2


@compiled
def rate_jacobian(w, inertia, inverse, dt, out):
    """out = I + dt d(angular acceleration)/dw."""
    l0 = inertia[0, 0] * w[0] + inertia[0, 1] * w[1] + inertia[0, 2] * w[2]
    l1 = inertia[1, 0] * w[0] + inertia[1, 1] * w[1] + inertia[1, 2] * w[2]
    l2 = inertia[2, 0] * w[0] + inertia[2, 1] * w[1] + inertia[2, 2] * w[2]
    s = np.empty((3, 3))
    for j in range(3):  # skew(I w) - skew(w) I
        s[0, j] = w[2] * inertia[1, j] - w[1] * inertia[2, j]
        s[1, j] = w[0] * inertia[2, j] - w[2] * inertia[0, j]
        s[2, j] = w[1] * inertia[0, j] - w[0] * inertia[1, j]
    s[0, 1] -= l2
    s[0, 2] += l1
    s[1, 0] += l2
    s[1, 2] -= l0
    s[2, 0] -= l1
    s[2, 1] += l0
    for i in range(3):
        for j in range(3):
            out[i, j] = dt * (inverse[i, 0] * s[0, j] + inverse[i, 1] * s[1, j] + inverse[i, 2] * s[2, j])
        out[i, i] += 1.0


@compiled
def right_jacobian(phi, out):
    """d log(exp(phi)^-1 exp(phi + d)) / dd to second order in phi, as in benchmarks/rigid_body.py."""
    x0, x1, x2 = phi[0], phi[1], phi[2]
    n2 = x0 * x0 + x1 * x1 + x2 * x2
    for i in range(3):
        for j in range(3):
            out[i, j] = phi[i] * phi[j] / 6.0
        out[i, i] += 1.0 - n2 / 6.0
    out[0, 1] += 0.5 * x2
    out[0, 2] -= 0.5 * x1
    out[1, 0] -= 0.5 * x2
    out[1, 2] += 0.5 * x0
    out[2, 0] += 0.5 * x1
    out[2, 1] -= 0.5 * x0


@compiled
def explicit_turn(q, start, w, dt, out, by_attitude, by_rate):
    """Attitude `out` after an explicit Euler step of roll, pitch and yaw, with its Jacobian blocks.

    start (3, 3) is the rotation matrix of q. Near a pitch of a right angle, returns False and changes nothing. Euler
    angles are not computed: out = Rz(dyaw) Rq Rx(-roll) Ry(dpitch) Rx(roll) Rx(droll), with the turns about y and x in
    the body frame.
    """
    sp = -start[2, 0]
    cp = np.sqrt(start[2, 1] ** 2 + start[2, 2] ** 2)
    if cp <= UPRIGHT:
        return False
    sr, cr = start[2, 1] / cp, start[2, 2] / cp
    along, across = sr * w[1] + cr * w[2], cr * w[1] - sr * w[2]
    turn = np.empty(3)
    part = np.empty(4)
    turn[0], turn[1], turn[2] = 0.0, 0.0, along / cp
    half_turn(turn, dt, part)
    product(part, q, out)
    turn[0], turn[1], turn[2] = 0.0, across * cr, -across * sr
    half_turn(turn, dt, part)
    product(out, part, out)
    turn[0], turn[1], turn[2] = w[0] + sp / cp * along, 0.0, 0.0
    half_turn(turn, dt, part)
    product(out, part, out)
    # sines and cosines of roll and pitch after the step
    sp1 = -2 * (out[0] * out[2] - out[1] * out[3])
    r21, r22 = 2 * (out[1] * out[2] + out[0] * out[3]), 1 - 2 * (out[0] * out[0] + out[1] * out[1])
    cp1 = np.sqrt(r21 * r21 + r22 * r22)
    sr1, cr1 = r21 / cp1, r22 / cp1
    for j in range(3):
        # derivatives by body error j: of the angles before the step, of the angles after it, of the error after it
        roll = 1.0 if j == 0 else (sr if j == 1 else cr) * sp / cp
        pitch = 0.0 if j == 0 else (cr if j == 1 else -sr)
        yaw = 0.0 if j == 0 else (sr if j == 1 else cr) / cp
        by_rate[0, j] = dt * (roll - sp1 * yaw)
        by_rate[1, j] = dt * (cr1 * pitch + sr1 * cp1 * yaw)
        by_rate[2, j] = dt * (cr1 * cp1 * yaw - sr1 * pitch)
        roll1 = roll + dt * (across * sp / cp * roll + along / (cp * cp) * pitch)
        pitch1 = pitch - dt * along * roll
        yaw1 = yaw + dt * (across / cp * roll + along * sp / (cp * cp) * pitch)
        by_attitude[0, j] = roll1 - sp1 * yaw1
        by_attitude[1, j] = cr1 * pitch1 + sr1 * cp1 * yaw1
        by_attitude[2, j] = cr1 * cp1 * yaw1 - sr1 * pitch1
    return True


@compiled
def specific_force(model, measured, q, dt, r_force, mean, left):
    """Condition the mean specific force of a step on the accelerometer; returns the measurement's log-likelihood.

    The measurement is model + u/dt + noise. The impulse u ~ N(0, q dt) is independent of the filter's state, so each
    axis is conditioned on its own. model (3,), measured (3,; NaN: not measured) and mean (3,) in m/s^2; left (3,)
    receives the remaining intensity of the impulse; q and left in (m/s)^2/s.
    """
    loglik = 0.0
    for i in range(3):
        mean[i] = model[i]
        left[i] = q[i]
        if not np.isnan(measured[i]):
            var = q[i] / dt + r_force
            err = measured[i] - model[i]
            mean[i] += q[i] / dt * err / var
            left[i] = q[i] * r_force / var
            loglik -= 0.5 * (np.log(2 * np.pi * var) + err * err / var)
    return loglik


@compiled
def apply(blocks, dt, h, x, out):
    """out = Phi x for x (12, n); blocks are dv/dtheta, dv/dw, dtheta/dtheta, dtheta/dw, dw/dw of the transition.

    h = lead dt: p' = p + (dt - h) v + h v'.
    """
    n = x.shape[1]
    rest = dt - h
    for i in range(3):
        a0, a1, a2 = blocks[0, i, 0], blocks[0, i, 1], blocks[0, i, 2]
        b0, b1, b2 = blocks[1, i, 0], blocks[1, i, 1], blocks[1, i, 2]
        c0, c1, c2 = blocks[2, i, 0], blocks[2, i, 1], blocks[2, i, 2]
        d0, d1, d2 = blocks[3, i, 0], blocks[3, i, 1], blocks[3, i, 2]
        e0, e1, e2 = blocks[4, i, 0], blocks[4, i, 1], blocks[4, i, 2]
        for j in range(n):
            t0, t1, t2 = x[6, j], x[7, j], x[8, j]
            w0, w1, w2 = x[9, j], x[10, j], x[11, j]
            v = x[3 + i, j] + a0 * t0 + a1 * t1 + a2 * t2 + b0 * w0 + b1 * w1 + b2 * w2
            out[i, j] = x[i, j] + rest * x[3 + i, j] + h * v
            out[3 + i, j] = v
            out[6 + i, j] = c0 * t0 + c1 * t1 + c2 * t2 + d0 * w0 + d1 * w1 + d2 * w2
            out[9 + i, j] = e0 * w0 + e1 * w1 + e2 * w2


@compiled
def apply_transposed(blocks, dt, h, x, out):
    """out = Phi' x for x (12, n)."""
    n = x.shape[1]
    for i in range(3):
        a0, a1, a2 = blocks[0, 0, i], blocks[0, 1, i], blocks[0, 2, i]
        b0, b1, b2 = blocks[1, 0, i], blocks[1, 1, i], blocks[1, 2, i]
        c0, c1, c2 = blocks[2, 0, i], blocks[2, 1, i], blocks[2, 2, i]
        d0, d1, d2 = blocks[3, 0, i], blocks[3, 1, i], blocks[3, 2, i]
        e0, e1, e2 = blocks[4, 0, i], blocks[4, 1, i], blocks[4, 2, i]
        for j in range(n):
            v0, v1, v2 = x[3, j] + h * x[0, j], x[4, j] + h * x[1, j], x[5, j] + h * x[2, j]
            t0, t1, t2 = x[6, j], x[7, j], x[8, j]
            out[i, j] = x[i, j]
            out[3 + i, j] = x[3 + i, j] + dt * x[i, j]
            out[6 + i, j] = a0 * v0 + a1 * v1 + a2 * v2 + c0 * t0 + c1 * t1 + c2 * t2
            out[9 + i, j] = (
                b0 * v0 + b1 * v1 + b2 * v2 + d0 * t0 + d1 * t1 + d2 * t2
                + e0 * x[9, j] + e1 * x[10, j] + e2 * x[11, j]
            )  # fmt: skip
