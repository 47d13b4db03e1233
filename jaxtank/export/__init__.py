"""A controller and its observer as source code without dependencies: C99, MATLAB, or your own."""

from jaxtank.export.source import Language, export, register

__all__ = ["Language", "export", "register"]
