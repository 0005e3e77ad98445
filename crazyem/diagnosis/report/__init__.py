"""The report of a diagnosis: one self-contained HTML file that is read in two minutes."""

from crazyem.diagnosis.report.html import write_report
from crazyem.diagnosis.report.pictures import Series

__all__ = ["Series", "write_report"]
