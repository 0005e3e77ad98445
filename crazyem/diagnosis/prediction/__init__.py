"""Open loop: predictions of a model from a recorded state and recorded inputs, and their errors."""
