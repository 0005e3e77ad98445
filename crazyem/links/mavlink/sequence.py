"""What the sequence numbers of one component say: messages lost, late and repeated (8 bits, one count for all)."""

from collections import deque

_REPEAT_MEMORY = 64  # newest frames that a repetition is recognised among
_LATE_NUMBERS = 128  # numbers behind count as late, numbers ahead as a gap
_MODULUS = 256


class SequenceCounter:
    """Attributes: received, lost (at least: 256 lost in a row look like none), late, repeated."""

    def __init__(self) -> None:
        self.received = self.lost = self.late = self.repeated = 0
        self._newest: int | None = None  # continued beyond 8 bits
        self._missing: set[int] = set()
        self._seen: deque[bytes] = deque(maxlen=_REPEAT_MEMORY)

    def take(self, sequence: int, raw: bytes) -> bool:
        """Account for a frame; False: it was here before, drop it."""
        if raw in self._seen:
            self.repeated += 1
            return False
        self._seen.append(raw)
        self.received += 1
        if self._newest is None:
            self._newest = sequence
            return True
        ahead = (sequence - self._newest) % _MODULUS
        if 0 < ahead <= _LATE_NUMBERS:
            self.lost += ahead - 1
            self._missing.update(range(self._newest + 1, self._newest + ahead))
            self._newest += ahead
            self._missing = (
                {n for n in self._missing if n > self._newest - _LATE_NUMBERS} if self._missing else self._missing
            )
        elif ahead:  # 0: 256 lost, or a sender that does not count
            self.late += 1
            number = self._newest + ahead - _MODULUS
            if number in self._missing:  # else it is a repetition whose first arrival is forgotten
                self._missing.remove(number)
                self.lost -= 1
        return True
