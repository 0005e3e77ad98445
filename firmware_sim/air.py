"""The air between drone and host: log packets that get lost, singly or in bursts, by a seeded two-state chain."""

import random


class Air:
    """Says of each log packet whether it is lost (Gilbert's model: a good and a bad state, all lost in the bad one).

    Args:
        loss: share of packets lost in the long run, 0 <= loss < 1.
        burst: mean number of packets lost in a row, at least 1; 1 with a small loss is close to independent losses.
        seed: of the chain: the same seed loses the same packets of a sequence.

    Source: E. N. Gilbert, "Capacity of a burst-noise channel", Bell System Technical Journal 39 (1960).
    """

    def __init__(self, loss: float, burst: float, seed: int) -> None:
        # Leaving the bad state has probability 1/burst; entering it is set by the share of time spent there.
        self._leave = 1.0 / burst
        self._enter = min(1.0, self._leave * loss / (1.0 - loss))
        if self._enter == 1.0:  # bursts so short that even entering at once loses too little
            self._leave = (1.0 - loss) / loss
        self._random = random.Random(seed)
        self._bad = False
        self._perfect = loss == 0.0

    def loses(self) -> bool:
        """True if the next packet is lost."""
        if self._perfect:
            return False
        self._bad = self._random.random() >= self._leave if self._bad else self._random.random() < self._enter
        return self._bad
