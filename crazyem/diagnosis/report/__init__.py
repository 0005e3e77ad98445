"""The report of a diagnosis: one self-contained HTML file that is read in two minutes."""

from crazyem.diagnosis.report.html import Series, write_report

__all__ = ["Series", "write_report"]
