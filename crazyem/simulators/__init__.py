"""Files of other simulators: read, written in place, checked by flights, and sampled."""
