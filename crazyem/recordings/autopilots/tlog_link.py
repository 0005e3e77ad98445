"""Messages that a radio link lost, by the sequence numbers of MAVLink: a rate that changes is no loss."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyem.recordings.autopilots.tlog_frames import Frameset
from crazyem.recordings.finding import Finding, Grade

# a message this many places behind is one that came late or twice; more is the next round of the numbers
_LATE_PLACES = 16


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """What the sequence numbers of one component say.

    Attributes:
        received: different messages in the log.
        lost: messages that are missing, at least: numbers have 8 bits.
        before, after: (k,) us of arrival on either side of each loss.
    """

    received: int
    lost: int
    before: NDArray[np.int64]
    after: NDArray[np.int64]

    def findings(self, time: Callable[[NDArray[np.int64]], NDArray[np.float64]]) -> list[Finding]:
        """One finding, with where messages are missing; none if nothing is.

        Args:
            time: from arrivals [us] to times on the axis of the recording [s].
        """
        if not self.lost:
            return []
        share = self.lost / (self.lost + self.received)
        places = zip(time(self.before).tolist(), time(self.after).tolist(), strict=True)
        return [
            Finding(
                "gaps",
                Grade.HARMLESS if share < 0.02 else Grade.DEGRADES,
                f"By their sequence numbers at least {self.lost} messages of the vehicle never reached the log "
                f"({100.0 * share:.1f} %).",
                intervals=tuple(places),
                evidence={"lost": float(self.lost), "received": float(self.received), "share": share},
            )
        ]


def link(found: Frameset, system: int, component: int, starts: NDArray[np.int64]) -> Link:
    """The messages of a component; those that came twice or late are neither lost nor counted again.

    Args:
        starts: places (k,) in the log at which the numbers begin anew.
    """
    chosen = [f for (s, c, _), f in found.frames.items() if (s, c) == (system, component)]
    place = np.concatenate([np.array(f.places, np.int64) for f in chosen])
    order = np.argsort(place)
    stamp = np.concatenate([np.array(f.stamps, np.int64) for f in chosen])[order]
    sequence = np.concatenate([np.array(f.sequence, np.int64) for f in chosen])[order]
    cuts = np.searchsorted(place[order], starts)
    received = lost = 0
    before, after = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for numbers, stamps in zip(np.split(sequence, cuts), np.split(stamp, cuts), strict=True):
        if not numbers.size:
            continue
        number = np.concatenate([[0], np.cumsum((np.diff(numbers) + _LATE_PLACES) % 256 - _LATE_PLACES)])
        sent, first = np.unique(number, return_index=True)
        missing = np.diff(sent) - 1
        rows = np.flatnonzero(missing)
        received, lost = received + sent.size, lost + int(missing.sum())
        before.append(stamps[first[rows]])
        after.append(stamps[first[rows + 1]])
    return Link(received, lost, np.concatenate(before), np.concatenate(after))
