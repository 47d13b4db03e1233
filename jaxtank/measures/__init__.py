"""Numbers that describe a run, accumulated in the time loop: memory does not grow with its length."""

from jaxtank.measures.accumulators import Run
from jaxtank.measures.catalogue import (
    MEASURES,
    SQUARES,
    TIMES,
    check_names,
    entries,
    needs,
    placed,
    read,
    residual_weights,
    residuals,
    serves,
    start,
    unit,
    update,
    wants_pours,
    wants_rests,
    wants_windows,
)

__all__ = [
    "MEASURES",
    "SQUARES",
    "TIMES",
    "Run",
    "check_names",
    "entries",
    "needs",
    "placed",
    "read",
    "residual_weights",
    "residuals",
    "serves",
    "start",
    "unit",
    "update",
    "wants_pours",
    "wants_rests",
    "wants_windows",
]
