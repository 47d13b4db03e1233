"""The report of a tuning result."""
