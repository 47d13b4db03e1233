"""Plants: what moves. `TankNetwork` serves every rig; a named rig is a function that builds one."""

from jaxtank.plants.base import Plant
from jaxtank.plants.faults import Faults
from jaxtank.plants.network import TankNetwork, network
from jaxtank.plants.rigs import coupled_tanks, quadruple_tank, state_coupled_four_tank

__all__ = [
    "Faults",
    "Plant",
    "TankNetwork",
    "coupled_tanks",
    "network",
    "quadruple_tank",
    "state_coupled_four_tank",
]
