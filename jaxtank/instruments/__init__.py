"""Sensors and actuators: what stands between the computer and the rig."""

from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.base import Actuator, Sensor
from jaxtank.instruments.sensors import LevelSensor

__all__ = ["Actuator", "LevelSensor", "PumpBank", "Sensor"]
