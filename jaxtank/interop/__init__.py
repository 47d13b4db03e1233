"""Conversion to other libraries: python-control, Gymnasium, pandas and xarray, for users."""
