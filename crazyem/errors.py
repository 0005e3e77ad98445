"""Errors that a user can cause: one base class, one-sentence messages, an exit code each."""


class CrazyemError(Exception):
    """Base of every error whose message is meant for the user (one sentence, no traceback)."""

    exit_code = 1


class UsageError(CrazyemError):
    """An argument or a name that does not exist or does not fit."""

    exit_code = 2


class FileFormatError(CrazyemError):
    """A vehicle, scenario, mapping or recording file cannot be used; the message names file and key or place."""

    exit_code = 3


class KnownFileError(FileFormatError):
    """A file of a known kind that is no recording; the message says what the file is and what to do."""


class LinkError(CrazyemError):
    """No drone, a lost drone, or a missing reply."""

    exit_code = 4


class DataError(CrazyemError):
    """Signals that are unusable for an estimate: NaN, wrong units, no flight."""

    exit_code = 5
