"""Long-run variance: what the variance of a sum is when its terms are correlated in time."""

import numpy as np

from crazyem.compiled import compiled

MIN_ROWS = 32  # fewer say nothing about correlation in time
MAX_LAG = 100


@compiled
def long_run(terms):
    """Variance of the column sums of terms (n, p), Bartlett kernel (Newey and West 1987). Returns (p,).

    The weights 1 - lag/length of the kernel are those of a running sum of that length, of which this is the mean
    square: a few additions a term, however many lags.
    """
    n, p = terms.shape
    length = (min(n // 8, MAX_LAG) if n >= MIN_ROWS else 0) + 1
    out = np.zeros(p)
    running = np.zeros(p)
    for k in range(n + length - 1):
        for c in range(p):
            if k < n:
                running[c] += terms[k, c]
            if k >= length:
                running[c] -= terms[k - length, c]
            out[c] += running[c] * running[c]
    return out / length
