"""Effects: differences between a real drone and the rigid body, grouped by modules; `catalogue.py` lists them."""
