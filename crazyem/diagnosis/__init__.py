"""Diagnosis: where simulation and recording differ, which physics is missing, and the fit with this physics.

flights (arrays) -> fitting (innovations, score, information) -> locating (where) -> naming (which physics) -> report;
prediction is the open loop. `diagnose.py` runs all of them.
"""
