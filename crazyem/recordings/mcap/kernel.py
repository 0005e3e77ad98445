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
def count(data, counts):
    """Write the numbers of messages and other records to `counts`; returns -1 if a record is not valid in a chunk."""
    at = 0
    size = data.size
    while at < size:
        if size - at < 9:
            return -1
        opcode = data[at]
        length = _number(data, at + 1, 8)
        if length < 0 or length > size - at - 9:
            return -1
        if opcode == 5:
            if length < 22:
                return -1
            counts[0] += 1
        elif opcode in (3, 4):
            counts[1] += 1
        else:
            return -1
        at += 9 + length
    return 0


@compiled
def fill(data, messages, others):
    """Fill the tables of `Scan`; `count` must have accepted the data."""
    at = 0
    m = 0
    k = 0
    while at < data.size:
        length = _number(data, at + 1, 8)
        if data[at] == 5:
            messages[m, 0] = at + 31
            messages[m, 1] = length - 22
            messages[m, 2] = _number(data, at + 9, 2)
            messages[m, 3] = _number(data, at + 15, 8)
            messages[m, 4] = _number(data, at + 23, 8)
            messages[m, 5] = _number(data, at + 11, 4)
            m += 1
        else:
            others[k, 0] = data[at]
            others[k, 1] = at + 9
            others[k, 2] = length
            k += 1
        at += 9 + length


@compiled
def gather(data, offsets, rows):
    """Copy the bytes from each offset to a row; the length of a row is their number."""
    for i in range(offsets.size):
        for j in range(rows.shape[1]):
            rows[i, j] = data[offsets[i] + j]
