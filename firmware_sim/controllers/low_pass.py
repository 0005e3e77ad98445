"""The second-order Butterworth low pass that INDI uses: filter.h, init_butterworth_2_low_pass, direct form I.

Its quality is the source's 0.7071, not 1/sqrt(2).
"""

import math

from firmware_sim.kernel import kernel

QUALITY = 0.7071


@kernel
def design(memory, o, cutoff, rate):
    """Coefficients a1, a2, b0 into memory[o:o+3]; cutoff and rate in Hz. b1 = 2 b0, b2 = b0."""
    k = math.tan(math.pi * cutoff / rate)
    poly = k * k + k / QUALITY + 1.0
    memory[o] = 2.0 * (k * k - 1.0) / poly
    memory[o + 1] = (k * k - k / QUALITY + 1.0) / poly
    memory[o + 2] = k * k / poly


@kernel
def butterworth(memory, c, o, value):
    """One step: coefficients memory[c:c+3], the last two inputs and outputs in memory[o:o+4]. Returns the output."""
    a1, a2, b0 = memory[c], memory[c + 1], memory[c + 2]
    out = b0 * (value + 2.0 * memory[o] + memory[o + 1]) - a1 * memory[o + 2] - a2 * memory[o + 3]
    memory[o + 1], memory[o] = memory[o], value
    memory[o + 3], memory[o + 2] = memory[o + 2], out
    return out
