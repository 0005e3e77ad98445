"""Errors a user of the simulator can cause: each message is one sentence, printed without a traceback."""

from typing import Any


class FirmwareSimError(Exception):
    """Base of every error a user can cause."""


class ScenarioError(FirmwareSimError):
    """A scenario file that cannot be used; the message names the key."""


class ServerError(FirmwareSimError):
    """The UDP server cannot start: address in use, unknown host."""


def checked_number(value: Any, where: str, low: float, high: float, unit: str = "") -> float:
    """The value of a file as a float. Raises ScenarioError naming `where`: no number, or not from low to high."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ScenarioError(f"{where} must be a number, not {value!r}")
    if not low <= value <= high:
        raise ScenarioError(f"{where} must lie between {low:g} and {high:g} {unit}".rstrip() + f", not {value!r}")
    return float(value)
