"""From recorded log packets to signals: what a reader of any packet-based format needs."""

import math
from collections.abc import Iterable, Iterator

from crazyem.recordings.recording import SignalArray, collect
from crazyem.signals.packet import Block, Packet
from crazyem.signals.sample import Sample
from crazyem.signals.vocabulary import decoders


def signals_from_packets(
    blocks: Iterable[Block], items: Iterable[Packet | Sample], *, skip: frozenset[str] = frozenset()
) -> dict[str, SignalArray]:
    """Decode packets as the live loop does; ready-made samples among them keep their place.

    A NaN that decoding makes of a valid packet (a rotor speed of 65535 means "missing") is marked as ours.

    Args:
        blocks: the block table.
        items: packets and samples in processing order.
        skip: signals not to decode from packets.
    """
    table = decoders(blocks)

    def decoded() -> Iterator[tuple[Sample, bool]]:
        for item in items:
            if isinstance(item, Sample):
                yield item, False
                continue
            decoder = table.get(item.block)
            if decoder is None:
                continue
            sound = not any(map(math.isnan, item.values))
            for sample in decoder.decode(item):
                if sample.signal not in skip:
                    yield sample, sound and any(map(math.isnan, sample.value))

    return collect(decoded())
