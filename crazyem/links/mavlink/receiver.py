"""The receiver of a MAVLink link: it selects a drone, counts its frames, and turns them into packets of blocks.

One thread, which also sends our heartbeats and requests for the time, because it wakes up often enough. The clock of
the autopilot comes from the stamps of its messages, unwrapped and checked: ms since boot (32 bits), us since boot (64
or 32 bits), us since 1970, or none. Sources: mavlink.io/en/messages/common.html. PX4 truncates microseconds to
time_boot_ms, so microseconds are truncated here, too.
"""

import math
import queue
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from crazyem.errors import LinkError
from crazyem.links.base import LinkLost, LinkStatistics
from crazyem.links.clock import ClockFit, ClockRelation
from crazyem.links.mavlink import streams
from crazyem.links.mavlink.frames import Frame, FrameParser, SequenceCounter, number_of
from crazyem.links.mavlink.transport import MessageSender, Peer
from crazyem.signals.sample import Block, Packet

EPOCH_US = 10**15  # us; a larger time_usec is since 1970
_BEHIND_MS = 2000.0  # ms; stamps further behind the newest one are refused
_AHEAD_MS = 2000.0  # ms; largest lead of a stamp, in addition to the next factor times the host's elapsed time
_FASTEST_CLOCK_RATIO = 100.0
_RESTART_REFUSALS = 20  # refused stamps in a row that mean a restart
_WRAP32 = 1 << 32


class RestartedError(Exception):
    """The autopilot's clock has restarted."""


class DroneClock:
    """Places messages on the drone's clock.

    Attributes:
        newest_ms: newest accepted stamp; NaN before the first.
        refused: number of refused stamps.
    """

    def __init__(self) -> None:
        self.newest_ms = math.nan
        self.refused = 0
        self._newest_host = math.nan
        self._utc_ms: int | None = None  # 1970 on the drone's clock
        self._refused_in_row = 0

    def place(self, fields: Mapping[str, Any], host: float) -> int | None:
        """Stamp [ms] of a message that arrived at `host` [s, any steady clock]; None: refused, or not known yet.

        A message without its own stamp gets the newest stamp of the others: it is at least as new.

        Raises: RestartedError after `_RESTART_REFUSALS` refused stamps in a row.
        """
        stamp = self._stamp_of(fields)
        if stamp is None:
            return None if math.isnan(self.newest_ms) else int(self.newest_ms)
        if not math.isnan(self.newest_ms):
            allowed = _AHEAD_MS + _FASTEST_CLOCK_RATIO * 1000.0 * max(host - self._newest_host, 0.0)
            if not -_BEHIND_MS <= stamp - self.newest_ms <= allowed:
                self.refused += 1
                self._refused_in_row += 1
                if self._refused_in_row >= _RESTART_REFUSALS:
                    raise RestartedError
                return None
        self._refused_in_row = 0
        if not stamp <= self.newest_ms:
            self.newest_ms, self._newest_host = float(stamp), host
        return stamp

    def _stamp_of(self, fields: Mapping[str, Any]) -> int | None:
        if "time_boot_ms" in fields:
            return self._unwrapped(int(fields["time_boot_ms"]), _WRAP32)
        if "time_usec" not in fields or fields["time_usec"] <= 0:
            return None
        stamp = int(fields["time_usec"])
        if stamp > EPOCH_US:
            if math.isnan(self.newest_ms):
                return None
            if self._utc_ms is None:
                self._utc_ms = stamp // 1000 - int(self.newest_ms)
            return stamp // 1000 - self._utc_ms
        if "servo1_raw" not in fields:
            return stamp // 1000
        if math.isnan(self.newest_ms):
            return None
        return self._unwrapped(stamp, _WRAP32, per_ms=1000)  # 32 bits of microseconds wrap after 71 minutes

    def _unwrapped(self, stamp: int, modulus: int, per_ms: int = 1) -> int:
        if math.isnan(self.newest_ms):
            return stamp // per_ms
        newest = int(self.newest_ms) * per_ms
        half = modulus // 2
        return (newest + (stamp - newest + half) % modulus - half) // per_ms


SILENT_AFTER = 2.0  # s
_BEAT_EVERY, _TIME_EVERY = 1.0, 1.0  # s
_NOT_A_VEHICLE = {6, 18, 26, 27, 28, 30}  # MAV_TYPE of ground stations, onboard computers, gimbals, cameras ...
_NO_AUTOPILOT = 8
_LATE_MS = 100.0
_MOST_FOREIGN = 256
OUR_SIMULATOR = b"crazyem firmware"  # begins AUTOPILOT_VERSION.uid2 of firmware_sim


