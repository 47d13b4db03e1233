"""Gain schedules: gains of any law as piecewise-linear functions of a setpoint or a level."""

from typing import Any, NamedTuple

import numpy as np

from jaxtank.controllers.base import Controller
from jaxtank.controllers.schedulable import check_gains, check_knots, check_variable, refusal
from jaxtank.core.clock import pointwise
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import portion
from jaxtank.core.tree import check_value, component, describe, leaf, parameters, static, with_values


class Memory(NamedTuple):
    """State of the law, and the operating variable of this sample [cm] where `track` cannot read it from the tick (a level); else ()."""

    law: Any
    at: Any


def interpolate(at, knots, values):
    """Piecewise-linear values of the operating variable, held outside the knots.

        g(s) = v_1 + sum_j (v_{j+1} - v_j)/(p_{j+1} - p_j) (min(max(s, p_j), p_{j+1}) - p_j)

    at: scalar [cm]; knots: (K,) increasing [cm]; values: (gains, K); returns a tuple of scalars, one per gain. Exactly v where all
    values of a gain are equal. On a knot the slopes are the means of those of both sides; a level that rests on a knot within rounding
    has those of the side it is on.
    """
    count, pieces = np.shape(values)[0], np.shape(knots)[0] - 1
    parts = [portion(at, knots[j], knots[j + 1]) for j in range(pieces)]
    slope = lambda i, j: (values[i, j + 1] - values[i, j]) / (knots[j + 1] - knots[j])
    return tuple(sum((slope(i, j) * parts[j] for j in range(pieces)), start=values[i, 0]) for i in range(count))


@component
class Scheduled(Controller):
    """A law whose `gains` follow an operating variable: linear between knots, constant outside them.

    gains: names of leaves of the law, "k" or an entry "Kc[0]", "K[0,1]". A scheduled leaf that is a number is absent (None) in `law`; of
    an array the scheduled entries are not used. variable: "r1", the setpoint of output 1, or "h2", the estimated level of tank 2,
    counted from 1 as on the rig. Build one with `jaxtank.scheduling.schedule`.

    A gain of which the law makes anything before the loop (`prepare`, `inputs`, `init`), or from which it designs matrices or runs a
    loop in `step` (weights of a Riccati equation or of a predictive law, the order of a fractional integral), is refused by `check`:
    the first would be left unscheduled, the second done anew at every sample. Inside a trace, where nothing is checked, the former
    ends in a run that is not finite: before the loop the law is given NaN for its scheduled gains.
    """

    law: Controller
    knots: np.ndarray = leaf("cm", "(K,) positions of the operating variable, increasing")
    values: np.ndarray = leaf("-", "(gains, K) each gain at each knot")
    gains: tuple = static(doc="leaves of the law that are scheduled, one per row of values")
    variable: str = static(doc="operating variable: r1, a setpoint, or h1, a level estimate, and so on, counted from 1")

    def _law(self, gains):
        return with_values(self.law, dict(zip(self.gains, gains)))

    def _blind(self):
        return self._law((np.nan,) * len(self.gains))

    def _law_at(self, at):
        return self._law(interpolate(at, self.knots, self.values))

    @property
    def _index(self):
        return int(self.variable[1:]) - 1

    @property
    def _on_setpoint(self):
        return self.variable.startswith("r")

    @property
    def allocates(self):
        return self.law.allocates

    @pointwise
    def prepare(self, r, dr, ddr):
        return self._blind().prepare(r, dr, ddr)

    @pointwise
    def inputs(self, clock):
        return self._blind().inputs(clock)

    def init(self, x0, u0):
        return Memory(law=self._blind().init(x0, u0), at=() if self._on_setpoint else x0[self._index])

    def step(self, state, tick, estimate):
        at = tick.r[self._index] if self._on_setpoint else estimate.x[self._index]
        command, inner = self._law_at(at).step(state.law, tick, estimate)
        return command, Memory(law=inner, at=state.at if self._on_setpoint else at)

    def track(self, state, tick, command, applied):
        at = tick.r[self._index] if self._on_setpoint else state.at
        return state._replace(law=self._law_at(at).track(state.law, tick, command, applied))

    def input_metric(self, estimate):
        # the setpoint is not told here: `check` refuses gains that would need it
        law = self._blind() if self._on_setpoint else self._law_at(estimate.x[self._index])
        return law.input_metric(estimate)

    def metadata_of(self, field):
        """What to change of a field's metadata: the values are in the units and ranges of their gains."""
        if field != "values":
            return {}
        rows = []
        for gain in self.gains:
            meta = describe(self.law, gain)
            rows.append({**meta, "doc": f"{meta['doc']}: controller.law.{gain} at a knot", "like": None})
        doc = f"(gains, K) each gain at each knot; a row each for {', '.join(self.gains)}"
        every = {"doc": doc, "unit": ", ".join(dict.fromkeys(m["unit"] for m in rows)), "rows": tuple(rows)}
        if rows and all(m["low"] == rows[0]["low"] and m["strict"] == rows[0]["strict"] for m in rows):
            every |= {"low": rows[0]["low"], "strict": rows[0]["strict"]}
        return every

    def check(self, reference):
        check_gains(self.law, self.gains)
        tanks = getattr(getattr(self.law, "model", None), "tanks", None)
        check_variable(self.variable, reference.channels, tanks)
        check_knots(self.knots)
        shape = (len(self.gains), np.shape(self.knots)[0])
        if np.shape(self.values) != shape:
            raise InputError(
                f"controller.values has shape {np.shape(self.values)}: must be {shape}, a row per gain, a column per knot"
            )
        for i, (gain, meta) in enumerate(zip(self.gains, self.metadata_of("values")["rows"])):
            if parameters(self.law).get(gain) is not None:
                raise InputError(f"controller.law.{gain} is scheduled: set controller.values[{i},0] and so on, one per knot")
            for j, value in enumerate(self.values[i]):
                check_value(f"controller.values[{i},{j}]", value, meta)
        for gain in self.gains:
            if why := refusal(self.law, self.gains, gain, self._on_setpoint, reference.channels):
                raise InputError(f"controller.law.{gain} cannot be scheduled: {why}")
        for column in np.asarray(self.values).T:
            self._law(column).check(reference)
