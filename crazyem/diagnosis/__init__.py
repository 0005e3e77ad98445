"""Diagnosis: where simulation and recording part, which physics was left out, and the fit that follows.

flights (arrays) -> fitting (innovations, score, information) -> locating (where) -> naming (which physics) -> report;
prediction is the open loop beside it. `diagnose.py` runs them.
"""
