"""Observers: what the law believes the levels are."""

from jaxtank.observers.base import Direct, Observer
from jaxtank.observers.disturbance import DisturbanceObserver

__all__ = ["DisturbanceObserver", "Direct", "Observer"]
