"""Experiment design: manoeuvres that narrow intervals or distinguish effects, by their expected information."""
