"""Compiled search for the records in an unpacked MCAP chunk; a recording of a gigabyte has ten million records."""

import numpy as np

from crazyem.compiled import compiled


@compiled
def _number(data, at, size):
    """Unsigned little-endian number of `size` bytes."""
    value = np.int64(0)
    for i in range(size - 1, -1, -1):
        value = (value << 8) | np.int64(data[at + i])
    return value


@compiled
def chunk_records(data, messages, others):
    """Numbers of messages and of other records; -1, -1 if a record is not valid in a chunk.

    The records are written to the tables of `Scan` as far as these have rows.
    """
    at = 0
    m = 0
    k = 0
    size = data.size
    while at < size:
        if size - at < 9:
            return -1, -1
        opcode = data[at]
        length = _number(data, at + 1, 8)
        if length < 0 or length > size - at - 9:
            return -1, -1
        if opcode == 5:
            if length < 22:
                return -1, -1
            if m < messages.shape[0]:
                messages[m, 0] = at + 31
                messages[m, 1] = length - 22
                messages[m, 2] = _number(data, at + 9, 2)
                messages[m, 3] = _number(data, at + 15, 8)
                messages[m, 4] = _number(data, at + 23, 8)
                messages[m, 5] = _number(data, at + 11, 4)
            m += 1
        elif opcode in (3, 4):
            if k < others.shape[0]:
                others[k, 0] = opcode
                others[k, 1] = at + 9
                others[k, 2] = length
            k += 1
        else:
            return -1, -1
        at += 9 + length
    return m, k
