"""The log blocks of one drone: creation, reception, counts, delays, and restart after an outage.

Every reply to a creation, start or deletion is checked: cflib ignores those for appended variables. Most of our blocks
have ten variables or more, which need two packets. If the second packet is lost, the block delivers packets that are
too short. If it is repeated, the block has its variables twice.
"""

import contextlib
import math
import queue
import statistics
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from crazyem.errors import LinkError, UsageError
from crazyem.links.base import LinkLost, LinkStatistics
from crazyem.links.clock import ClockFit, ClockRelation, LossCounter, StampUnwrapper
from crazyem.links.packing import PERIOD_UNIT_MS, pack, period_of
from crazyem.links.requests import RequestClient, types_of
from crazyem.signals.sample import Block, Packet

_PORT, _CONTROL = 5, 1
_DELETE, _START, _CREATE, _APPEND, _START_MS = 2, 3, 6, 7, 8
ENOENT, _ENOEXEC, _EEXIST = 2, 8, 17
_REASONS = {
    ENOENT: "a variable does not exist",
    7: "too many bytes in it",
    _ENOEXEC: "the command is unknown",
    12: "no memory left for blocks or variables",
    _EEXIST: "it exists already",
}
_ITEMS_A_PACKET = 9  # of 3 bytes each, in 28 bytes
REPLY_WITHIN, REPEAT_AFTER = 0.5, 0.15  # s
INSTALL_ATTEMPTS = 5

Items = Sequence[tuple[int, int]]  # type byte, index in the table


