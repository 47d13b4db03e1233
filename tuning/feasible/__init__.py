"""Whether the setpoints of a case can be held by any controller, and what would make it so."""
