"""Packing of log variables into blocks: 26 bytes per packet, 16 blocks, 128 variables."""

import difflib
import math
from collections.abc import Mapping, Sequence

from crazyem.errors import UsageError
from crazyem.signals.sample import CTYPE_SIZES, Block, Variable
from crazyem.signals.vocabulary import sampled_together

MAX_BYTES = 26  # log data of one packet: 30 bytes less block id and 24-bit stamp
MAX_BLOCKS = 16
MAX_VARIABLES = 128
PERIOD_UNIT_MS = 10  # START_BLOCK counts in 10 ms, in one byte
MAX_PERIOD_MS = 2540
HIGHEST_RATE = 1000.0  # Hz; the firmware's timers count milliseconds


def period_of(rate_hz: float) -> int:
    """Log period [ms] for a rate [Hz].

    A rate with a period of whole milliseconds gets this period. Other rates up to 100 Hz get a multiple of 10 ms (at
    most 2540), which every firmware supports; higher rates get whole milliseconds. Other periods than multiples of
    10 ms need a newer firmware (protocol 4 has only these). Raises UsageError outside 0.394..1000 Hz.
    """
    if not rate_hz > 0:
        raise UsageError(
            f"A log rate of {rate_hz:g} Hz makes no sense; choose 0.4 to 100 Hz, or up to {HIGHEST_RATE:g} Hz."
        )
    exact = 1000.0 / rate_hz
    whole = math.isfinite(exact) and abs(exact - round(exact)) < 1e-6
    unit = PERIOD_UNIT_MS if rate_hz <= 1000.0 / PERIOD_UNIT_MS and not whole else 1
    period = round(exact / unit) * unit
    if period < 1 or period > MAX_PERIOD_MS or rate_hz > HIGHEST_RATE:
        raise UsageError(f"The firmware logs at 0.4 to {HIGHEST_RATE:g} Hz, not {rate_hz:g} Hz.")
    return period


def pack(
    variables: Sequence[str],
    available: Mapping[str, str],
    period_ms: int,
    *,
    groups: Sequence[Sequence[str]] | None = None,
    first_identifier: int = 0,
    blocks_in_use: int = 0,
    variables_in_use: int = 0,
) -> tuple[Block, ...]:
    """Distribute variables over as few blocks as possible; groups stay together.

    A group is a set of variables that must be sampled at the same instant; it stays in one block unless it is larger
    than a packet. Groups and single variables are placed by size, the largest first, each into the first block with
    room (first-fit decreasing). The order within a block is the order of `variables`.

    Args:
        variables: names; repetitions are ignored.
        available: the drone's log variables: name -> C type.
        period_ms: period of every block, ms.
        groups: tuples of names to keep together; None = the components of each signal (`sampled_together`).
        first_identifier: identifier of the first block.
        blocks_in_use: blocks already in use on the drone.
        variables_in_use: variables already in these blocks.

    Raises: UsageError: a variable does not exist, or the variables do not fit.
    """
    wanted = list(dict.fromkeys(variables))
    for name in wanted:
        if name not in available:
            close = difflib.get_close_matches(name, list(available), n=1, cutoff=0.7)
            hint = f' (did you mean "{close[0]}"?)' if close else ""
            raise UsageError(f'The drone has no log variable "{name}"{hint}.')
        if available[name] not in CTYPE_SIZES:
            raise UsageError(f'The log variable "{name}" has type {available[name]}, which cannot be logged.')
    if variables_in_use + len(wanted) > MAX_VARIABLES:
        taken = f" ({variables_in_use} are in use already)" if variables_in_use else ""
        raise UsageError(f"{len(wanted)} variables do not fit: the firmware logs {MAX_VARIABLES} at once{taken}.")

    size = {name: CTYPE_SIZES[available[name]] for name in wanted}
    bins = _first_fit(_units(wanted, size, groups), size)
    if blocks_in_use + len(bins) > MAX_BLOCKS:
        taken = f", {blocks_in_use} of them in use already" if blocks_in_use else ""
        raise UsageError(
            f"{len(wanted)} variables ({sum(size.values())} bytes) need {len(bins)} log blocks; "
            f"the firmware has {MAX_BLOCKS}{taken}."
        )
    place = {name: i for i, name in enumerate(wanted)}
    ordered = sorted((sorted(names, key=place.__getitem__) for names in bins), key=lambda names: place[names[0]])
    return tuple(
        Block(first_identifier + i, tuple(Variable(n, available[n]) for n in names), period_ms)
        for i, names in enumerate(ordered)
    )


def _first_fit(units: Sequence[tuple[str, ...]], size: Mapping[str, int]) -> list[list[str]]:
    """Names of each block: units in decreasing size, each into the first block with room."""
    bins: list[list[str]] = []
    room: list[int] = []
    for unit in sorted(units, key=lambda names: -sum(size[n] for n in names)):
        need = sum(size[n] for n in unit)
        for i, free in enumerate(room):
            if need <= free:
                bins[i].extend(unit)
                room[i] -= need
                break
        else:
            bins.append(list(unit))
            room.append(MAX_BYTES - need)
    return bins


def _units(
    wanted: Sequence[str], size: Mapping[str, int], groups: Sequence[Sequence[str]] | None
) -> list[tuple[str, ...]]:
    """Disjoint sets to place as a whole: the groups (without variables of earlier groups), then single variables."""
    units: list[tuple[str, ...]] = []
    taken: set[str] = set()
    for group in sampled_together(wanted) if groups is None else groups:
        names = tuple(n for n in dict.fromkeys(group) if n in size and n not in taken)
        if not names:
            continue
        taken.update(names)
        if sum(size[n] for n in names) <= MAX_BYTES:
            units.append(names)
        else:  # larger than a packet: cannot be sampled together
            units.extend((n,) for n in names)
    units.extend((n,) for n in wanted if n not in taken)
    return units
