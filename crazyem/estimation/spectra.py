"""Long-run variance: what the variance of a sum is when its terms are correlated in time."""

import numpy as np

from crazyem.compiled import compiled

MIN_ROWS = 32  # fewer say nothing about correlation in time
MAX_LAG = 100


@compiled
def long_run(terms):
    """Variance of the column sums of terms (n, p), Bartlett kernel (Newey and West 1987). Returns (p,)."""
    n, p = terms.shape
    out = np.zeros(p)
    column = np.empty(n)
    lags = min(n // 8, MAX_LAG) if n >= MIN_ROWS else 0
    for c in range(p):
        for k in range(n):
            column[k] = terms[k, c]
        total = 0.0
        for k in range(n):
            total += column[k] * column[k]
        for lag in range(1, lags + 1):
            acc = 0.0
            for k in range(lag, n):
                acc += column[k] * column[k - lag]
            total += 2.0 * (1.0 - lag / (lags + 1.0)) * acc
        out[c] = total
    return out
