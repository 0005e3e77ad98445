"""Physical effects beyond the plain rigid body, one file an effect.

None is built yet. An effect will be a kernel `add(state, truth, noise, force, torque)` that adds to the external force
[N, world] and torque [N m, body]; `external` calls each of them by name, because compiled code takes no functions.
"""

from firmware_sim.kernel import kernel


@kernel
def external(state, truth, noise, force, torque):
    """Set force [N, world] and torque [N m, body] to the sum of all effects."""
    for i in range(3):
        force[i] = 0.0
        torque[i] = 0.0
