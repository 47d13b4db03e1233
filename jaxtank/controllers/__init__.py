"""Controllers: from setpoint and estimate to pump voltages."""

from jaxtank.controllers.backstepping import Backstepping
from jaxtank.controllers.base import Controller
from jaxtank.controllers.cascade import Cascade, FlowCascade
from jaxtank.controllers.enmpc import ENMPC
from jaxtank.controllers.fuzzy import FuzzyBlend
from jaxtank.controllers.gain_schedule import Scheduled
from jaxtank.controllers.gpc import GPC
from jaxtank.controllers.laguerre import Laguerre
from jaxtank.controllers.ngpc import NGPC
from jaxtank.controllers.nmpc import NMPC
from jaxtank.controllers.on_off import OnOff
from jaxtank.controllers.open_loop import OpenLoop
from jaxtank.controllers.override import Override
from jaxtank.controllers.pid import PID
from jaxtank.controllers.ratio import Ratio
from jaxtank.controllers.reference_governor import ReferenceGovernor
from jaxtank.controllers.sliding_mode import SlidingMode
from jaxtank.controllers.split_range import SplitRange
from jaxtank.controllers.state_feedback import LQI, StateFeedback
from jaxtank.controllers.two_tank_backstepping import TwoTankBackstepping

__all__ = [
    "ENMPC",
    "GPC",
    "LQI",
    "NGPC",
    "NMPC",
    "PID",
    "Backstepping",
    "Cascade",
    "Controller",
    "FlowCascade",
    "FuzzyBlend",
    "Laguerre",
    "OnOff",
    "OpenLoop",
    "Override",
    "Ratio",
    "ReferenceGovernor",
    "Scheduled",
    "SlidingMode",
    "SplitRange",
    "StateFeedback",
    "TwoTankBackstepping",
]
