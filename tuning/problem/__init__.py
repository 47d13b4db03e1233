"""The optimisation problem of a search: cost, constraints, bounds, scenarios."""
