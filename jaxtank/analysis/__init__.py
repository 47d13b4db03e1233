"""Steady states, linear models, Riccati equations and quadratic programmes of a rig, before it is
run.
"""

from jaxtank.analysis.steady_state import (
    equilibrium,
    linearise,
    relative_gain_array,
    steady_along,
    steady_flows,
    steady_gain,
    steady_levels,
    transmission_zeros,
    zero_direction,
)

__all__ = [
    "equilibrium",
    "linearise",
    "relative_gain_array",
    "steady_along",
    "steady_flows",
    "steady_gain",
    "steady_levels",
    "transmission_zeros",
    "zero_direction",
]
