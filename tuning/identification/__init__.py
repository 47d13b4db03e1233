"""Plant parameters from experiment data, with intervals, and which experiment to make."""
