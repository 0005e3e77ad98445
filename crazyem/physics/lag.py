"""First-order rotor lag, exact for a command that is piecewise linear in time: tau dy/dt = u - y.

The lag is linear and the same for all rotors, so it acts on thrust and torque directly. What a step of the rigid body
needs is the mean of y over the step, and its derivative with respect to tau (for estimating tau).
"""

import numpy as np
from numba import njit

STEP = 1e-3  # relative change of tau for the central difference


@njit(cache=True, nogil=True)
def lagged_means(times, commands, first, last, nodes, node_first, node_last, tau, state, mean, mean_tau):
    """Means of the lagged command between nodes.

    Args:
        times: (n,) s, stamps of the commands, increasing.
        commands: (n, 4) F [N] and M [N m] commanded at those stamps; linear in between, held beyond the last.
        first, last: range of commands to use; times[first] must not be after the start time in `state`.
        nodes: (m,) s, increasing.
        node_first, node_last: fill rows node_first..node_last-1, row k being the step that ends at nodes[k].
        tau: s; 0 means no lag.
        state: (13,) lagged values for tau, tau (1 + STEP) and tau (1 - STEP), 4 each, then their time [s]; updated in
            place, so that a later call goes on from the last node.
        mean: (m, 4) receives the means.
        mean_tau: (m, 4) receives d mean / d tau [1/s].

    Returns:
        Index of the last command at or before the last node: the `first` of a later call.
    """
    i = first
    t = state[12]
    acc = np.empty(12)
    u0 = np.empty(4)
    u1 = np.empty(4)
    while i + 1 < last and times[i + 1] <= t:
        i += 1
    _interpolate(times, commands, i, last, t, u0)
    for k in range(node_first, node_last):
        begin = t
        for c in range(12):
            acc[c] = 0.0
        while t < nodes[k]:
            end = nodes[k]
            if i + 1 < last and times[i + 1] < end:
                end = times[i + 1]
            _interpolate(times, commands, i, last, end, u1)
            h = end - t
            for v in range(3):
                tv = tau * (1.0 + STEP * (v if v < 2 else -1))
                decay = np.exp(-h / tv) if tv > 0 else 0.0
                for c in range(4):
                    slope = (u1[c] - u0[c]) / h
                    y0 = state[4 * v + c]
                    if tv > 0:
                        y1 = u1[c] - slope * tv + (y0 - u0[c] + slope * tv) * decay
                    else:
                        y1 = u1[c]
                    acc[4 * v + c] += 0.5 * h * (u0[c] + u1[c]) - tv * (y1 - y0)
                    state[4 * v + c] = y1
            for c in range(4):
                u0[c] = u1[c]
            t = end
            if i + 1 < last and times[i + 1] <= t:
                i += 1
        span = nodes[k] - begin
        for c in range(4):
            if span > 0:
                mean[k, c] = acc[c] / span
                mean_tau[k, c] = (acc[4 + c] - acc[8 + c]) / (2 * STEP * tau * span) if tau > 0 else 0.0
            else:
                mean[k, c] = state[c]
                mean_tau[k, c] = 0.0
    state[12] = t
    return i


@njit(cache=True, nogil=True)
def _interpolate(times, commands, i, last, t, out):
    """Command at t, which lies between stamps i and i + 1 (held before the first and after the last)."""
    if i + 1 < last and t > times[i]:
        f = (t - times[i]) / (times[i + 1] - times[i])
        for c in range(4):
            out[c] = commands[i, c] + f * (commands[i + 1, c] - commands[i, c])
    else:
        for c in range(4):
            out[c] = commands[i, c]
