"""A controller and its observer, or a plant, as C99, Structured Text, MATLAB, JavaScript or FMU."""

from jaxtank.export.source import Language, export, register

__all__ = ["Language", "export", "register"]
