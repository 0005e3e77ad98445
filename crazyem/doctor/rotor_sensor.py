"""Check: a rotor speed sensor that counts half or drops to zero."""

from crazyem.recordings.finding import Finding
from crazyem.recordings.recording import Recording


def check(recording: Recording) -> list[Finding]:
    """Findings of this check."""
    return []
