"""The flat floor: four feet under the rotors, each a spring and damper with Coulomb friction.

The spring is soft enough for a 1 ms step (see scenario.py) and its rest position is shifted so that the drone stands
at exactly the floor's height. No foot pulls, so the drone leaves when its thrust exceeds its weight.
"""

import math

from firmware_sim.kernel import kernel
from firmware_sim.plant import layout as at

GRAVITY = 9.81


@kernel
def contact(truth, p, v, R, w, force, torque):
    """Add the floor's force [N, world] and torque [N m, body]; returns the number of feet that touch.

    p, v: position m and velocity m/s (world) as arrays, of the geometric origin, which the torque is about; R body to
    world; w body rate rad/s.
    """
    if p[2] > truth[at.FLOOR] + truth[at.FEET_REACH]:
        return 0
    m4 = 0.25 * truth[at.STANDING_MASS]
    wc = truth[at.CONTACT_FREQUENCY]
    sag = GRAVITY / (wc * wc)
    touching = 0
    for leg in range(4):
        bx = truth[at.ARM] if leg < 2 else -truth[at.ARM]
        by = truth[at.ARM_Y] if leg % 2 == 0 else -truth[at.ARM_Y]
        rx, ry, rz = R[0, 0] * bx + R[0, 1] * by, R[1, 0] * bx + R[1, 1] * by, R[2, 0] * bx + R[2, 1] * by
        depth = truth[at.FLOOR] + sag - (p[2] + rz)
        if depth <= 0.0:
            continue
        # velocity of the foot: v + R (w x b), b = (bx, by, 0)
        ux, uy, uz = -w[2] * by, w[2] * bx, w[0] * by - w[1] * bx
        vx = v[0] + R[0, 0] * ux + R[0, 1] * uy + R[0, 2] * uz
        vy = v[1] + R[1, 0] * ux + R[1, 1] * uy + R[1, 2] * uz
        vz = v[2] + R[2, 0] * ux + R[2, 1] * uy + R[2, 2] * uz
        fz = m4 * (wc * wc * depth - 2.0 * truth[at.CONTACT_DAMPING] * wc * vz)
        if fz <= 0.0:
            continue
        touching += 1
        speed = math.sqrt(vx * vx + vy * vy)
        slip = m4 * truth[at.CONTACT_STICK]  # viscous below the Coulomb limit: sticks without a stiff spring
        if slip * speed > truth[at.FRICTION] * fz:
            slip = truth[at.FRICTION] * fz / speed
        fx, fy = -slip * vx, -slip * vy
        force[0] += fx
        force[1] += fy
        force[2] += fz
        tx, ty, tz = ry * fz - rz * fy, rz * fx - rx * fz, rx * fy - ry * fx
        for i in range(3):
            torque[i] += R[0, i] * tx + R[1, i] * ty + R[2, i] * tz
    return touching
