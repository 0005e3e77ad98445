"""Port 5, the log: the table of contents, log blocks, and their data packets (crazyflie-firmware log.c)."""

import struct
from dataclasses import dataclass, field

import numpy as np

from firmware_sim.tables import LOG_TYPE_NAME, SIZE, Item, Table, fetch
from firmware_sim.wire import E2BIG, EEXIST, ENOENT, ENOEXEC, ENOMEM

TOC, CONTROL, DATA = 0, 1, 2
MAX_BLOCKS, MAX_VARIABLES, MAX_BYTES = 16, 128, 26
GET_ITEM_V1, GET_INFO_V1, GET_ITEM, GET_INFO = 0, 1, 2, 3
DELETE, START, STOP, RESET, CREATE, APPEND, START_MS = 2, 3, 4, 5, 6, 7, 8

# Delays of the firmware's timer and worker tasks, after recordings of the real firmware at 100 Hz x 4 blocks: the mean
# period is exact, one sample in twenty is late, mostly by 1 or 2 ms, the worst by 16.
_MAX_PHASE = 10  # ms
_LATE_PROBABILITY, _LATE_MEAN, _LATE_MAX = 0.05, 1.5, 16


@dataclass
class Block:
    """A log block: its variables with the type each is fetched as, and its own timer."""

    variables: list[tuple[Item, str]] = field(default_factory=list)
    size: int = 0  # bytes of data
    period: int = 0  # ms, 0 = not periodic
    nominal: int | None = None  # tick the timer fires, None = stopped
    due: int | None = None  # tick the sample is really taken

    def sample(self, number: int, tick: int) -> bytes:
        """The data packet: block number, 24-bit stamp in ms, values packed in the order they were added."""
        stamp = struct.pack("<I", tick & 0xFFFFFF)[:3]
        values = b"".join(fetch(float(item.array[item.index]), item.kind, kind) for item, kind in self.variables)
        return bytes((number,)) + stamp + values


class LogService:
    """Table of contents, block control and the timers of the blocks."""

    def __init__(self, table: Table, seed: int):
        self.table = table
        self.blocks: dict[int, Block] = {}
        self._random = np.random.default_rng([seed, 0x109])

    def handle(self, channel: int, data: bytes, tick: int) -> list[tuple[int, bytes]]:
        """Replies (channel, data) to a packet on the log port; tick [ms] is where a started block's timer begins."""
        if not data:
            return []
        if channel == TOC:
            return [(TOC, reply) for reply in toc_reply(self.table, data, bytes((MAX_BLOCKS, MAX_VARIABLES)))]
        if channel == CONTROL:
            return [(CONTROL, self._control(data[0], data[1:], tick))]
        return []

    def _control(self, command: int, data: bytes, tick: int) -> bytes:
        if command == RESET:
            self.blocks.clear()
            return bytes(
                (RESET, 0, 0)
            )  # the middle byte is junk in the firmware; with fewer bytes cflib never connects
        number = data[0] if data else 0
        if command == CREATE:
            status = self._create(number, data[1:])
        elif command == APPEND:
            status = self._append(number, data[1:])
        elif command == DELETE:
            status = 0 if self.blocks.pop(number, None) else ENOENT
        elif command == START and len(data) >= 2:
            status = self._start(number, 10 * data[1], tick)
        elif command == START_MS and len(data) >= 3:
            status = self._start(number, data[1] | data[2] << 8, tick)
        elif command == STOP:
            status = ENOENT
            if number in self.blocks:
                self.blocks[number].due = self.blocks[number].nominal = None
                status = 0
        else:
            status = ENOEXEC  # among them the V1 create and append
        return bytes((command, number, status))

    def _create(self, number: int, operations: bytes) -> int:
        if number in self.blocks:
            return EEXIST
        if len(self.blocks) >= MAX_BLOCKS:
            return ENOMEM
        self.blocks[number] = Block()
        return self._append(number, operations)

    def _append(self, number: int, operations: bytes) -> int:
        """Add variables, three bytes each; a dangling byte at the end (cflib sends one with ten or more) is ignored."""
        block = self.blocks.get(number)
        if block is None:
            return ENOENT
        for start in range(0, len(operations) - 2, 3):
            type_byte, index = struct.unpack_from("<BH", operations, start)
            kind = LOG_TYPE_NAME.get(type_byte & 0x0F)  # the storage type in the high nibble is not reliable
            item = self.table.get(index)
            if kind is None:
                return ENOENT
            if block.size + SIZE[kind] > MAX_BYTES:
                return E2BIG
            if sum(len(other.variables) for other in self.blocks.values()) >= MAX_VARIABLES:
                return ENOMEM
            if item is None:
                return ENOENT
            block.variables.append((item, kind))
            block.size += SIZE[kind]
        return 0

    def _start(self, number: int, period: int, tick: int) -> int:
        block = self.blocks.get(number)
        if block is None:
            return ENOENT
        block.period = period
        if period:
            block.nominal = tick + period + self._phase(period, tick)
            block.due = block.nominal + self._delay(period)
        else:
            block.nominal = block.due = tick  # one shot
        return 0

    def _phase(self, period: int, tick: int) -> int:
        """Delay of the timer's start, up to 10 ms, so that no two blocks are sampled at the same instant.

        Over radio the starts of blocks are some ms apart; on a loopback they may fall into the same millisecond.
        """
        span = min(period, _MAX_PHASE)
        taken = {block.nominal % period for block in self.blocks.values() if block.nominal is not None}
        free = [phase for phase in range(span) if (tick + phase) % period not in taken] or list(range(span))
        return free[int(self._random.integers(len(free)))]

    def _delay(self, period: int) -> int:
        """How many ms late the next sample is taken; never as late as the following one."""
        if self._random.random() >= _LATE_PROBABILITY:
            return 0
        return min(1 + int(self._random.exponential(_LATE_MEAN)), _LATE_MAX, max(period - 1, 0))

    def next_due(self) -> int | None:
        """The tick [ms] of the next sample of any block, None if all are stopped."""
        return min((block.due for block in self.blocks.values() if block.due is not None), default=None)

    def samples(self, tick: int) -> list[bytes]:
        """Data packets of every block that is due at this tick [ms]."""
        packets = []
        for number, block in self.blocks.items():
            if block.due is None or block.nominal is None or block.due > tick:
                continue
            packets.append(block.sample(number, tick))
            if block.period:
                block.nominal += block.period
                block.due = max(block.nominal + self._delay(block.period), tick + 1)
            else:
                block.nominal = block.due = None
        return packets


def toc_reply(table: Table, data: bytes, limits: bytes) -> list[bytes]:
    """Reply to a table of contents request, log and param alike; limits: bytes that only the log's info carries."""
    command, count, crc = data[0], len(table.items), struct.pack("<I", table.crc)
    if command == GET_INFO:
        return [struct.pack("<BH", GET_INFO, count) + crc + limits]
    if command == GET_INFO_V1:
        return [bytes((GET_INFO_V1, min(count, 255))) + crc + limits]
    if command == GET_ITEM and len(data) >= 3:
        index = data[1:3]
        item = table.get(int.from_bytes(index, "little"))
        return [b"\x02" + index + bytes((item.type_byte,)) + item.wire_name if item else b"\x02"]
    if command == GET_ITEM_V1 and len(data) >= 2:
        item = table.get(data[1])
        return [bytes((0, data[1], item.type_byte)) + item.wire_name if item else b"\x00"]
    return []
