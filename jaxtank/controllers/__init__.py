"""Laws: from setpoint and estimate to pump voltages."""

from jaxtank.controllers.backstepping import Backstepping
from jaxtank.controllers.base import Controller
from jaxtank.controllers.ngpc import NGPC

__all__ = ["NGPC", "Backstepping", "Controller"]
