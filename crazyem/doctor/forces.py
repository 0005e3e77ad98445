"""Check: specific force and acceleration against the velocity's derivative: unit, frame, scale."""

from crazyem.recordings.finding import Finding
from crazyem.recordings.recording import Recording


def check(recording: Recording) -> list[Finding]:
    """Findings of this check."""
    return []
