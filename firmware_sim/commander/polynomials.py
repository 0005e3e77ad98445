"""Polynomial trajectories: seventh-order segments in x, y, z and yaw, and the motion of a drone on them.

A polynomial is 8 coefficients, constant first. Positions in m (world), yaw in rad, time in s. Plain Python: one
evaluation per 10 ms needs no arrays. Source: crazyflie-firmware pptraj.c, pptraj_compressed.c; flatness after Mellinger
and Kumar 2011.
"""

import math
import struct
from dataclasses import dataclass

DEGREE = 7
GRAVITY = 9.81  # m/s^2, as the firmware has it
Vector = tuple[float, float, float]
Polynomial = tuple[float, ...]


@dataclass(frozen=True)
class Evaluation:
    """A point of a trajectory: position .. jerk [m .. m/s^3, world], yaw [rad], body rates omega [rad/s]."""

    position: Vector
    velocity: Vector
    acceleration: Vector
    jerk: Vector
    yaw: float
    yaw_rate: float
    omega: Vector


@dataclass(frozen=True)
class Piece:
    """Four polynomials (x, y, z, yaw) that hold for duration [s]."""

    polynomials: tuple[Polynomial, Polynomial, Polynomial, Polynomial]
    duration: float


def seventh_order(duration: float, start: Vector, end: Vector) -> Polynomial:
    """The polynomial with value, first and second derivative `start` at 0 and `end` at duration, and no jerk at either.

    With a duration of zero or less it starts at the end, as in the firmware.
    """
    x0, v0, a0 = start
    x1, v1, a1 = end
    T = duration
    if T <= 0.0:
        return (x1, v1, a1 / 2.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    d = x1 - x0
    return (
        x0,
        v0,
        a0 / 2.0,
        0.0,
        (70.0 * d - T * (40.0 * v0 + 30.0 * v1) - T**2 * (10.0 * a0 - 5.0 * a1)) / (2.0 * T**4),
        (-84.0 * d + T * (45.0 * v0 + 39.0 * v1) + T**2 * (10.0 * a0 - 7.0 * a1)) / T**5,
        (140.0 * d - T * (72.0 * v0 + 68.0 * v1) - T**2 * (15.0 * a0 - 13.0 * a1)) / (2.0 * T**6),
        (-20.0 * d + T * (10.0 * v0 + 10.0 * v1) + T**2 * (2.0 * a0 - 2.0 * a1)) / T**7,
    )


def derivatives(polynomial: Polynomial, t: float) -> tuple[float, float, float, float]:
    """Value and first three derivatives at t."""
    p0 = p1 = p2 = p3 = 0.0
    for coefficient in reversed(polynomial):  # Horner's rule for the value and its Taylor coefficients at t
        p3 = p3 * t + p2
        p2 = p2 * t + p1
        p1 = p1 * t + p0
        p0 = p0 * t + coefficient
    return p0, p1, 2.0 * p2, 6.0 * p3


def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _unit(a: Vector) -> Vector:
    norm = math.sqrt(_dot(a, a)) or 1.0
    return (a[0] / norm, a[1] / norm, a[2] / norm)


def evaluate(piece: Piece, t: float) -> Evaluation:
    """The piece at t [s]; body rates from differential flatness (x and y rates from the jerk, z from the yaw rate)."""
    x, y, z, psi = (derivatives(polynomial, t) for polynomial in piece.polynomials)
    acceleration, jerk = (x[2], y[2], z[2]), (x[3], y[3], z[3])
    thrust = (acceleration[0], acceleration[1], acceleration[2] + GRAVITY)
    z_body = _unit(thrust)
    y_body = _unit(_cross(z_body, (math.cos(psi[0]), math.sin(psi[0]), 0.0)))
    x_body = _cross(y_body, z_body)
    along = _dot(jerk, z_body)
    norm = math.sqrt(_dot(thrust, thrust)) or 1.0
    h = tuple((jerk[n] - along * z_body[n]) / norm for n in range(3))
    h_w = (h[0], h[1], h[2])
    return Evaluation(
        position=(x[0], y[0], z[0]),
        velocity=(x[1], y[1], z[1]),
        acceleration=acceleration,
        jerk=jerk,
        yaw=psi[0],
        yaw_rate=psi[1],
        omega=(-_dot(h_w, y_body), _dot(h_w, x_body), z_body[2] * psi[1]),
    )


def stretched(piece: Piece, scale: float) -> Piece:
    """The same path in scale times the duration."""
    x, y, z, yaw = (tuple(c / scale**n for n, c in enumerate(p)) for p in piece.polynomials)
    return Piece((x, y, z, yaw), piece.duration * scale)


def reversed_piece(piece: Piece) -> Piece:
    """The same path flown backwards: p(duration - t)."""
    flipped = []
    for polynomial in piece.polynomials:
        remainder, taylor = list(polynomial), []
        for _ in range(len(polynomial)):  # repeated synthetic division: Taylor coefficients at the end
            carry, quotient = 0.0, []
            for coefficient in reversed(remainder):
                carry = carry * piece.duration + coefficient
                quotient.append(carry)
            taylor.append(quotient[-1])
            remainder = quotient[:-1][::-1]
        flipped.append(tuple(c if n % 2 == 0 else -c for n, c in enumerate(taylor)))
    x, y, z, yaw = flipped
    return Piece((x, y, z, yaw), piece.duration)


def unpack_poly4d(memory: bytes, offset: int, count: int) -> list[Piece]:
    """Pieces from trajectory memory: each 33 floats, x[8] y[8] z[8] yaw[8] duration. Raises ValueError past the end."""
    if offset + 132 * count > len(memory):
        raise ValueError("the trajectory reaches past the trajectory memory")
    pieces = []
    for n in range(count):
        v = struct.unpack_from("<33f", memory, offset + 132 * n)
        pieces.append(Piece((v[0:8], v[8:16], v[16:24], v[24:32]), v[32]))
    return pieces


def _bezier(control: list[float], duration: float) -> Polynomial:
    """The polynomial of a Bezier curve with those control points over duration [s]."""
    n = len(control) - 1
    out = [0.0] * (DEGREE + 1)
    for j in range(n + 1):
        total = sum((-1) ** (i + j) * control[i] * math.comb(j, i) for i in range(j + 1))
        out[j] = math.comb(n, j) * total / duration**j
    return tuple(out)


def unpack_compressed(memory: bytes, offset: int) -> list[Piece]:
    """Pieces of a compressed trajectory.

    Start (x, y, z in mm, yaw in 0.1 deg, int16), then for each piece a header byte with two bits of storage type per
    coordinate (constant, linear, cubic or degree 7 Bezier), a duration in ms (uint16), and the control points; a
    duration of zero ends it. Raises ValueError when the memory ends first.
    """
    scales = (0.001, 0.001, 0.001, math.radians(0.1))
    try:
        start = [value * scale for value, scale in zip(struct.unpack_from("<4h", memory, offset), scales, strict=True)]
        offset += 8
        pieces: list[Piece] = []
        while True:
            header, milliseconds = struct.unpack_from("<BH", memory, offset)
            offset += 3
            if milliseconds == 0:
                break
            polynomials = []
            for n, scale in enumerate(scales):
                count = (0, 1, 3, 7)[header >> 2 * n & 3]
                control = [start[n], *(v * scale for v in struct.unpack_from(f"<{count}h", memory, offset))]
                offset += 2 * count
                polynomials.append(_bezier(control, milliseconds / 1000.0))
                start[n] = control[-1]
            x, y, z, yaw = polynomials
            pieces.append(Piece((x, y, z, yaw), milliseconds / 1000.0))
    except struct.error:
        raise ValueError("the compressed trajectory reaches past the trajectory memory") from None
    if not pieces:
        hold = [(value, *[0.0] * DEGREE) for value in start]
        pieces.append(Piece((hold[0], hold[1], hold[2], hold[3]), 0.0))
    return pieces
