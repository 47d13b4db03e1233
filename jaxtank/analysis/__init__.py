"""Steady states, linear models, Riccati equations and quadratic programmes."""

from jaxtank.analysis.linear_model import (
    linearise,
    relative_gain_array,
    steady_gain,
    transmission_zeros,
    zero_direction,
)
from jaxtank.analysis.steady_state import equilibrium, steady_along, steady_flows, steady_levels

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
