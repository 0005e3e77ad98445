"""Finding samples that were never measured: a stream resampled by straight lines across lost packets."""

import numpy as np
from numpy.typing import NDArray

RELATIVE_TOLERANCE = 1e-4  # of the change over two steps; measured values sit below 1e-5, noise far above 1e-2
ABSOLUTE_TOLERANCE = 4e-9  # decimals of the file: nine digits, rounded


def interpolated_rows(
    time: NDArray[np.float64],
    values: NDArray[np.float64],
    *,
    relative_tolerance: float = RELATIVE_TOLERANCE,
    absolute_tolerance: float = ABSOLUTE_TOLERANCE,
) -> NDArray[np.bool_]:
    """Rows inside runs of three or more samples that lie on one straight line in every component.

    One packet carries all components, so a lost packet shows in all of them at once. Constant components are no
    evidence either way (saturation, motors off): at least one component has to change along the line.

    Args:
        time: (n,) s, may be unevenly spaced.
        values: (n, c), any unit.
        relative_tolerance: deviation from the line that still counts as none, over the change across two steps.
        absolute_tolerance: the same, absolute; the rounding of the file.

    Returns: (n,) True for every row of such a run, its ends included.
    """
    n = time.size
    rows = np.zeros(n, bool)
    if n < 3:
        return rows
    span = time[2:] - time[:-2]
    share = np.where(span > 0, (time[1:-1] - time[:-2]) / np.where(span > 0, span, 1.0), np.nan)
    change = values[2:] - values[:-2]
    deviation = np.abs(values[1:-1] - values[:-2] - share[:, None] * change)
    tolerance = absolute_tolerance + relative_tolerance * np.abs(change)
    with np.errstate(invalid="ignore"):
        on_line = (deviation <= tolerance).all(axis=1)
        # A change near the rounding of the file would pass as straight whatever it did.
        moving = (np.abs(change) > 1e3 * absolute_tolerance).any(axis=1)
    centres = on_line & moving
    rows[1:-1] |= centres
    rows[:-2] |= centres
    rows[2:] |= centres
    return rows
