"""Observers: from measurements to the estimate that the controller receives."""

from jaxtank.observers.base import Direct, Observer
from jaxtank.observers.disturbance import DisturbanceObserver
from jaxtank.observers.extended_kalman import ExtendedKalman, UnscentedKalman
from jaxtank.observers.fault_bank import FaultBank
from jaxtank.observers.kalman import Kalman
from jaxtank.observers.moving_horizon import MovingHorizon

__all__ = [
    "Direct",
    "DisturbanceObserver",
    "ExtendedKalman",
    "FaultBank",
    "Kalman",
    "MovingHorizon",
    "Observer",
    "UnscentedKalman",
]
