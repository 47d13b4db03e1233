"""Attack on limits: the plant, start and reading errors of a box that drive levels highest."""
