"""Port 0, the console: text of the firmware, at most 30 bytes a packet, never splitting a multi-byte character."""

from firmware_sim.wire import MAX_DATA


def text_chunks(text: str) -> list[bytes]:
    """The text as packet payloads, in order; each decodes as UTF-8 on its own."""
    chunks: list[bytes] = []
    current = b""
    for character in text:
        encoded = character.encode()
        if len(current) + len(encoded) > MAX_DATA:
            chunks.append(current)
            current = b""
        current += encoded
    return [*chunks, current] if current else chunks
