"""Check: values that are no numbers or cannot be."""

from crazyem.recordings.finding import Finding
from crazyem.recordings.recording import Recording


def check(recording: Recording) -> list[Finding]:
    """Findings of this check."""
    return []
