"""Observers: what the law believes the levels are."""

from jaxtank.observers.base import Direct, Observer
from jaxtank.observers.disturbance import DisturbanceObserver
from jaxtank.observers.kalman import ExtendedKalman, Kalman

__all__ = ["Direct", "DisturbanceObserver", "ExtendedKalman", "Kalman", "Observer"]
