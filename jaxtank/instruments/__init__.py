"""Sensors and actuators: the roles, and the concrete ones of the papers' rigs.

Imports core; may be imported by every folder above.
"""

from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.base import Actuator, Sensor
from jaxtank.instruments.sensors import LevelSensor

__all__ = ["Actuator", "LevelSensor", "PumpBank", "Sensor"]
