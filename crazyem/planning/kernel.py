"""Compiled simulation of a rigid body with rotor lag under Lee's controller (controller_lee.c)."""

import numpy as np

from crazyem.compiled import compiled
from crazyem.vehicle import GRAVITY

# Age, in steps of the loop, of the controller's measurements: of rates by their low pass at 80 Hz (2.8 ms) and the hold
# of the command (1 ms), of poses by this hold and the 10 ms between two predictions of the onboard estimate (5 ms).
RATE_AGE, POSE_AGE = 2, 3


@compiled
def fly_loop(wanted, dt, mass, inertia, lag, mixing, unmixing, most, kr, ki, kw, kp, kd, pushes, errors, state, seen,
         command, thrust):  # fmt: skip
    """Simulate a flight, one step of the control loop after the other.

    Args:
        wanted: (n, 11) position m, velocity m/s, acceleration m/s^2 (world), yaw rad, yaw rate rad/s.
        dt: s. mass: kg. inertia: (3,) kg m^2. lag: s.
        mixing, unmixing: (4, 4) thrusts [N] to force and torques [N, N m], and back.
        most: N, of one rotor.
        kr, ki, kw: (3,) gains of attitude, its integral, rate. kp, kd: of position and velocity.
        pushes: (n, 6) changes of velocity m/s and body rate rad/s by noise in each step, body axes.
        errors: (n, 12) of measured position, velocity, attitude (rad, body), body rate.
        state, seen: (n, 13), command, thrust: (n, 4) N; receive the flight.
    """
    p, v, w, e, total = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    force, torque, d = np.zeros(3), np.zeros(4), np.zeros((3, 3))
    r = np.eye(3)
    quaternion = np.array([0.0, 0.0, 0.0, 1.0])
    f = np.full(4, mass * GRAVITY / 4)
    decay = np.exp(-dt / lag) if lag > 0 else 0.0
    acc, alpha = np.zeros(3), np.zeros(3)
    for k in range(len(wanted)):
        # measurements; a small error of attitude is a rotation about body axes
        for i in range(3):
            state[k, i], state[k, 3 + i], state[k, 10 + i] = p[i], v[i], w[i]
            seen[k, i] = p[i] + errors[k, i]
            seen[k, 3 + i] = v[i] + errors[k, 3 + i]
            seen[k, 10 + i] = w[i] + errors[k, 9 + i]
        x, y, z, s = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
        ex, ey, ez = 0.5 * errors[k, 6], 0.5 * errors[k, 7], 0.5 * errors[k, 8]
        state[k, 6], state[k, 7], state[k, 8], state[k, 9] = x, y, z, s
        qx = x + s * ex + y * ez - z * ey
        qy = y + s * ey + z * ex - x * ez
        qz = z + s * ez + x * ey - y * ex
        qs = s - x * ex - y * ey - z * ez
        norm = np.sqrt(qx * qx + qy * qy + qz * qz + qs * qs)
        qx, qy, qz, qs = qx / norm, qy / norm, qz / norm, qs / norm
        seen[k, 6], seen[k, 7], seen[k, 8], seen[k, 9] = qx, qy, qz, qs
        at, turned = max(k - POSE_AGE, 0), max(k - RATE_AGE, 0)  # steps of the controller's measurements
        qx, qy, qz, qs = seen[at, 6], seen[at, 7], seen[at, 8], seen[at, 9]
        r[0, 0], r[0, 1], r[0, 2] = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qz * qs), 2 * (qx * qz + qy * qs)
        r[1, 0], r[1, 1], r[1, 2] = 2 * (qx * qy + qz * qs), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qx * qs)
        r[2, 0], r[2, 1], r[2, 2] = 2 * (qx * qz - qy * qs), 2 * (qy * qz + qx * qs), 1 - 2 * (qx * qx + qy * qy)
        # Lee's law
        for i in range(3):
            force[i] = wanted[k, 6 + i] + kd * (wanted[k, 3 + i] - seen[at, 3 + i]) + kp * (wanted[k, i] - seen[at, i])
        force[2] += GRAVITY
        torque[0] = mass * (force[0] * r[0, 2] + force[1] * r[1, 2] + force[2] * r[2, 2])
        size = np.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
        cy, sy = np.cos(wanted[k, 9]), np.sin(wanted[k, 9])
        for i in range(3):
            d[i, 2] = force[i] / size
        # y = z x heading, normalised; x = y x z
        yx, yy, yz = -d[2, 2] * sy, d[2, 2] * cy, d[0, 2] * sy - d[1, 2] * cy
        size = np.sqrt(yx * yx + yy * yy + yz * yz)
        d[0, 1], d[1, 1], d[2, 1] = yx / size, yy / size, yz / size
        d[0, 0] = d[1, 1] * d[2, 2] - d[2, 1] * d[1, 2]
        d[1, 0] = d[2, 1] * d[0, 2] - d[0, 1] * d[2, 2]
        d[2, 0] = d[0, 1] * d[1, 2] - d[1, 1] * d[0, 2]
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            e[i] = 0.0
            for m in range(3):  # 1/2 vee(D'R - R'D)
                e[i] += 0.5 * (d[m, b] * r[m, a] - r[m, b] * d[m, a])
            turn = wanted[k, 10] * d[2, 2] if i == 2 else 0.0
            total[i] += dt * e[i]
            torque[1 + i] = -kr[i] * e[i] - ki[i] * total[i] - kw[i] * (seen[turned, 10 + i] - turn)
        for i in range(4):
            u = 0.0
            for m in range(4):
                u += unmixing[i, m] * torque[m]
            command[k, i] = min(max(u, 0.0), most)
            thrust[k, i] = f[i]
        # the body, with the mean of the lagged thrusts over the step
        torque[:] = 0.0
        for i in range(4):
            after = command[k, i] + (f[i] - command[k, i]) * decay
            mean = command[k, i] + (f[i] - command[k, i]) * (1.0 - decay) * lag / dt
            f[i] = after
            for m in range(4):
                torque[m] += mixing[m, i] * mean
        bx, by, bz = 2 * (x * z + y * s), 2 * (y * z - x * s), 1 - 2 * (x * x + y * y)
        lift = torque[0] / mass
        acc[0], acc[1], acc[2] = bx * lift, by * lift, bz * lift - GRAVITY
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            alpha[i] = (torque[1 + i] - (inertia[b] - inertia[a]) * w[a] * w[b]) / inertia[i]
        ix, iy, iz = pushes[k, 0], pushes[k, 1], pushes[k, 2]
        for i in range(3):
            push = iz * (bx if i == 0 else by if i == 1 else bz) + (ix if i == 0 else iy if i == 1 else 0.0)
            p[i] += dt * (v[i] + 0.5 * dt * acc[i])
            v[i] += dt * acc[i] + push
            before = w[i]
            w[i] = before + dt * alpha[i] + pushes[k, 3 + i]
            e[i] = 0.25 * dt * (before + w[i])
        quaternion[0] = x + s * e[0] + y * e[2] - z * e[1]
        quaternion[1] = y + s * e[1] + z * e[0] - x * e[2]
        quaternion[2] = z + s * e[2] + x * e[1] - y * e[0]
        quaternion[3] = s - x * e[0] - y * e[1] - z * e[2]
        norm = np.sqrt(np.sum(quaternion * quaternion))
        for i in range(4):
            quaternion[i] /= norm
