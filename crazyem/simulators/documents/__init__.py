"""Text files that are edited in place: one number changes, every other byte stays."""
