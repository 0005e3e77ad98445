"""Port 15, the link: echo (pings), source (how cflib recognises a Crazyflie) and sink."""

ECHO, SOURCE = 0, 1
# cflib compares the first 18 bytes; anything else makes it fall back to a protocol without version.
IDENTITY = b"Bitcraze Crazyflie".ljust(30, b"\0")


def handle(channel: int, data: bytes) -> list[tuple[int, bytes]]:
    """Replies (channel, data) to a packet on the link port."""
    if channel == ECHO:
        return [(ECHO, data)]
    if channel == SOURCE:
        return [(SOURCE, IDENTITY)]
    return []
