"""Errors a user can cause: one family, one-sentence messages, an exit code each; the command line prints and exits."""


class CrazyemError(Exception):
    """Base of every error whose message is meant for the user (one sentence, no traceback)."""

    exit_code = 1


class UsageError(CrazyemError):
    """An argument or a name that does not exist or does not fit."""

    exit_code = 2


class FileFormatError(CrazyemError):
    """A vehicle, scenario, mapping or recording file that cannot be used; names the file and the key or place."""

    exit_code = 3


class KnownFileError(FileFormatError):
    """A file that is known not to be a recording, but to stand for one: what it is and what to do."""


class LinkError(CrazyemError):
    """No drone, a drone lost, a reply that never came."""

    exit_code = 4


class DataError(CrazyemError):
    """Signals that cannot be estimated from: NaN, wrong units, nothing flown."""

    exit_code = 5
