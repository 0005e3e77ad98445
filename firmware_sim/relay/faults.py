"""Faults of a link and the engine that applies them: seeded, without clock and sockets."""

import heapq
import random
from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field

from firmware_sim.relay.kinds import RelayError, check_kinds, kind_of, matches
from firmware_sim.wire import Air

UP, DOWN = "up", "down"  # from the host to the drone, from the drone to the host
WHATS = ("drop", "duplicate", "reorder", "delay", "corrupt", "silence", "die")
FATES = ("received", "forwarded", "dropped", "silenced", "duplicated", "reordered", "delayed", "corrupted", "overflow")
HOLD_SECONDS = 0.1  # s after which a packet held back for reordering is sent anyway
MOST_PENDING = 20_000  # packets on their way; more are lost, as in any queue


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        what: drop, duplicate, reorder, delay, corrupt, silence (drops all), or die (closes the relay's port: the host
            gets "connection refused").
        rate: share of the packets concerned, 0..1.
        direction: "up", "down" or "both".
        kinds: which packets (`kinds.py`); empty means all.
        start, end: s since the host's first packet.
        skip: number of concerned packets that pass first.
        count: largest number of harmed packets, 0 = no limit.
        burst: of drop: mean number lost in a row (Gilbert's model).
        ms, jitter_ms: of delay: constant part, and the largest uniform random part. Order is kept.
        distance: of reorder: number of later packets that overtake.
        bits: of corrupt: number of flipped bits, anywhere in the packet.
        copies: of duplicate: number of additional packets.
    """

    what: str
    rate: float = 1.0
    direction: str = "both"
    kinds: frozenset[str] = frozenset()
    start: float = 0.0
    end: float = float("inf")
    skip: int = 0
    count: int = 0
    burst: float = 1.0
    ms: float = 0.0
    jitter_ms: float = 0.0
    distance: int = 1
    bits: int = 1
    copies: int = 1

    def __post_init__(self) -> None:
        """Raises: RelayError naming the invalid field."""
        if self.what not in WHATS:
            raise RelayError(f'there is no fault "{self.what}"; choose {", ".join(WHATS)}')
        if self.direction not in (UP, DOWN, "both"):
            raise RelayError(f'{self.what}: direction "{self.direction}" is none of up, down, both')
        check_kinds(self.kinds)
        for name, low, high in (
            ("rate", 0.0, 1.0), ("burst", 1.0, 1e4), ("ms", 0.0, 1e5), ("jitter_ms", 0.0, 1e5), ("distance", 1, 100),
            ("bits", 1, 248), ("copies", 1, 100), ("skip", 0, 10**12), ("count", 0, 10**12), ("start", 0.0, 1e9),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                raise RelayError(f"{self.what}: {name} = {getattr(self, name)} is not between {low:g} and {high:g}")
        if not self.end > self.start:
            raise RelayError(f"{self.what}: it ends at {self.end:g} s, before it starts")
        if self.burst > 1.0 and self.what != "drop":
            raise RelayError(f"{self.what}: only drop comes in bursts")

    def concerns(self, direction: str, kind: str, elapsed: float) -> bool:
        """Whether this fault may harm a packet of this kind and direction, `elapsed` s after the first packet."""
        return (
            self.start <= elapsed < self.end
            and self.direction in (direction, "both")
            and self.what != "die"
            and matches(kind, self.kinds)
        )


class _Rule:
    """A fault with its own random numbers, so that it does not depend on other faults."""

    def __init__(self, fault: Fault, seed: int, index: int) -> None:
        self.fault = fault
        self.random = random.Random(f"{seed}/{index}")
        self.harmed = 0
        self.seen = 0
        self.newest: dict[Hashable, float] = {}  # release of the last delayed packet of each route: delays keep order
        losing = fault.what == "drop" and fault.burst > 1.0 and 0.0 < fault.rate < 1.0
        self._air = Air(fault.rate, fault.burst, self.random.randrange(1 << 30)) if losing else None

    def strikes(self) -> bool:
        """Whether the fault harms the next concerned packet."""
        self.seen += 1
        chosen = self._air.loses() if self._air else self.random.random() < self.fault.rate
        if not chosen or self.seen <= self.fault.skip or (self.fault.count and self.harmed >= self.fault.count):
            return False
        self.harmed += 1
        return True


@dataclass
class _Held:
    """A packet that waits for later ones to overtake it."""

    route: Hashable
    direction: str
    datagram: bytes
    left: int
    until: float


@dataclass
class Counts:
    """Counts of packets: direction -> fate -> number, and direction -> kind -> number harmed."""

    fates: dict[str, Counter[str]] = field(default_factory=lambda: {UP: Counter(), DOWN: Counter()})
    harmed: dict[str, Counter[str]] = field(default_factory=lambda: {UP: Counter(), DOWN: Counter()})


class Engine:
    """Applies faults to packets; `due` gives the packets to send.

    A route is a host's connection, named by the caller; packets stay on their route.
    """

    def __init__(self, faults: Sequence[Fault] = (), seed: int = 0) -> None:
        self.seed = seed
        self.counts = Counts()
        self.began: float | None = None
        self._queue: list[tuple[float, int, Hashable, str, bytes]] = []
        self._held: list[_Held] = []
        self._number = 0
        self.replace(faults)

    def replace(self, faults: Sequence[Fault]) -> None:
        """Set other faults, each from its start; packets under way stay."""
        self._rules = [_Rule(fault, self.seed, i) for i, fault in enumerate(faults)]

    @property
    def strikes(self) -> list[tuple[Fault, int]]:
        """Every fault and the number of packets it has harmed."""
        return [(rule.fault, rule.harmed) for rule in self._rules]

    def dead(self, now: float) -> bool:
        """Whether a fault wants the port closed now; never before the first packet, from which faults count."""
        if self.began is None:
            return False
        t = now - self.began
        return any(r.fault.what == "die" and r.fault.start <= t < r.fault.end for r in self._rules)

    def take(self, now: float, route: Hashable, direction: str, datagram: bytes) -> None:
        """Take a packet that arrived at `now` [s] and decide its fate."""
        if self.began is None:
            self.began = now
        kind, fates = kind_of(datagram), self.counts.fates[direction]
        fates["received"] += 1
        release, copies, held = now, 1, 0
        for rule in self._rules:
            fault = rule.fault
            if not fault.concerns(direction, kind, now - self.began) or not rule.strikes():
                continue
            self.counts.harmed[direction][kind] += 1
            if fault.what in ("drop", "silence"):
                fates["dropped" if fault.what == "drop" else "silenced"] += 1
                return
            if fault.what == "duplicate":
                copies += fault.copies
                fates["duplicated"] += fault.copies
            elif fault.what == "corrupt":
                datagram = _flip(datagram, fault.bits, rule.random)
                fates["corrupted"] += 1
            elif fault.what == "reorder":
                held = max(held, fault.distance)
                fates["reordered"] += 1
            else:
                release += (fault.ms + rule.random.random() * fault.jitter_ms) / 1000.0
                release = rule.newest[route, direction] = max(release, rule.newest.get((route, direction), release))
                fates["delayed"] += 1
        if held:
            self._held.append(_Held(route, direction, datagram, held, release + HOLD_SECONDS))
            copies -= 1  # the others are not held back
        for _ in range(copies):
            self._push(release, route, direction, datagram)

    def forget(self, route: Hashable) -> None:
        """Remove a route; the caller drops its packets under way."""
        for rule in self._rules:
            for direction in (UP, DOWN):
                rule.newest.pop((route, direction), None)

    def _push(self, release: float, route: Hashable, direction: str, datagram: bytes) -> None:
        if len(self._queue) >= MOST_PENDING:
            self.counts.fates[direction]["overflow"] += 1
            return
        self._number += 1
        heapq.heappush(self._queue, (release, self._number, route, direction, datagram))

    def due(self, now: float) -> list[tuple[Hashable, str, bytes]]:
        """Packets to send now, in order: (route, direction, datagram)."""
        out: list[tuple[Hashable, str, bytes]] = []
        while self._queue and self._queue[0][0] <= now:
            _, _, route, direction, datagram = heapq.heappop(self._queue)
            out.append((route, direction, datagram))
            out.extend(self._overtaken(route, direction))
        late = [h for h in self._held if h.until <= now]
        self._held = [h for h in self._held if h.until > now]
        out.extend((h.route, h.direction, h.datagram) for h in late)
        for _, direction, _ in out:
            self.counts.fates[direction]["forwarded"] += 1
        return out

    def _overtaken(self, route: Hashable, direction: str) -> list[tuple[Hashable, str, bytes]]:
        """Held packets to release now that one more packet of this route has gone out."""
        for h in self._held:
            if h.route == route and h.direction == direction:
                h.left -= 1
        free = [h for h in self._held if h.left <= 0]
        self._held = [h for h in self._held if h.left > 0]
        return [(h.route, h.direction, h.datagram) for h in free]

    def next_time(self) -> float | None:
        """When [s] the next packet is due, or a port opens or closes; None if nothing is waiting."""
        times = [self._queue[0][0]] if self._queue else []
        times += [h.until for h in self._held]
        return min(times, default=None)


def _flip(datagram: bytes, bits: int, numbers: random.Random) -> bytes:
    """The datagram with that many different bits flipped, or all of them if it has fewer."""
    data = bytearray(datagram)
    for position in numbers.sample(range(8 * len(data)), min(bits, 8 * len(data))):
        data[position // 8] ^= 1 << position % 8
    return bytes(data)
