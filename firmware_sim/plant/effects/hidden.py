"""Effects outside the catalogue on the body: vibration, cable_spring (sticky_rotor is in command.py, magnetic_yaw in
sensing.py).

vibration: torque A (cos p, sin p, 0) in body axes that turns with one rotor, dp/dt = +- ratio * rotor speed; its exact
average over each step. cable_spring: force stiffness (r - length) towards a fixed point of the world at distance r,
from the geometric origin, none when slack (r < length); undamped.
"""

import math

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at


@kernel
def vibrate(truth, state, dt, torque):
    """Add the vibration's mean torque [N m, body] over dt and advance its phase."""
    i = int(truth[at.VIBRATION_ROTOR]) - 1
    speed = truth[at.VIBRATION_RATIO] * math.sqrt(max(state[at.ROTOR + i], 0.0) / truth[at.ROTOR_CONSTANT])
    half = 0.5 * speed * dt if i % 2 == 0 else -0.5 * speed * dt  # M1 and M3 counter-clockwise from above
    if half != 0.0:
        mean = truth[at.VIBRATION_TORQUE] * math.sin(half) / half
        torque[0] += mean * math.cos(state[at.PHASE] + half)
        torque[1] += mean * math.sin(state[at.PHASE] + half)
        state[at.PHASE] = (state[at.PHASE] + 2.0 * half) % (2.0 * math.pi)


@kernel
def pull_cable(truth, p, force):
    """Add the spring's force [N, world] on the geometric origin at p [m, world]."""
    k = at.CABLE_POINT
    dx, dy, dz = truth[k] - p[0], truth[k + 1] - p[1], truth[k + 2] - p[2]
    r = math.sqrt(dx * dx + dy * dy + dz * dz)
    if r > truth[at.CABLE_LENGTH] and r > 0.0:
        pull = truth[at.CABLE_STIFFNESS] * (r - truth[at.CABLE_LENGTH]) / r
        force[0] += pull * dx
        force[1] += pull * dy
        force[2] += pull * dz