class Receiver:
    """Receives the messages of one selected drone.

    Args:
        uri: for messages. sender: owner of the transport. system: number of the drone, None: the first one received.
        packets: queue for packets of blocks, and `LinkLost` at the end.
        on_parameter: called with each PARAM_VALUE.

    Attributes:
        autopilot, kind: MAV_AUTOPILOT and MAV_TYPE of the drone, -1 before it is selected.
        system, component: numbers of the drone.
        simulated: whether the drone says that it is our simulator.
        seen: number of its messages, by name. foreign: number of frames of other systems, by system.
        refused: number of invalid values: NaN, masked, out of range.
        on_frame: called with (host time [s], frame) for every valid frame of the drone.
        blocks: those that become packets. lost: why the link counts as lost, or "". unrecoverable: the drone restarted.
        unplugged: the transport is gone and has to be opened again.
        last: time.monotonic() of the last values.
    """

    def __init__(
        self,
        uri: str,
        sender: MessageSender,
        *,
        system: int | None,
        packets: "queue.SimpleQueue[Packet | LinkLost]",
        on_parameter: Callable[[Mapping[str, Any]], None],
    ) -> None:
        self.uri, self.sender, self._wanted, self._packets = uri, sender, system, packets
        self._on_parameter = on_parameter
        self.on_frame: Callable[[float, bytes], None] | None = None
        self.autopilot = self.kind = -1
        self.system = self.component = 0
        self.simulated = False
        self.seen: dict[str, int] = {}
        self.foreign: dict[int, int] = {}
        self.refused = self.outages = 0
        self.lost = ""
        self.unrecoverable = self.unplugged = False
        self.last = time.monotonic()
        self.parser, self.sequence = FrameParser(), SequenceCounter()
        self.drone_clock, self.relation = DroneClock(), ClockRelation()
        self.streams = streams.Streams()
        self.blocks: dict[str, Block] = {}
        self._received: dict[int, int] = {}
        self._numbers = {number_of(n) for n in self.streams.messages}
        self._round_trips: deque[float] = deque(maxlen=50)
        self._edge: ClockFit | None = None
        self._late = 0
        self._peer: Peer = None
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="crazyem-mavlink", daemon=True)
        self._thread.start()

    def use(self, blocks: dict[str, Block]) -> None:
        """Deliver packets of these blocks from now on."""
        with self._lock:
            self._received = {b.identifier: 0 for b in blocks.values()}
            self.blocks = blocks

    def close(self) -> None:
        """Stop the thread."""
        self._stop.set()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=2.0)

    def end_outage(self) -> None:
        """Note that the link is back."""
        with self._lock:
            self.lost = ""
            self.outages += 1

    def statistics(self) -> LinkStatistics:
        """Counts of this drone's messages: lost ones by their sequence numbers, without repeated ones."""
        trips = list(self._round_trips)
        with self._lock:
            fit = self.relation.fit()
            per_block = {i: (n, 0, 0) for i, n in self._received.items()}
        return LinkStatistics(
            self.sequence.received,
            self.sequence.lost,
            self._late + self.sequence.late,
            per_block,
            round_trip=statistics.median(trips) if trips else math.nan,
            clock_offset=fit.offset if fit is not None else math.nan,
            clock_rate=fit.rate if fit is not None else math.nan,
            outages=self.outages,
            duplicates=self.sequence.repeated,
        )

    def account(self) -> Mapping[str, str]:
        """Counts of frames and bytes, for the end of a recording."""
        return {
            "repeated": str(self.sequence.repeated),
            "damaged": str(self.parser.damaged),
            "unknown": str(self.parser.unknown),
            "skipped_bytes": str(self.parser.skipped),
            "refused": str(self.refused + self.drone_clock.refused),
            "other_systems": " ".join(f"{s}:{n}" for s, n in sorted(self.foreign.items())),
        }

    def fit(self) -> ClockFit | None:
        """Relation of the host clock to the autopilot's, None before the first packet."""
        with self._lock:
            return self.relation.fit()

    def _run(self) -> None:
        try:
            self._listen()
        except Exception as error:  # an internal error must be reported as a lost link
            self._report_lost(f"Receiving from {self.uri} failed: {error!r}.")

    def _listen(self) -> None:
        beat = asked = refreshed = 0.0
        while not self._stop.is_set():
            sender = self.sender
            now = time.monotonic()
            if now - beat >= _BEAT_EVERY:
                beat = now
                sender.heartbeat()
            if self.autopilot >= 0 and now - asked >= _TIME_EVERY:
                asked = now
                sender.ask_time()
            if now - refreshed >= 0.2:
                refreshed = now
                with self._lock:
                    self._edge = self.relation.fit()
            if self.blocks and not self.lost and now - self.last > SILENT_AFTER:
                self._report_lost(f"The drone at {self.uri} was lost: nothing has come for {SILENT_AFTER:g} s.")
            try:
                data, peer = sender.transport.receive(0.02)
            except LinkError as error:
                self.unplugged = True
                self._report_lost(f"The drone at {self.uri} was lost: {error}")
                self._stop.wait(0.1)
                continue
            if self._peer is not None and peer is not None and peer != self._peer:
                continue  # from another address than the selected drone
            for frame in self.parser.feed(data) if data else ():
                self._frame(sender, frame, peer)

    def _frame(self, sender: MessageSender, frame: Frame, peer: Peer) -> None:
        if self.autopilot < 0:
            self._consider(sender, frame, peer)
            if self.autopilot < 0:
                return
        if frame.system != self.system:
            self._count_foreign(frame.system)
            return
        if frame.component != self.component:
            return  # a camera or a gimbal has its own sequence numbers
        if not self.sequence.take(frame.sequence, frame.raw):
            return
        host_time = time.time()
        if self.on_frame is not None:
            self.on_frame(host_time, frame.raw)
        self._message(sender, frame, host_time)

    def _count_foreign(self, system: int) -> None:
        if len(self.foreign) < _MOST_FOREIGN:
            self.foreign[system] = self.foreign.get(system, 0) + 1

    def _consider(self, sender: MessageSender, frame: Frame, peer: Peer) -> None:
        """Select the drone if this is a heartbeat of a vehicle (with the wanted number)."""
        fields = frame.fields() if frame.name == "HEARTBEAT" else None
        wanted = self._wanted
        vehicle = fields and fields["autopilot"] != _NO_AUTOPILOT and fields["type"] not in _NOT_A_VEHICLE
        if fields is None or not vehicle or (wanted is not None and frame.system != wanted):
            self._count_foreign(frame.system)
            return
        self.system, self.component = frame.system, frame.component
        self.foreign.pop(frame.system, None)
        self.kind, self.autopilot = int(fields["type"]), int(fields["autopilot"])
        self._peer = peer
        sender.transport.answer(peer)
        sender.target = (frame.system, frame.component)

    def _message(self, sender: MessageSender, frame: Frame, host_time: float) -> None:
        name = frame.name
        self.seen[name] = self.seen.get(name, 0) + 1
        if name == "PARAM_VALUE":
            self._on_parameter(frame.fields())
        elif name == "COMMAND_ACK":
            sender.acknowledged(frame.fields())
        elif name == "TIMESYNC":
            self._time(sender, frame.fields())
        elif name == "AUTOPILOT_VERSION":
            self.simulated = bytes(frame.fields()["uid2"]).startswith(OUR_SIMULATOR)
        if frame.message in self._numbers:
            self._values(name, frame.fields(), host_time)

    def _time(self, sender: MessageSender, fields: Mapping[str, Any]) -> None:
        if fields["tc1"] == 0:
            sender.answer_time(int(fields["ts1"]))
            return
        took = (time.monotonic_ns() - int(fields["ts1"])) / 1e9
        if 0.0 <= took < 10.0:  # else the answer to another client
            self._round_trips.append(took)

    def _values(self, name: str, fields: Mapping[str, Any], host_time: float) -> None:
        now = time.monotonic()
        try:
            stamp = self.drone_clock.place(fields, now)
        except RestartedError:
            self.unrecoverable = True
            self._report_lost(f"The drone at {self.uri} was restarted: its clock has begun anew.", restarted=True)
            return
        if stamp is None or not self.streams.uses(name):
            return
        found = self.streams.values(name, fields)
        if found is None:
            self.refused += 1
            return
        self.last = now
        block = self.blocks.get(found[0])
        if block is None or self.lost:
            return
        with self._lock:
            self.relation.add(stamp, host_time)
            edge = self._edge
            self._late += edge is not None and 1000.0 * (host_time - edge.to_host(stamp)) > _LATE_MS
            self._received[block.identifier] += 1
        self._packets.put(Packet(block.identifier, stamp, host_time, tuple(map(float, found[1]))))

    def _report_lost(self, reason: str, *, restarted: bool = False) -> None:
        with self._lock:
            if self.lost or self._stop.is_set():
                return
            self.lost = reason
        self._packets.put(LinkLost(reason, time.time(), restarted))
