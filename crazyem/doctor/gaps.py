"""Check: gaps and dropped records."""

from crazyem.recordings.finding import Finding
from crazyem.recordings.recording import Recording


def check(recording: Recording) -> list[Finding]:
    """Findings of this check."""
    return []
