"""A case as a live page: its closed loop as JavaScript, and the page around it."""

from tuning.live.engine import describe, engine

__all__ = ["describe", "engine"]
