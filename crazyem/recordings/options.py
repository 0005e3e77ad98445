"""What a user may have to tell a reader, because the file does not."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """What a user may have to tell a reader.

    Attributes:
        mapping: TOML file that says which columns of a CSV are which signals (`--map`); None: by the header.
        motor: what motor.m1..4 of an old log is where the file holds no evidence (`--motor`): "duty" (PWM sent, after
            battery compensation) or "request" (thrust asked for, before it); None: say that it is not known.
        start, end: read only what was sampled between these times [s] of the recording's time axis (`--from`, `--to`);
            None: no limit.
        as_published: believe a preset's publisher instead of correcting what is known to be wrong (`--as-published`).
    """

    mapping: str | None = None
    motor: str | None = None
    as_published: bool = False
    start: float | None = None
    end: float | None = None
