"""Reports of studies of many runs: uncertainty and sensitivity."""