class LogControl:
    """The log port's commands for one Crazyflie."""

    def __init__(self, requests: RequestClient, uri: str) -> None:
        self._requests, self._uri = requests, uri

    def install(self, identifier: int, items: Items) -> None:
        """Create the block with exactly these variables; replaces a block with the same number.

        Raises: LinkError: no answer, or refused.
        """
        for attempt in range(INSTALL_ATTEMPTS):
            if attempt:
                self._command(bytes((_DELETE, identifier)))
            packets = [items[i : i + _ITEMS_A_PACKET] for i in range(0, len(items), _ITEMS_A_PACKET)]
            for number, part in enumerate(packets):
                head = bytes((_APPEND if number else _CREATE, identifier))
                body = b"".join(struct.pack("<BH", kind, index) for kind, index in part)
                status = self._command(head + body, repeat=False)
                if status in (None, _EEXIST):  # the content of the block is unknown: delete it
                    break
                if status:
                    raise LinkError(f"The drone at {self._uri} refused log block {identifier}: {_reason(status)}.")
            else:
                return
        raise LinkError(f"The drone at {self._uri} did not confirm log block {identifier}.")

    def start(self, identifier: int, period_ms: int) -> bool:
        """Start the block; False if it does not exist.

        Periods that are not a multiple of 10 ms need a start command in milliseconds, which cflib does not use.

        Raises: UsageError: the firmware does not have this command. LinkError: no answer, or refused.
        """
        if period_ms % 10 == 0:
            status = self._command(bytes((_START, identifier, period_ms // 10)))
        else:
            status = self._command(struct.pack("<BBH", _START_MS, identifier, period_ms))
        if status is None:
            raise LinkError(f"The drone at {self._uri} did not confirm the start of log block {identifier}.")
        if status == _ENOEXEC and period_ms % 10:
            raise UsageError(
                f"The firmware at {self._uri} cannot log every {period_ms} ms, only every 10 ms or multiples of that."
            )
        if status not in (0, ENOENT):
            raise LinkError(f"The drone at {self._uri} did not start log block {identifier}: {_reason(status)}.")
        return status == 0

    def delete(self, identifier: int) -> bool:
        """Delete the block if it exists; returns whether the drone answered."""
        return self._command(bytes((_DELETE, identifier))) is not None

    def _command(self, data: bytes, *, repeat: bool = True) -> int | None:
        """Status of a command, None without an answer."""
        after = REPEAT_AFTER if repeat else None
        reply = self._requests.request(_PORT, _CONTROL, data, timeout=REPLY_WITHIN, repeat_after=after)
        return reply[2] if reply is not None and len(reply) > 2 else None


def _reason(status: int) -> str:
    return _REASONS.get(status, f"error {status}")


LATE_AFTER = 0.1  # s of delay over the least-delayed packets, above which a packet is late
_START_ATTEMPT = 0.5  # s to wait for a block's first packet, in addition to its period, before the next attempt
_START_ATTEMPTS = 4
_DELAY_SAMPLES = 500  # newest packets of a block, for the median and 99th percentile of their delays
_BACKWARDS_MS = 200  # ms; a clock that goes back by more was reset
_AHEAD_SECONDS = 2.0  # s
_FASTEST_CLOCK_RATIO = 3.0  # on the time by the clock relation: a simulator that stopped for a while catches up faster


class LogBlocks:
    """Log blocks of one drone; used by `crazyflie.CrazyflieLink`.

    Args:
        uri: for messages.
        packets: queue for received packets, in order of arrival.
    """

    def __init__(self, uri: str, packets: "queue.SimpleQueue[Packet | LinkLost]") -> None:
        self._uri, self._packets = uri, packets
        self._cf: Any = None
        self._requests: RequestClient | None = None
        self._running: dict[int, tuple[Block, Any, Callable[..., None]]] = {}
        self._counters: dict[int, LossCounter] = {}
        self._delays: dict[int, deque[float]] = {}
        self._unwrapper = StampUnwrapper()
        self._clock = ClockRelation()
        self._edge: ClockFit | None = None
        self._lock = threading.Lock()
        self._held: dict[int, int] | None = None  # during a reconnection: block -> stamp of its first packet [ms]
        self._newest = -math.inf
        self.outages = 0
        self.last_packet = time.monotonic()

    def attach(self, crazyflie: Any) -> None:
        """Work with this connected Crazyflie object."""
        self._cf = crazyflie
        self._requests = RequestClient(crazyflie)
        self._control = LogControl(self._requests, self._uri)
        self.last_packet = time.monotonic()

    @property
    def requests(self) -> RequestClient:
        """The client for other requests over the same link."""
        assert self._requests is not None
        return self._requests

    @property
    def periods(self) -> list[float]:
        """Periods of the running blocks, s."""
        return [block.period_ms / 1000.0 for block, _, _ in list(self._running.values())]

    def available(self) -> Mapping[str, str]:
        """Name -> C type of everything the firmware can log."""
        return types_of(self._cf.log.toc)

    # --- starting ---------------------------------------------------------------------------------------------------

    def subscribe(self, variables: Sequence[str], rate_hz: float, lost: Callable[[], str]) -> tuple[Block, ...]:
        """See `CrazyflieLink.subscribe`; `lost()` gives the reason if the drone counts as lost, else ""."""
        in_use = [b for b in self._cf.log.log_blocks if b.added or b.pending or b.started]
        blocks = pack(
            variables,
            self.available(),
            period_of(rate_hz),
            first_identifier=max(self._counters, default=-1) + 1,
            blocks_in_use=len(in_use),
            variables_in_use=sum(len(b.variables) for b in in_use),
        )
        for block in blocks:
            config = self._configuration(block)
            receive = self._receiver(block)
            config.data_received_cb.add_callback(receive)
            self._counters[block.identifier] = LossCounter(block.period_ms)
            self._delays[block.identifier] = deque(maxlen=_DELAY_SAMPLES)
            self.last_packet = time.monotonic()
            self._running[block.identifier] = (block, config, receive)
            try:
                self._start(block, config, lost)
            except UsageError:
                if block.period_ms <= PERIOD_UNIT_MS or not block.period_ms % PERIOD_UNIT_MS:
                    raise
                return self._restart_in_tens(variables, block, lost)
        return blocks

    def _restart_in_tens(self, variables: Sequence[str], block: Block, lost: Callable[[], str]) -> tuple[Block, ...]:
        """Subscribe again with a multiple of 10 ms, because older firmware refuses other periods."""
        _, config, receive = self._running.pop(block.identifier)
        config.data_received_cb.remove_callback(receive)
        self._control.delete(config.id)
        self._cf.log.log_blocks.remove(config)
        del self._counters[block.identifier]
        tens = max(1, round(block.period_ms / PERIOD_UNIT_MS)) * PERIOD_UNIT_MS
        return self.subscribe(variables, 1000.0 / tens, lost)

    def _configuration(self, block: Block) -> Any:
        """cflib's object for the block, which numbers blocks and decodes packets."""
        from cflib.crazyflie.log import LogConfig

        class Configuration(LogConfig):  # always counts as added; else cflib would start it before it is complete
            added = property(lambda self: True, lambda self, value: None)

        config = Configuration(f"crazyem {block.identifier}", max(block.period_ms, 10))
        for variable in block.variables:
            config.add_variable(variable.name)
        try:
            self._cf.log.add_config(config)
        except (KeyError, AttributeError) as error:
            raise UsageError(f"The drone does not take log block {block.identifier}: {error}.") from error
        return config

    def _install(self, block: Block, config: Any) -> None:
        table = self._cf.log.toc
        items = [(v.get_storage_and_fetch_byte(), table.get_element_id(v.name)) for v in config.variables]
        self._control.install(config.id, items)
        if not self._control.start(config.id, block.period_ms):
            raise LinkError(f"The drone at {self._uri} lost log block {block.identifier} at once.")

    def _start(self, block: Block, config: Any, lost: Callable[[], str]) -> None:
        """Start a block and wait for its first packet."""
        for _ in range(_START_ATTEMPTS):
            try:
                self._install(block, config)
            except LinkError as error:
                raise LinkError(lost() or str(error)) from None
            deadline = time.monotonic() + _START_ATTEMPT + block.period_ms / 1000.0
            while time.monotonic() < deadline:
                if lost():
                    raise LinkError(lost())
                if self._counters[block.identifier].received:
                    return
                time.sleep(0.002)
        raise LinkError(f"Log block {block.identifier} of {self._uri} does not start: no data came.")

    def remove(self, *, answered: bool) -> None:
        """Remove every block; also delete them on the drone if the drone answers (`answered`)."""
        for _, config, receive in self._running.values():
            with contextlib.suppress(ValueError):
                config.data_received_cb.remove_callback(receive)
            if answered and self._cf.link is not None:
                with contextlib.suppress(Exception):
                    answered = self._control.delete(config.id)
        for _, config, _ in self._running.values():
            with contextlib.suppress(ValueError):
                self._cf.log.log_blocks.remove(config)
        self._running.clear()
        if self._requests is not None:
            self._requests.close()

    # --- receiving --------------------------------------------------------------------------------------------------

    def _receiver(self, block: Block) -> Callable[[int, Mapping[str, float], Any], None]:
        names = tuple(v.name for v in block.variables)
        identifier = block.identifier

        def receive(stamp: int, data: Mapping[str, float], _config: Any) -> None:
            host_time = time.time()
            self.last_packet = time.monotonic()
            with self._lock:
                if self._held is not None:
                    self._held.setdefault(identifier, stamp)
                    return
                firmware_time = self._unwrapper.unwrap(stamp)
                self._newest = max(self._newest, firmware_time)
                self._clock.add(firmware_time, host_time)
                edge, late = self._edge, False
                if edge is not None:
                    delay = host_time - edge.to_host(firmware_time)
                    late = delay > LATE_AFTER
                if not self._counters[identifier].count(firmware_time, late=late):
                    return
                if edge is not None:
                    self._delays[identifier].append(delay)
                # Inside the lock, to keep the order of packets after `release`.
                self._packets.put(Packet(identifier, firmware_time, host_time, tuple(data[name] for name in names)))

        return receive

    def refresh(self) -> None:
        """Update the fit of the clocks; to be called a few times a second."""
        with self._lock:
            self._edge = self._clock.fit()

    def clock(self) -> ClockFit | None:
        """Relation of the host clock to the firmware's, None before the first packet."""
        with self._lock:
            return self._clock.fit()

    def statistics(self, round_trip: float = math.nan) -> LinkStatistics:
        """Counts of packets in total and per block, their delays and the clocks."""
        with self._lock:
            fates = {i: (c.received, c.lost, c.late) for i, c in self._counters.items()}
            duplicates = sum(c.duplicates for c in self._counters.values())
            delays = {i: list(d) for i, d in self._delays.items() if d}
            fit = self._clock.fit()
        totals = [sum(f[k] for f in fates.values()) for k in range(3)]
        return LinkStatistics(
            totals[0], totals[1], totals[2], fates,
            delays={i: _median_and_p99(d) for i, d in delays.items()},
            round_trip=round_trip,
            clock_offset=fit.offset if fit is not None else math.nan,
            clock_rate=fit.rate if fit is not None else math.nan,
            outages=self.outages,
            duplicates=duplicates,
        )  # fmt: skip

    # --- after an outage --------------------------------------------------------------------------------------------

    def hold(self) -> None:
        """Hold packets back until the drone is verified."""
        with self._lock:
            self._held = {}

    def resume(self, deadline: float) -> int:
        """Make every block deliver again; returns the number of blocks that were created again.

        Raises: LinkError: no answer in time.
        """
        created = 0
        for identifier, (block, config, _) in self._running.items():
            if self._flows(identifier):
                continue
            if not self._control.start(config.id, block.period_ms):
                self._install(block, config)
                created += 1
        longest = max(self.periods, default=0.0)
        until = min(deadline, time.monotonic() + _START_ATTEMPT + 2 * longest)
        while not all(self._flows(i) for i in self._running):
            if time.monotonic() > until:
                raise LinkError(f"The drone at {self._uri} answers, but log data does not come.")
            time.sleep(0.002)
        return created

    def _flows(self, identifier: int) -> bool:
        with self._lock:
            return self._held is not None and identifier in self._held

    def reset_since(self) -> bool:
        """Whether the drone restarted: the stamps of held packets do not fit the clock before the outage."""
        with self._lock:
            stamps = list((self._held or {}).values())
            if not stamps or not math.isfinite(self._newest):
                return False
            now = max(self._unwrapper.peek(s) for s in stamps)
            if now < self._newest - _BACKWARDS_MS:
                return True
            fit = self._clock.fit()
            if fit is None or fit.packets < 300:
                return False
            allowed = (time.time() - fit.to_host(self._newest)) / fit.rate * _FASTEST_CLOCK_RATIO + _AHEAD_SECONDS
            return (now - self._newest) / 1000.0 > allowed

    def release(self) -> float:
        """Deliver packets again; returns the newest held stamp, unwrapped, ms.

        Held packets are dropped: each block sends new ones within a period.
        """
        with self._lock:
            after = max((self._unwrapper.peek(s) for s in (self._held or {}).values()), default=math.nan)
            self._held = None
            self.outages += 1
        return after

    @property
    def newest_ms(self) -> float:
        """Newest unwrapped stamp, ms; -inf before the first."""
        return self._newest


def _median_and_p99(values: list[float]) -> tuple[float, float]:
    ordered = sorted(values)
    return statistics.median(ordered), ordered[min(len(ordered) - 1, round(0.99 * (len(ordered) - 1)))]
