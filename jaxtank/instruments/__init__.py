"""Sensors and actuators: the roles, and the concrete ones of the papers' rigs."""

from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.base import Actuator, Sensor
from jaxtank.instruments.sensors import LevelSensor

__all__ = ["Actuator", "LevelSensor", "PumpBank", "Sensor"]
