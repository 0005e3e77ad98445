"""Diagnosis: where simulation and recording part, which physics was left out, and the fit that follows.

flight (arrays) -> kernel (innovations, score, information) -> candidates and selection -> refit -> report.
"""
