"""What a search minimises and what must hold: bounds, limits, scenarios."""
