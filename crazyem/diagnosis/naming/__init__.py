"""Search for the effects that a model lacks: fit, comparison, doubts, and advice on how to separate look-alikes."""
