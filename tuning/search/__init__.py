"""The tuner: starts, local methods, verdicts, discrete choices, robust tuning, trade-offs."""
