"""CSV files: any through a mapping, cfclient's, and our own exports."""
