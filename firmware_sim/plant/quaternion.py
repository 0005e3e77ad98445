"""Quaternions, scalar first, body to world; and the firmware's compressed form."""

import math

from firmware_sim.kernel import kernel


@kernel
def matrix(q, o, R):
    """R (3x3, filled in) of q[o:o+4], body to world."""
    w, x, y, z = q[o], q[o + 1], q[o + 2], q[o + 3]
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@kernel
def turn(q, o, ax, ay, az):
    """q[o:o+4] <- q * exp(a/2), a body rotation vector in rad; normalised."""
    n = math.sqrt(ax * ax + ay * ay + az * az)
    c = math.cos(0.5 * n)
    s = 0.5 - n * n / 48.0 if n < 1e-4 else math.sin(0.5 * n) / n
    w, x, y, z = q[o], q[o + 1], q[o + 2], q[o + 3]
    px, py, pz = s * ax, s * ay, s * az
    q[o] = w * c - x * px - y * py - z * pz
    q[o + 1] = w * px + x * c + y * pz - z * py
    q[o + 2] = w * py - x * pz + y * c + z * px
    q[o + 3] = w * pz + x * py - y * px + z * c
    normalise(q, o)


@kernel
def normalise(q, o):
    """q[o:o+4] to unit length."""
    n = math.sqrt(q[o] ** 2 + q[o + 1] ** 2 + q[o + 2] ** 2 + q[o + 3] ** 2)
    for i in range(4):
        q[o + i] /= n


@kernel
def roll_pitch_yaw(q, o):
    """Z-Y-X angles in rad, right-handed, of q[o:o+4]."""
    w, x, y, z = q[o], q[o + 1], q[o + 2], q[o + 3]
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(min(1.0, max(-1.0, 2 * (w * y - x * z))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return roll, pitch, yaw


@kernel
def compress(w, x, y, z):
    """The firmware's 32-bit smallest-three form (quatcompress.h): index of the largest of x, y, z, w in bits 30-31,
    then for the other three in order a sign and 9 bits of magnitude with scale 511 sqrt(2)."""
    q = (x, y, z, w)
    largest = 0
    for i in range(1, 4):
        if abs(q[i]) > abs(q[largest]):
            largest = i
    negate = q[largest] < 0.0
    packed = largest
    for i in range(4):
        if i != largest:
            magnitude = min(511, int(511.0 * abs(q[i]) * math.sqrt(2.0) + 0.5))
            packed = (packed << 10) | ((1 if (q[i] < 0.0) != negate else 0) << 9) | magnitude
    return packed
