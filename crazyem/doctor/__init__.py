"""The doctor: what is wrong with a recording, found from its numbers; one file a check, and the lossless repairs."""

from crazyem.doctor.examine import CHECKS, Check, examine
from crazyem.recordings.finding import Finding, Fix, Grade

__all__ = ["CHECKS", "Check", "Finding", "Fix", "Grade", "examine"]
