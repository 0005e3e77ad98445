"""Experiments: manoeuvres that narrow intervals or tell explanations apart, by the information that is expected."""
