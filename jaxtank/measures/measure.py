"""What is known of a measure: the fields of its entry in the catalogue."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtank.measures.accumulators import Run


class Measure(NamedTuple):
    """A named number or list, and all that reports, limits and searches need to know of it.

    `jaxtank.measures.register` adds one of a user's own.

    Examples
    --------
    >>> from jaxtank.measures import MEASURES
    >>> MEASURES["max_level"].unit, MEASURES["max_level"].per, MEASURES["min_level"].sense
    ('cm', 'tank', -1.0)
    """

    unit: str  # with "cm" standing for the rig's length unit and "V" for that of its inputs
    per: str  # "run", "output", "tank" or "pump"
    needs: tuple[str, ...]  # names of accumulators
    read: Callable[[Run, dict[str, Any]], Any]  # (run, {accumulator: state}) -> scalar or array
    doc: str
    residual: str = ""  # the accumulator of squares that it is a multiple of, if it is one
    scale: Callable[[Run], Any] | None = None  # run -> factor of that sum
    low: float | None = 0.0  # least and largest value that it can have, None where there is none
    high: float | None = None
    sense: float = 1.0  # +1 where a larger value is worse (limits are upper ones), -1 a smaller
    counts: bool = False  # counts whole samples: a step function of the parameters, no derivative
    by_input: bool = False  # a sum over the run with a slope in every input: `bound` minimises it
    shown: int = 0  # its place in the table of a tuning result; 0: not in it
    summary: int = 0  # its place in an ensemble's summary unless others are named; 0: not in it
    reached: str = ""  # the measure that holds the time at which this one was reached
    undefined: str = "the value is not a finite number"  # why a run has no value of it
    worst: str = ""  # why it is infinite on the side that is worse; "": as `undefined`
    unlimited: str = ""  # why it is infinite on the side that is better; "": as `undefined`
    unserved: str = ""  # why a case has none, reported where it is not computed
    nan_holds: str = ""  # what NaN means where a limit holds with it; "": NaN breaks a limit
    linear: bool = False  # of the linearised loop (`Run.margins`): computed where it is named only
    arrays: bool = False  # whether `read` takes states of either form; else of tuples of scalars

    def cause(self, value: float) -> str:
        """Return why a value is not a finite number.

        Examples
        --------
        >>> from jaxtank.measures import MEASURES
        >>> MEASURES["settling_time"].cause(float("nan"))
        'no change of its setpoint took the output out of its band'
        """
        if math.isnan(value):
            return self.nan_holds or self.undefined
        return (self.worst if value * self.sense > 0.0 else self.unlimited) or self.undefined
