"""rotor_inertia: the rotors' own angular momentum, H = I (W1 - W2 + W3 - W4) along body z, acts back on the body.

    J dw/dt = ... - w x (H e3) - dH/dt e3,   W_i = sqrt(f_i / rotor_constant)

I: of one rotor and propeller about its axis, kg m^2 (the body's J holds the rotors as if they stood still). f_i: the
lagged thrust, without what rotor_fault and the like do to it. M1 and M3 turn counter-clockwise seen from above. The
spin-up reaction is the exact change of H over each step. Source: Euler's equation of a gyrostat.
"""

import math

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at


@kernel
def angular_momentum(truth, f, o):
    """H [N m s] along body z of rotors with lagged thrusts f[o:o+4]."""
    total = 0.0
    for i in range(4):
        speed = math.sqrt(max(f[o + i], 0.0) / truth[at.ROTOR_CONSTANT])
        total += speed if i % 2 == 0 else -speed
    return truth[at.ROTOR_INERTIA] * total
