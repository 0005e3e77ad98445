"""Log packets as a firmware sends them: raw values of a block of variables, all sampled at one firmware time."""

from dataclasses import dataclass

# C type -> bytes on the wire, for every type a log variable can have (cflib's names).
CTYPE_SIZES: dict[str, int] = {
    "uint8_t": 1,
    "uint16_t": 2,
    "uint32_t": 4,
    "int8_t": 1,
    "int16_t": 2,
    "int32_t": 4,
    "FP16": 2,
    "float": 4,
}


@dataclass(frozen=True, slots=True)
class Variable:
    """A log variable: `group.name` and its storage type (uint8_t, int16_t, float, ...)."""

    name: str
    ctype: str


@dataclass(frozen=True, slots=True)
class Block:
    """Variables that travel in one packet, all sampled at the same firmware time."""

    identifier: int
    variables: tuple[Variable, ...]
    period_ms: int


@dataclass(frozen=True, slots=True)
class Packet:
    """One log packet: raw firmware values (firmware units) in the order of the block's variables.

    Attributes:
        block: identifier of the block.
        firmware_time_ms: firmware clock, ms, unwrapped from its 24 bits.
        host_time: s since the epoch when the host received it.
        values: one number per variable.
    """

    block: int
    firmware_time_ms: int
    host_time: float
    values: tuple[float, ...]
