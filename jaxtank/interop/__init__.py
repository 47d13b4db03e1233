"""Conversion to other libraries: python-control, Gymnasium, pandas and xarray, for users."""

from jaxtank.core import lazy

__getattr__, __all__ = lazy.attach(__name__, __file__)
