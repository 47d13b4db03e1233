"""Plants: what moves. `TankNetwork` serves every rig; a named rig is a function that builds one."""

from jaxtank.plants.base import Plant
from jaxtank.plants.network import TankNetwork, state_coupled_four_tank

__all__ = ["Plant", "TankNetwork", "state_coupled_four_tank"]
