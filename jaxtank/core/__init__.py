"""Components and dotted names, clock and records, numerics, units, errors, files."""
