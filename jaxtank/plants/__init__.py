"""Plants: vector fields of levels. `TankNetwork` serves every rig; a named rig is a function that
builds one.
"""

from jaxtank.plants.base import Plant
from jaxtank.plants.faults import Faults
from jaxtank.plants.network import network
from jaxtank.plants.rigs import coupled_tanks, quadruple_tank, state_coupled_four_tank
from jaxtank.plants.tank_network import TankNetwork

__all__ = [
    "Faults",
    "Plant",
    "TankNetwork",
    "coupled_tanks",
    "network",
    "quadruple_tank",
    "state_coupled_four_tank",
]
