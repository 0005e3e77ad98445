"""Open loop: where the model says a drone goes from a recorded state and recorded inputs, and how far it is off."""
