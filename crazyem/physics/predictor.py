"""What the next commands of a control loop will be, by the latest ones and by the body rates that it answers to.

Linear and fitted to the same flight (least squares), because an innovation must be orthogonal to what predicts it. Body
rates measured when a step begins are known by then, and the loop answers to them within a tick: by commands alone the
answer is missing from the input of the step, and what is missing goes with the state: it reads as damping. On hover
logged at 100 Hz the rates leave a third of the error that commands alone leave where the next command comes 1 ms after
the rates, two thirds where it comes 7 ms after."""

import numpy as np
from numpy.typing import NDArray

ORDER = 3  # latest commands
RATES = 6  # body rates where a step begins, and at the node before
OWN = ORDER + 1  # numbers of the prediction by commands alone; those of the one by rates, too, follow
WIDTH = OWN + OWN + RATES
NEAR = 0.05  # s: commands or nodes farther apart than this are not neighbours
_RIDGE = 1e-6
_ENOUGH = 10  # rows for each weight


def hold_predictor() -> NDArray:
    """Prediction that the latest command stays. (4, WIDTH)."""
    weights = np.zeros((4, WIDTH))
    weights[:, [0, OWN]] = 1.0
    return weights


def fit_predictor(
    commands: NDArray, times: NDArray | None = None, nodes: NDArray | None = None, rates: NDArray | None = None
) -> NDArray:
    """Least-squares weights with which the latest commands, and body rates, predict the next command.

    Args:
        commands: (n, 4), evenly spaced.
        times: (n,) s, their stamps.
        nodes: (m,) s, where steps begin, increasing.
        rates: (m, 3) rad/s measured there, body axes; NaN where not measured.

    Returns:
        (4, WIDTH): weights of the latest command, the one before ..., and a constant, for a prediction by commands
        alone; then the same and weights of the rates at a node (3) and the node before (3), for the first command after
        the node. With too little to fit, or commands that do not vary, the latest is held and rates have no weight.
    """
    weights = hold_predictor()
    past = np.arange(ORDER, len(commands))
    weights[:, :OWN] = _weights(commands, past, np.zeros((past.size, 0)))
    weights[:, OWN : 2 * OWN] = weights[:, :OWN]
    if times is not None and nodes is not None and rates is not None and len(nodes) >= 2:
        begins = 1 + np.flatnonzero(np.diff(nodes) < NEAR)
        answers = np.searchsorted(times, nodes[begins] + 1e-6, "right")
        known = np.hstack([rates[begins], rates[begins - 1]])
        fits = np.isfinite(known).all(1) & (answers >= ORDER) & (answers < len(times))
        fits[fits] &= times[answers[fits]] - times[answers[fits] - 1] < NEAR
        if fits.sum() >= _ENOUGH * (OWN + RATES):
            weights[:, OWN:] = _weights(commands, answers[fits], known[fits])
    return weights


def _weights(commands: NDArray, rows: NDArray, known: NDArray) -> NDArray:
    """Weights (4, OWN + k) of the ORDER commands before each of `rows`, a constant, and what else is `known` (., k)."""
    weights = np.zeros((4, OWN + known.shape[1]))
    weights[:, 0] = 1.0
    if len(rows) < _ENOUGH * OWN:
        return weights
    middle, unit = known.mean(0), known.std(0)
    beside = (known - middle) / np.where(unit > 0.0, unit, 1.0)
    for c in range(4):
        past = np.stack([commands[rows - 1 - j, c] for j in range(ORDER)], 1)
        centre, spread = past.mean(), past.std()
        if not spread > 0.0:
            continue
        a = np.hstack([(past - centre) / spread, beside])
        target = (commands[rows, c] - commands[rows - 1, c]) / spread
        step = np.linalg.solve(a.T @ a + _RIDGE * len(rows) * np.eye(a.shape[1]), a.T @ target)
        by_rate = spread * step[ORDER:] / np.where(unit > 0.0, unit, 1.0)
        weights[c, :ORDER] += step[:ORDER]
        weights[c, ORDER] = -step[:ORDER].sum() * centre - by_rate @ middle
        weights[c, OWN:] = by_rate
    return weights
