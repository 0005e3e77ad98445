"""First-order rotor lag, exact for a command that is piecewise linear in time: tau dy/dt = u - y.

The lag is linear and the same for all rotors, so it acts on thrust and torque directly. A step of the rigid body needs
the mean of y over the step, and its derivatives with respect to tau and to a delay of the command (to estimate both).
A delay of one millisecond that is not modelled changes the inertia by several per cent.

A logged command is known only at its stamps. In closed loop the next command already responds to the disturbance of the
present step. Interpolation towards it would bring the noise of the step into the input: on hover data logged at 100 Hz
this gives an error of 5 ms of delay and 16 % of inertia. So the mean of a step uses only commands stamped before the
step began, and a prediction from these (CAUSAL). The prediction is linear and fitted to the same commands, because an
innovation must be orthogonal to its predictors. The state of the lag then follows the actual commands. Stamps alone
decide which commands are known, not the delay: known data must not change with a fitted parameter. A command stamped
even 1 ms later already responds (`docs: estimator.md`)."""

import numpy as np

from crazyem.compiled import compiled

TAU_STEP = 1e-3  # relative change of tau for the central difference

# Modes: the command between two stamps.
LINEAR = 0  # a straight line: measured rotor speeds
HOLD = 1  # the earlier value: a controller that acts once per stamp, without lag
CAUSAL = 2  # a straight line, but the mean of a step uses no stamp after its start: commands with rotor lag

PREDICTION_ORDER = 3  # of the linear prediction
_MOST_AHEAD = 64  # most commands known or predicted inside one step


