"""Errors a user of the simulator can cause: each message is one sentence, printed without a traceback."""


class FirmwareSimError(Exception):
    """Base of every error a user can cause."""


class ScenarioError(FirmwareSimError):
    """A scenario file that cannot be used; the message names the key."""


class ServerError(FirmwareSimError):
    """The UDP server cannot start: address in use, unknown host."""
