"""`jaxtank bench`: the time of a closed-loop step here beside a C loop of the same arithmetic."""
