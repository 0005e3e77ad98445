"""One module per format: its table of fields, its recognition by content, and a file for users without a template."""
