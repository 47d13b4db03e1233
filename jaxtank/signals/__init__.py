"""References and disturbances as functions of time, sampled before the time loop starts."""

from jaxtank.signals.base import Constant, Signal, Sum, Table
from jaxtank.signals.inflows import InflowPulses, InflowTable, inflow_pulses, inflow_table
from jaxtank.signals.setpoints import Ramps, Sine, ramps

__all__ = [
    "Constant",
    "InflowPulses",
    "InflowTable",
    "Ramps",
    "Signal",
    "Sine",
    "Sum",
    "Table",
    "inflow_pulses",
    "inflow_table",
    "ramps",
]
