"""Our own recordings (MCAP); the reader arrives with the writer."""

from pathlib import Path

from crazyem.recordings.recording import Recording


def recognises(head: bytes) -> bool:
    return False


def read(path: Path) -> Recording:
    raise NotImplementedError
