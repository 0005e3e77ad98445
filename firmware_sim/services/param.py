"""Port 2, the parameters: table of contents, read, write, and the misc channel (crazyflie-firmware param_logic.c)."""

from collections.abc import Callable, Mapping

from firmware_sim.services.log import toc_reply
from firmware_sim.services.memory import Storage
from firmware_sim.tables import SIZE, Item, Table, pack, unpack
from firmware_sim.wire import EACCES, EINVAL, ENOENT

TOC, READ, WRITE, MISC = 0, 1, 2, 3
SET_BY_NAME, EXTENDED_V1, STORE, STATE, CLEAR, DEFAULT_V1, EXTENDED, DEFAULT = 0, 2, 3, 4, 5, 6, 7, 8
PERSISTENT = 1  # extended type


class ParamService:
    """Reads and writes live values; `storage` holds values that a client has stored for the next boot."""

    def __init__(self, table: Table, defaults: Mapping[str, float], written: Callable[[str], None], storage: Storage):
        self.table = table
        self._defaults = dict(defaults)
        self._written = written
        self.storage = storage

    def restore(self) -> None:
        """Give stored parameters their stored values, as the firmware does while booting."""
        for name, value in list(self.storage.values.items()):
            item = self.table.by_name.get(name)
            if item is not None and item.persistent:
                self.set(item, value)

    def reformat(self) -> None:
        """Forget all that is stored, once system.storageReformat asks for it."""
        item = self.table.by_name["system.storageReformat"]
        if item.value:
            self.storage.clear()
            item.array[item.index] = 0.0

    def handle(self, channel: int, data: bytes) -> list[tuple[int, bytes]]:
        """Replies (channel, data) to a packet on the parameter port."""
        if channel == TOC:
            return [(TOC, reply) for reply in toc_reply(self.table, data, b"")] if data else []
        if channel == MISC:
            reply = self._misc(data) if data else b""
        elif len(data) < 2:
            reply = b""
        elif channel == READ:
            item = self.table.get(int.from_bytes(data[:2], "little"))
            reply = data[:2] + (b"\0" + pack(item.value, item.kind) if item else bytes((ENOENT,)))
        else:
            reply = self._write(data)
        return [(channel, reply)] if reply else []

    def set(self, item: Item, value: float) -> None:
        """Write a value and notify the part of the firmware that uses it."""
        item.array[item.index] = value
        self._written(item.name)

    def _write(self, data: bytes) -> bytes:
        """Echo the whole payload; a read-only parameter gets no reply at all. No size or range check."""
        item = self.table.get(int.from_bytes(data[:2], "little"))
        if item is None:
            return data[:2] + bytes((ENOENT,))
        if item.read_only:
            return b""
        self.set(item, unpack(data[2:], item.kind))
        return data

    def _misc(self, data: bytes) -> bytes:
        command = data[0]
        if command == SET_BY_NAME:
            return self._set_by_name(data)
        if command not in {EXTENDED_V1, STORE, STATE, CLEAR, DEFAULT_V1, EXTENDED, DEFAULT} or len(data) < 3:
            return b""
        head, item = data[:3], self.table.get(int.from_bytes(data[1:3], "little"))
        if item is None or not self._has(command, item):
            return head + bytes((ENOENT,))
        default = pack(self._defaults.get(item.name, 0.0), item.kind)
        if command == EXTENDED_V1:
            return head + bytes((PERSISTENT if item.persistent else 0,))
        if command == EXTENDED:
            return head + bytes((0, PERSISTENT))
        if command == DEFAULT_V1:
            return head + default
        if command == DEFAULT:
            return head + b"\0" + default
        if command == STORE:
            self.storage.store(item.name, unpack(pack(item.value, item.kind), item.kind))
            return head + b"\0"
        if command == CLEAR:
            self.storage.remove(item.name)
            return head + b"\0"
        if item.name in self.storage.values:
            return head + b"\x01" + default + pack(self.storage.values[item.name], item.kind)
        return head + b"\0" + default

    @staticmethod
    def _has(command: int, item: Item) -> bool:
        """Whether the parameter supports the command: only persistent ones can be stored."""
        if command in {STORE, CLEAR, EXTENDED}:
            return item.persistent
        return not (item.read_only and command in {DEFAULT_V1, DEFAULT})

    def _set_by_name(self, data: bytes) -> bytes:
        """`00 group NUL name NUL type value` -> `00 group NUL name NUL error`."""
        group, _, rest = data[1:].partition(b"\0")
        name, end, rest = rest.partition(b"\0")
        head = b"\0" + group + b"\0" + name + b"\0"
        if not end or not rest:
            return head[:29] + bytes((EINVAL,))
        item = self.table.by_name.get(f"{group.decode('latin-1')}.{name.decode('latin-1')}")
        if item is None:
            return head + bytes((ENOENT,))
        if item.read_only:
            return head + bytes((EACCES,))
        if rest[0] & 0x0F != item.type_byte & 0x0F or len(rest) - 1 < SIZE[item.kind]:
            return head + bytes((EINVAL,))
        self.set(item, unpack(rest[1:], item.kind))
        return head + b"\0"
