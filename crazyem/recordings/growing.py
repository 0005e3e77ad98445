"""Rows that arrive a block at a time, in one array that grows."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


class GrowingArray:
    """(n,) or (n, width) values to which rows are appended; a flight is held once, not as a list of blocks.

    Args:
        kind: numpy type of the values.
        width: of a row; None for single values.
        expected: rows, as far as known: saves moving the array while it grows.
    """

    def __init__(self, kind: Any, width: int | None = None, *, expected: int = 0) -> None:
        self._array: NDArray[Any] = np.empty(expected if width is None else (expected, width), kind)
        self.size = 0

    def more(self, count: int) -> NDArray[Any]:
        """Room for `count` rows after the last, to be filled."""
        first, self.size = self.size, self.size + count
        if self.size > len(self._array):
            # what is never filled takes up no memory
            larger = np.empty((max(self.size, 2 * first), *self._array.shape[1:]), self._array.dtype)
            larger[:first] = self._array[:first]
            self._array = larger
        return self._array[first : self.size]

    @property
    def rows(self) -> NDArray[Any]:
        """The rows so far."""
        return self._array[: self.size]

    def take(self) -> NDArray[Any]:
        """The rows, handed over and not kept; a copy where much of the array was not filled."""
        array, size = self._array, self.size
        self._array, self.size = np.empty((0, *array.shape[1:]), array.dtype), 0
        return array[:size] if len(array) - size < len(array) // 16 else array[:size].copy()
