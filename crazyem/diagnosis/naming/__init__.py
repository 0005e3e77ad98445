"""Which physics was left out: effects tried, compared and doubted, and told with what would tell them apart."""
