"""Numbers that describe a run, accumulated in the time loop: memory does not grow with its length.

`catalogue` holds the measures, `accumulators` their state in the time loop, `registry` what is
known of them by name and what the loop calls, `functions` those that are a function of a whole run.
"""

from jaxtank.measures.accumulators import ACCUMULATORS, Accumulator, Context, Run, Worst
from jaxtank.measures.catalogue import MEASURES, TRACKED, Measure, label
from jaxtank.measures.functions import RunFunction, from_function, functions, name_of
from jaxtank.measures.registry import (
    check_names,
    entries,
    entry_units,
    linear,
    needs,
    of_loop,
    placed,
    read,
    refers_to,
    register,
    reported,
    residual_weights,
    residuals,
    serves,
    squares,
    start,
    times,
    unit,
    unreadable,
    update,
)

__all__ = [
    "ACCUMULATORS",
    "MEASURES",
    "TRACKED",
    "Accumulator",
    "Context",
    "Measure",
    "Run",
    "RunFunction",
    "Worst",
    "check_names",
    "entries",
    "entry_units",
    "from_function",
    "functions",
    "label",
    "linear",
    "name_of",
    "needs",
    "of_loop",
    "placed",
    "read",
    "refers_to",
    "register",
    "reported",
    "residual_weights",
    "residuals",
    "serves",
    "squares",
    "start",
    "times",
    "unit",
    "unreadable",
    "update",
]
