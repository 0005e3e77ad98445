"""Our own files: MCAP, written while flying, read whole, in parts or as far as damage allows."""
