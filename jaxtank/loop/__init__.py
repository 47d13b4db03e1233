"""The closed loop: one sample, a whole run, its derivatives, and the checks before it."""
