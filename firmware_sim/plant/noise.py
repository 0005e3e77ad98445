"""Standard normal numbers indexed by seed and firmware tick: the same seed gives the same noise, whatever is flown."""

import numpy as np

from firmware_sim.plant.layout import NOISE_WIDTH

BLOCK_MS = 1024  # ms drawn at a time


class NoiseSource:
    """Rows of `NOISE_WIDTH` independent standard normal numbers, one row a millisecond."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._block = -1
        self.rows = np.zeros((BLOCK_MS, NOISE_WIDTH))

    def prepare(self, tick: int) -> int:
        """Make the row of `tick` [ms] available; returns its index in `rows`."""
        block, row = divmod(tick, BLOCK_MS)
        if block != self._block:
            generator = np.random.default_rng([self._seed, block])
            generator.standard_normal(out=self.rows)
            self._block = block
        return row

    def boot(self, size: int) -> np.ndarray:
        """`size` numbers for what is random once per flight; independent of the rows."""
        return np.random.default_rng([self._seed, 0, 1]).standard_normal(size)
