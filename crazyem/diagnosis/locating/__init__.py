"""Differences of a flight from a model: which force, torque or sensor, when, and in which regime."""
