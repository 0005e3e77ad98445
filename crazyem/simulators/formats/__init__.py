"""One file a format: its table of fields, how it is told by content, and a file for those who have none."""
