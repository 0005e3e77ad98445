"""The likelihood of flights under a model, its derivatives by any parameters, and fits of all of them together."""
