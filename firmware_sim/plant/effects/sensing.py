"""Delayed or wrong measurements: attitude_misalignment, accelerometer_misalignment, gyro_bias, velocity_scale,
measurement_delay, rotor_sensor, and the hidden magnetic_yaw.

    pose fix      p = origin + noise,  q = q_z(A sin(2 pi x / wavelength)) * q_body * q_P * noise  (built-in fixes)
    accelerometer S' f_body + noise,   S = Rz(yaw) Ry(pitch) Rx(roll): the sensor's axes in the body; q_P likewise
                  (effects/step.py turns it)
    gyro          w + bias + noise     (the bias is set at boot, flight.py)
    reported v    velocity_scale * v   each world axis, after the filter: for controllers and log, not for the filter
    rpm           scale * rpm          the log only (controllers/externalise.py)

measurement_delay gives the values of `delay` ago, linearly interpolated between milliseconds: of the true pose, of gyro
and accelerometer after their filters, or of the state (the logged estimate only).
"""

import math

import numpy as np

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.motion import origin
from firmware_sim.plant.quaternion import normalise


@kernel
def fix_pose(truth, state, sensor, tick, p, q):
    """p, q: position and attitude that a fix of this tick shows, before its noise."""
    if not truth[at.EFFECT_SENSING] > 0.0:
        for i in range(3):
            p[i] = state[at.POS + i]
        for i in range(4):
            q[i] = state[at.QUAT + i]
        return
    pose = np.empty(7)
    if truth[at.DELAY_POSE] > 0.0:
        delayed_sample(sensor, at.PAST_POSE, 7, tick, truth[at.DELAY_POSE], pose, 3)
    else:
        origin_pose(truth, state, pose)
    for i in range(3):
        p[i] = pose[i]
    half = 0.5 * truth[at.YAW_AMPLITUDE] * math.sin(2.0 * math.pi * pose[0] / truth[at.YAW_WAVELENGTH])
    c, s = math.cos(half), math.sin(half)
    multiply(c, 0.0, 0.0, s, pose[3], pose[4], pose[5], pose[6], q)
    t = at.POSE_TURN
    multiply(q[0], q[1], q[2], q[3], truth[t], truth[t + 1], truth[t + 2], truth[t + 3], q)


@kernel
def origin_pose(truth, state, pose):
    """pose = true position of the geometric origin and true attitude."""
    v = np.empty(3)
    origin(truth, state, pose, v)
    for i in range(4):
        pose[3 + i] = state[at.QUAT + i]


@kernel
def multiply(a, b, c, d, w, x, y, z, out):
    """out = (a, b, c, d) * (w, x, y, z), scalars first."""
    out[0] = a * w - b * x - c * y - d * z
    out[1] = a * x + b * w + c * z - d * y
    out[2] = a * y - b * z + c * w + d * x
    out[3] = a * z + b * y - c * x + d * w


@kernel
def store_sample(sensor, ring, width, tick, values):
    """Put the `width` values of this tick into a ring."""
    row = ring + width * (tick % at.DELAY_ROWS)
    for i in range(width):
        sensor[row + i] = values[i]


@kernel
def delayed_sample(sensor, ring, width, tick, delay, values, quaternion):
    """values = those of `delay` ms ago; a quaternion starts at index `quaternion` (-1: none). In the first
    `delay` ms they are the first values."""
    whole = math.floor(delay)
    part = delay - whole
    near = ring + width * (max(tick - whole, 0) % at.DELAY_ROWS)
    far = ring + width * (max(tick - whole - 1, 0) % at.DELAY_ROWS)
    dot = 0.0
    if quaternion >= 0:
        for i in range(quaternion, quaternion + 4):
            dot += sensor[near + i] * sensor[far + i]
    for i in range(width):
        past = sensor[far + i]
        if dot < 0.0 and quaternion <= i < quaternion + 4:
            past = -past
        values[i] = (1.0 - part) * sensor[near + i] + part * past
    if quaternion >= 0:
        normalise(values, quaternion)


@kernel
def delay_sensors(truth, state, sensor, tick):
    """Store this tick's pose for delayed fixes; replace the filtered gyro and accelerometer by delayed ones."""
    if truth[at.DELAY_POSE] > 0.0:
        pose = np.empty(7)
        origin_pose(truth, state, pose)
        store_sample(sensor, at.PAST_POSE, 7, tick, pose)
    gyro, acc = sensor[at.GYRO : at.GYRO + 3], sensor[at.ACCEL : at.ACCEL + 3]
    if truth[at.DELAY_GYRO] > 0.0:
        store_sample(sensor, at.PAST_GYRO, 3, tick, gyro)
        delayed_sample(sensor, at.PAST_GYRO, 3, tick, truth[at.DELAY_GYRO], gyro, -1)
    if truth[at.DELAY_ACC] > 0.0:
        store_sample(sensor, at.PAST_ACC, 3, tick, acc)
        delayed_sample(sensor, at.PAST_ACC, 3, tick, truth[at.DELAY_ACC], acc, -1)


@kernel
def scale_velocity(truth, sensor, estimate):
    """Save the estimate and scale its velocity until `restore_estimate`."""
    for i in range(10):
        sensor[at.KEPT + i] = estimate[at.E_POS + i]
    for i in range(3):
        estimate[at.E_VEL + i] *= truth[at.VELOCITY_SCALE + i]


@kernel
def delay_estimate(truth, sensor, estimate, tick):
    """Replace estimate, gyro and accelerometer by delayed ones until `restore_estimate`."""
    values = np.empty(16)
    for i in range(10):
        values[i] = estimate[at.E_POS + i]
    for i in range(6):
        values[10 + i] = sensor[at.GYRO + i]
        sensor[at.KEPT + 10 + i] = sensor[at.GYRO + i]
    if truth[at.DELAY_STATE] > 0.0:
        store_sample(sensor, at.PAST_STATE, 16, tick, values)
        delayed_sample(sensor, at.PAST_STATE, 16, tick, truth[at.DELAY_STATE], values, 6)
        for i in range(10):
            estimate[at.E_POS + i] = values[i]
        for i in range(6):
            sensor[at.GYRO + i] = values[10 + i]


@kernel
def restore_estimate(sensor, estimate):
    """Undo `scale_velocity` and `delay_estimate`."""
    for i in range(10):
        estimate[at.E_POS + i] = sensor[at.KEPT + i]
    for i in range(6):
        sensor[at.GYRO + i] = sensor[at.KEPT + 10 + i]
