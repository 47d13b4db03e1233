"""Observers: what the law believes the levels are."""

from jaxtank.observers.base import Direct, Observer

__all__ = ["Direct", "Observer"]
