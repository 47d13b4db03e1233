"""Components and dotted names, clock and records, numerics, units, errors, files."""

VERSION = "0.1.0"
