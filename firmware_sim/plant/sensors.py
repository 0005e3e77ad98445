"""Inertial sensors as the firmware reads them: noise, counts, slow gyro bias, second-order Butterworth filters.

Gyro 80 Hz, accelerometer 30 Hz, both at 1 kHz (sensors_bmi088_bmp3xx.c, filter.c). Noise is made of standard normal
numbers by seed and firmware tick: the same seed gives the same noise on any flight.
"""

import math

import numpy as np

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at
from firmware_sim.plant.layout import NOISE_WIDTH

BLOCK_MS = 1024  # ms drawn at a time


class NoiseSource:
    """Rows of `NOISE_WIDTH` independent standard normal numbers, one row a millisecond."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._block = -1
        self.rows = np.zeros((BLOCK_MS, NOISE_WIDTH))

    def prepare(self, tick: int) -> int:
        """Make the row of `tick` [ms] available; returns its index in `rows`."""
        block, row = divmod(tick, BLOCK_MS)
        if block != self._block:
            generator = np.random.default_rng([self._seed, block])
            generator.standard_normal(out=self.rows)
            self._block = block
        return row

    def boot(self, size: int) -> np.ndarray:
        """`size` numbers for quantities that are random once per flight; independent of the rows."""
        return np.random.default_rng([self._seed, 0, 1]).standard_normal(size)


RATE = 1000.0  # Hz
GYRO_CUTOFF = 80.0
ACC_CUTOFF = 30.0


@kernel
def low_pass(memory, o, value, cutoff):
    """Second-order Butterworth low pass at 1 kHz (direct form II, bilinear transform); memory[o], memory[o+1] carry."""
    c = math.tan(math.pi * cutoff / RATE)
    norm = 1.0 + math.sqrt(2.0) * c + c * c
    b = c * c / norm
    a1 = 2.0 * (c * c - 1.0) / norm
    a2 = (1.0 - math.sqrt(2.0) * c + c * c) / norm
    d0 = value - memory[o] * a1 - memory[o + 1] * a2
    out = b * (d0 + 2.0 * memory[o] + memory[o + 1])
    memory[o + 1] = memory[o]
    memory[o] = d0
    return out


@kernel
def settle(memory, o, value, cutoff):
    """Set the filter's memories to their steady state for a constant `value`."""
    c = math.tan(math.pi * cutoff / RATE)
    b = c * c / (1.0 + math.sqrt(2.0) * c + c * c)
    memory[o] = value / (4.0 * b)
    memory[o + 1] = memory[o]


@kernel
def quantised(value, step):
    """`value` in whole steps of the sensor; unchanged if the step is 0."""
    return step * math.floor(value / step + 0.5) if step > 0.0 else value


@kernel
def sensors_step(truth, state, sensor, noise, tick):
    """Sample gyro [rad/s] and accelerometer [m/s^2] each millisecond and the battery [V] every 100 ms."""
    root = math.sqrt(RATE / 2.0)  # density per root hertz to the sd of one sample
    for i in range(3):
        sensor[at.BIAS + i] += truth[at.GYRO_WALK] / math.sqrt(RATE) * noise[at.N_WALK + i]
        rate = state[at.OMEGA + i] + sensor[at.BIAS + i] + truth[at.GYRO_NOISE] * root * noise[at.N_GYRO + i]
        rate = quantised(min(max(rate, -34.9), 34.9), truth[at.GYRO_STEP])  # full scale 2000 deg/s
        sensor[at.GYRO + i] = low_pass(sensor, at.GYRO_FILTER + 2 * i, rate, GYRO_CUTOFF)
        acc = state[at.ACC + i] + truth[at.ACC_NOISE] * root * noise[at.N_ACC + i]
        acc = quantised(min(max(acc, -235.0), 235.0), truth[at.ACC_STEP])  # full scale 24 g
        sensor[at.ACCEL + i] = low_pass(sensor, at.ACCEL_FILTER + 2 * i, acc, ACC_CUTOFF)
    if tick % 100 == 0:
        sensor[at.VBAT] = state[at.VOLTS] + truth[at.VBAT_NOISE] * noise[at.N_VBAT]
