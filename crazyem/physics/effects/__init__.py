"""Effects: what a real drone adds to the rigid body, one file each; `catalogue.py` lists them."""
