"""What a user of the relay can get wrong: one sentence each, printed without a traceback."""

from firmware_sim.errors import FirmwareSimError


class RelayError(FirmwareSimError):
    """A schedule, an option or an address that cannot be used."""
