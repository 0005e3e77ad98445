"""Runs every check over a recording: the list of checks is here, each check is a file of its own in this folder."""

import importlib
from dataclasses import dataclass

from crazyem.recordings.finding import Finding, Grade
from crazyem.recordings.recording import Recording

_RANK = {Grade.UNUSABLE: 0, Grade.DEGRADES: 1, Grade.HARMLESS: 2}


@dataclass(frozen=True, slots=True)
class Check:
    """A check: module `crazyem.doctor.<module>` with `check(recording: Recording) -> list[Finding]`.

    Checks read and never change the recording, skip what is not in it, and cost at most a few seconds and some copies
    of one signal for a recording of 600 000 samples.
    """

    module: str
    title: str

    def run(self, recording: Recording) -> list[Finding]:
        module = importlib.import_module(f"crazyem.doctor.{self.module}")
        return list(module.check(recording))


CHECKS: tuple[Check, ...] = ()


def examine(recording: Recording) -> tuple[Finding, ...]:
    """Everything odd about a recording, what its reader noticed first, the worst first within each."""
    found = [finding for check in CHECKS for finding in check.run(recording)]
    return (*sorted(recording.findings, key=_rank), *sorted(found, key=_rank))


def _rank(finding: Finding) -> int:
    return _RANK[finding.grade]
