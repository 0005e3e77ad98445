"""Which effects a drone lacks, by one posterior over sets of effects (docs/explanation/diagnosis.md)."""
