"""A controller and its observer as source code without dependencies: C99 or MATLAB."""

from jaxtank.export.source import export

__all__ = ["export"]