@compiled
def _segment(u0, u1, h, tau, state, acc):
    """Advance `state` over a linear stretch of the command, u0 to u1 (4,), of h s; add the integral to `acc`."""
    for v in range(len(acc) // 4):
        tv = tau * (1.0 + TAU_STEP * (v if v < 2 else -1))
        decay = np.exp(-h / tv) if tv > 0 else 0.0
        for c in range(4):
            y0 = state[4 * v + c]
            slope = (u1[c] - u0[c]) / h
            y1 = u1[c] - slope * tv + (y0 - u0[c] + slope * tv) * decay
            acc[4 * v + c] += 0.5 * h * (u0[c] + u1[c]) - tv * (y1 - y0)
            state[4 * v + c] = y1


@compiled
def _at(times, commands, i, last, t, mode, out):
    """Command at t; stamp i is the last one at or before t (or the very first); `last` commands are known."""
    if mode != HOLD and i + 1 < last and t > times[i]:
        f = (t - times[i]) / (times[i + 1] - times[i])
        for c in range(4):
            out[c] = commands[i, c] + f * (commands[i + 1, c] - commands[i, c])
    else:
        for c in range(4):
            out[c] = commands[i, c]


@compiled
def _predict(times, commands, i, known, end, predictor, path_times, path):
    """Write commands i..known-1 (and a few before) and their prediction up to `end` into path; returns their number."""
    begin = max(0, min(i, known - PREDICTION_ORDER), known - _MOST_AHEAD // 2)
    size = known - begin
    for k in range(size):
        path_times[k] = times[begin + k]
        path[k] = commands[begin + k]
    period = path_times[size - 1] - path_times[size - 2] if size >= 2 else 0.0
    if size < PREDICTION_ORDER or not 0.0 < period < 0.05:
        return size  # no prediction: the last command is held
    while path_times[size - 1] < end and size < _MOST_AHEAD:
        for c in range(4):
            value = predictor[c, PREDICTION_ORDER]
            for j in range(PREDICTION_ORDER):
                value += predictor[c, j] * path[size - 1 - j, c]
            path[size, c] = value
        path_times[size] = path_times[size - 1] + period
        size += 1
    return size


def hold_predictor() -> np.ndarray:
    """Weights (4, PREDICTION_ORDER + 1) of the prediction that the latest command stays."""
    weights = np.zeros((4, PREDICTION_ORDER + 1))
    weights[:, 0] = 1.0
    return weights


def fit_predictor(commands: np.ndarray) -> np.ndarray:
    """Least-squares weights for predicting the next command from the latest commands.

    Args:
        commands: (n, 4), evenly spaced.

    Returns:
        (4, PREDICTION_ORDER + 1): weights of the latest command, the one before ..., and a constant. With too few
        commands, or constant ones, the prediction holds the latest command.
    """
    weights = hold_predictor()
    n = len(commands) - PREDICTION_ORDER
    if n < 10 * (PREDICTION_ORDER + 1):
        return weights
    for c in range(4):
        past = np.stack(
            [commands[PREDICTION_ORDER - 1 - j : PREDICTION_ORDER - 1 - j + n, c] for j in range(PREDICTION_ORDER)], 1
        )
        centre, spread = past.mean(), past.std()
        if not spread > 0.0:
            continue
        a = (past - centre) / spread
        target = (commands[PREDICTION_ORDER:, c] - commands[PREDICTION_ORDER - 1 : -1, c]) / spread
        step = np.linalg.solve(a.T @ a + 1e-6 * n * np.eye(PREDICTION_ORDER), a.T @ target)
        weights[c, :PREDICTION_ORDER] += step
        weights[c, PREDICTION_ORDER] = -step.sum() * centre
    return weights


@compiled
def _run(times, commands, i, last, begin, end, mode, tau, state, acc):
    """Carry the lag from begin to end along the first `last` commands; returns the stamp index at the end."""
    u0 = np.empty(4)
    u1 = np.empty(4)
    t = begin
    while t < end:
        stop = end
        if i + 1 < last and times[i + 1] < end:
            stop = max(times[i + 1], t)
        if stop > t:
            _at(times, commands, i, last, t, mode, u0)
            _at(times, commands, i, last, stop, mode, u1)
            if mode == HOLD:
                for c in range(4):
                    u1[c] = u0[c]
            _segment(u0, u1, stop - t, tau, state, acc)
        t = stop
        if i + 1 < last and times[i + 1] <= t:
            i += 1
    return i


@compiled
def _back(t0, t1, u0, u1, t, tau, state):
    """Carry the state of the lag from t back to t0 on the line from (t0, u0) to (t1, u1)."""
    h = t - t0
    for v in range(len(state) // 4):
        tv = tau * (1.0 + TAU_STEP * (v if v < 2 else -1))
        if tv <= 0.0:
            continue
        grow = np.exp(h / tv)
        for c in range(4):
            slope = (u1[c] - u0[c]) / (t1 - t0)
            end = u0[c] + slope * h
            state[4 * v + c] = u0[c] - slope * tv + (state[4 * v + c] - end + slope * tv) * grow


@compiled
def _run_predicted(times, commands, i, known, last, begin, end, predictor, tau, path_times, path, guess, start, acc,
                   junk):  # fmt: skip
    """Carry `guess` from begin to end along commands 0..known-1 and their prediction; add the integrals to acc.

    start (4,) receives the lagged command at begin. path_times, path and junk are scratch.
    """
    size = _predict(times, commands, i, known, end, predictor, path_times, path)
    if known <= i + 1 and i + 1 < last and begin > times[known - 1]:
        # the state at `begin` depends on a command that is not known yet: go back to the last known stamp, then forward
        # to `begin` along known and predicted commands
        here = begin
        for j in range(i, known - 2, -1):
            _back(times[j], times[j + 1], commands[j], commands[j + 1], here, tau, guess)
            here = times[j]
        _run(path_times, path, 0, size, here, begin, LINEAR, tau, guess, junk)
        for c in range(4):
            start[c] = guess[c]
    _run(path_times, path, 0, size, begin, end, LINEAR, tau, guess, acc)


@compiled
def lagged_means(
    times, commands, first, last, predictor, nodes, node_first, node_last, mode, tau, delay, state, mean, mean_tau,
    mean_delay,
):  # fmt: skip
    """Compute the means of the lagged command over the steps between nodes.

    Args:
        times: (n,) s, stamps of the commands, increasing.
        commands: (n, 4) F [N] and M [N m] commanded at those stamps.
        first, last: range of commands to use; times[first] must not be after the start time in `state`.
        predictor: (4, PREDICTION_ORDER + 1) weights of the prediction; see `fit_predictor`.
        nodes: (m,) s, increasing.
        node_first, node_last: fill rows node_first..node_last-1, row k being the step that ends at nodes[k].
        mode: LINEAR, HOLD or CAUSAL.
        tau: s; 0 means no lag.
        delay: s from the stamp of a command to its effect.
        state: (13,) lagged values for tau and tau (1 +- TAU_STEP), 4 each, then their time [s] on the clock of the
            commands. Updated in place, so that a later call continues from the last node. (5,): for tau alone.
        mean: (m, 4) receives the means.
        mean_tau: (m, 4) receives d mean / d tau [1/s]; not used with a state (5,).
        mean_delay: (m, 4) receives d mean / d delay [1/s].

    Returns:
        Index of the last command at or before the last node: the `first` of a later call.
    """
    i = first
    values = len(state) - 1
    acc = np.empty(values)
    junk = np.empty(values)
    guess = np.empty(values + 1)
    path_times = np.empty(_MOST_AHEAD)
    path = np.empty((_MOST_AHEAD, 4))
    start = np.empty(4)
    begin = state[values]
    while i + 1 < last and times[i + 1] <= begin:
        i += 1
    for k in range(node_first, node_last):
        end = nodes[k] - delay
        span = end - begin
        if span <= 0.0:
            for c in range(4):
                mean[k, c] = state[c]
                mean_delay[k, c] = 0.0
                if values > 4:
                    mean_tau[k, c] = 0.0
            continue
        for c in range(4):
            start[c] = state[c]
        acc[:] = 0.0
        if mode == CAUSAL:
            known = i + 1
            # the node itself, since begin + delay has a rounding error; with a tolerance of 1 microsecond
            now = (nodes[k - 1] if k > node_first else begin + delay) + 1e-6
            while known < last and times[known] <= now:
                known += 1
            while known > 1 and times[known - 1] > now:
                known -= 1
            guess[:] = state
            _run_predicted(times, commands, i, known, last, begin, end, predictor, tau, path_times, path, guess, start,
                           acc, junk)  # fmt: skip
            for c in range(4):
                mean_delay[k, c] = -(guess[c] - start[c]) / span
            i = _run(times, commands, i, last, begin, end, LINEAR, tau, state, junk)
        else:
            i = _run(times, commands, i, last, begin, end, mode, tau, state, acc)
            for c in range(4):
                mean_delay[k, c] = -(state[c] - start[c]) / span
        for c in range(4):
            mean[k, c] = acc[c] / span
            if values > 4:
                mean_tau[k, c] = (acc[4 + c] - acc[8 + c]) / (2 * TAU_STEP * tau * span) if tau > 0 else 0.0
        begin = end
        state[values] = end
    return i
