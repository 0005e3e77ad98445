"""One lithium-polymer cell: open-circuit voltage from the charge left, sag under the load of rotors and electronics.

A rotor's shaft power grows as thrust^1.5 (momentum theory); the coefficient lumps the motor's efficiency.
"""

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at


@kernel
def open_circuit(soc):
    """Open-circuit voltage in V for a state of charge 0..1: 3.0 V empty, 3.7 V at 20 %, 4.2 V full."""
    soc = min(max(soc, 0.0), 1.0)
    if soc < 0.2:
        return 3.0 + 0.7 * (soc / 0.2) ** 0.5
    return 3.7 + 0.5 * (soc - 0.2) / 0.8


@kernel
def battery_step(truth, state, dt):
    """Discharge by dt and set the terminal voltage for the present load. The voltage never drops below 0.5 V."""
    power = truth[at.ELECTRONICS_POWER]
    for i in range(4):
        power += truth[at.POWER_COEFFICIENT] * max(state[at.ROTOR + i], 0.0) ** 1.5
    current = power / max(state[at.VOLTS], 2.0)
    state[at.CHARGE] = max(state[at.CHARGE] - current * dt, 0.0)
    state[at.VOLTS] = max(open_circuit(state[at.CHARGE] / truth[at.CAPACITY]) - truth[at.RESISTANCE] * current, 0.5)
