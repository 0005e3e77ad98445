"""One file per command: each takes parsed arguments, does the work, returns an exit code."""
