"""Gain schedules: gains of any law as piecewise-linear functions of a setpoint or a level."""

import functools
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.controllers.base import Controller
from jaxtank.core.checks import check_value
from jaxtank.core.clock import Clock, pointwise
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.numerics import portion
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import component, describe, get_value, leaf, parameters, static, with_values
from jaxtank.signals.base import Signal
from jaxtank.xla.reachability import use_of

VARIABLE = re.compile(r"[rh][1-9]\d*")


def check_gains(law, gains):
    """Raise InputError unless each of `gains` names a number among the leaves of `law`, once."""
    if not gains:
        raise InputError("a schedule needs at least one gain")
    names = [n for n in parameters(law)]
    for gain in gains:
        if gains.count(gain) > 1:
            raise InputError(f"gain {gain} is scheduled twice")
        try:
            meta = describe(law, gain)
        except InputError:
            raise unknown(
                "gain", f"controller.{gain}", [f"controller.{n}" for n in names]
            ) from None
        if meta["kind"] == "static":
            raise InputError(
                f"gain controller.{gain}: cannot be scheduled, it is part of the compiled program"
                " and not a number"
            )
        if gain not in names and "[" not in gain:
            continue  # absent because it is scheduled
        if np.ndim(get_value(law, gain)):
            raise InputError(
                f"gain controller.{gain} has shape {np.shape(get_value(law, gain))}: name its"
                f" entries, as {gain}[0]"
            )


def check_variable(variable, outputs, tanks):
    """Raise InputError unless `variable` is a setpoint of one of `outputs` or a level of one of
    `tanks` (None: not known).
    """
    good = isinstance(variable, str) and VARIABLE.fullmatch(variable)
    most = (outputs if variable[0] == "r" else tanks) if good else 0
    if not good or (most is not None and int(variable[1:]) > most):
        levels = "" if tanks is None else f", or h1 to h{tanks}, the level of a tank"
        raise InputError(
            f"schedule variable {variable!r} does not exist: must be r1 to r{outputs}, the setpoint"
            f" of an output{levels}"
        )


def check_knots(knots):
    """Raise InputError unless there are at least two knots, finite and increasing."""
    p = np.asarray(knots, dtype=float)
    if p.ndim != 1 or p.size < 2 or not np.all(np.isfinite(p)) or not np.all(np.diff(p) > 0):
        raise InputError(
            f"schedule knots {p.tolist()}: must be at least two finite numbers, each above the one"
            " before"
        )


def refusal(law, gains, gain, on_setpoint, channels):
    """Why `gain` cannot be scheduled together with the other `gains`, or None; read from the law's
    traced methods, not from its values.

    law: with absent (None) gains or without; on_setpoint: the operating variable is a setpoint;
        channels: of the reference.
    """
    leaves, structure = jax.tree.flatten(law)
    return _refusal(
        structure, tuple(np.shape(v) for v in leaves), gains, gain, on_setpoint, channels
    )


# a check of a loop comes before every run, and the answer depends on no value
@functools.lru_cache(maxsize=256)
def _refusal(structure, shapes, gains, gain, on_setpoint, channels):
    number, samples = jax.ShapeDtypeStruct((), jnp.result_type(float)), 3
    leaves = [jax.ShapeDtypeStruct(s, number.dtype) for s in shapes]
    empty = jax.tree.unflatten(structure, leaves)
    model = getattr(empty, "model", None)
    tanks, pumps = (channels, channels) if model is None else (model.tanks, model.pumps)
    others = [g for g in gains if g != gain]

    def with_gains(value, rest, leaves):
        law = jax.tree.unflatten(structure, leaves)
        return with_values(law, {gain: value, **dict(zip(others, rest))})

    def method(name, *args, **fixed):
        """The use of the gain in one method, and the shapes of what it returns."""
        f = lambda value, rest, leaves, *args: getattr(with_gains(value, rest, leaves), name)(
            *args, **fixed
        )
        arguments = (number, (number,) * len(others), leaves, *args)
        return use_of(f, *arguments), jax.eval_shape(f, *arguments)

    along = (jax.ShapeDtypeStruct((samples,), number.dtype),) * channels
    x, u = (number,) * tanks, (number,) * pumps
    estimate, r = Estimate(x=x, d=x), (number,) * channels
    try:
        before = {
            "prepare": method("prepare", along, along, along),
            "inputs": method("inputs", clock=Clock(dt=1.0, duration=samples - 1.0)),
            "init": method("init", x, u),
        }
        for name, (use, _) in before.items():
            if use.reached:
                return f"the law uses it before the loop starts (in its {name})"
        if on_setpoint and empty.allocates and method("input_metric", estimate)[0].reached:
            return (
                "the law's input_metric uses it, which is not told the setpoint: schedule it on a"
                " level"
            )
        plan, own, state = (found for _, found in before.values())
        row = lambda tree: jax.tree.map(lambda v: jax.ShapeDtypeStruct(v.shape[1:], v.dtype), tree)
        tick = Tick(t=number, r=r, dr=r, ddr=r, dt=number, plan=row(plan), own=row(own))
        step, (command, state) = method("step", state, tick, estimate)
        track, _ = method("track", state, tick, command, u)
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError):
        return "the law decides on its value with Python's if, which a schedule cannot follow"
    own_size = int(np.prod(np.shape(parameters(empty).get(gain.split("[")[0], 0.0)), dtype=int))
    if step.looped or track.looped or max(step.largest, track.largest) > own_size:
        return (
            "the law designs with it (matrices, or a loop of its own), which would be done anew at"
            " every sample"
        )
    if not (step.reached or track.reached):
        return "the law does not use it"
    return None


class Memory(NamedTuple):
    """State of the law, and the operating variable of this sample [cm] where `track` cannot read it
    from the tick (a level); else ().
    """

    law: Any
    at: Any


def interpolate(at, knots, values):
    """Piecewise-linear values of the operating variable, held outside the knots.

        g(s) = v_1 + sum_j (v_{j+1} - v_j)/(p_{j+1} - p_j) (min(max(s, p_j), p_{j+1}) - p_j)

    at: scalar [cm]; knots: (K,) increasing [cm]; values: (gains, K); returns a tuple of scalars,
    one per gain. Exactly v where all values of a gain are equal. On a knot the slopes are the means
    of those of both sides; a level that rests on a knot within rounding has those of the side it is
    on.
    """
    count, pieces = np.shape(values)[0], np.shape(knots)[0] - 1
    parts = [portion(at, knots[j], knots[j + 1]) for j in range(pieces)]
    slope = lambda i, j: (values[i, j + 1] - values[i, j]) / (knots[j + 1] - knots[j])
    return tuple(
        sum((slope(i, j) * parts[j] for j in range(pieces)), start=values[i, 0])
        for i in range(count)
    )


@component
class Scheduled(Controller):
    """A law whose `gains` follow an operating variable: linear between knots, constant outside
    them.

    gains: names of leaves of the law, "k" or an entry "Kc[0]", "K[0,1]". A scheduled leaf that is a
    number is absent (None) in `law`; of an array the scheduled entries are not used. variable:
    "r1", the setpoint of output 1, or "h2", the estimated level of tank 2, counted from 1 as on the
    rig. Build one with `jaxtank.rig.schedule.schedule`.

    A gain of which the law makes anything before the loop (`prepare`, `inputs`, `init`), or from
    which it designs matrices or runs a loop in `step` (weights of a Riccati equation or of a
    predictive law, the order of a fractional integral), is refused by `check`: the first would be
    left unscheduled, the second done anew at every sample. Inside a trace, where nothing is
    checked, the former
    ends in a run that is not finite: before the loop the law is given NaN for its scheduled gains.
    """

    law: Controller
    knots: np.ndarray = leaf("cm", "(K,) positions of the operating variable, increasing")
    values: np.ndarray = leaf("-", "(gains, K) each gain at each knot")
    gains: tuple = static(doc="leaves of the law that are scheduled, one per row of values")
    variable: str = static(
        doc="operating variable: r1, a setpoint, or h1, a level estimate, and so on, counted from 1"
    )

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
    def allocates(self) -> bool:
        return self.law.allocates

    @pointwise
    def prepare(self, r: tuple, dr: tuple, ddr: tuple) -> Any:
        return self._blind().prepare(r, dr, ddr)

    @pointwise
    def inputs(self, clock: Clock) -> Any:
        return self._blind().inputs(clock)

    def init(self, x0: tuple, u0: tuple) -> Any:
        return Memory(
            law=self._blind().init(x0, u0), at=() if self._on_setpoint else x0[self._index]
        )

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        at = tick.r[self._index] if self._on_setpoint else estimate.x[self._index]
        command, inner = self._law_at(at).step(state.law, tick, estimate)
        return command, Memory(law=inner, at=state.at if self._on_setpoint else at)

    def track(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        at = tick.r[self._index] if self._on_setpoint else state.at
        return state._replace(law=self._law_at(at).track(state.law, tick, command, applied))

    def input_metric(self, estimate: Estimate) -> tuple | None:
        # the setpoint is not told here: `check` refuses gains that would need it
        law = self._blind() if self._on_setpoint else self._law_at(estimate.x[self._index])
        return law.input_metric(estimate)

    def metadata_of(self, field: str) -> dict[str, Any]:
        """What to change of a field's metadata: the values are in the units and ranges of their
        gains.
        """
        if field != "values":
            return {}
        rows = []
        for gain in self.gains:
            meta = describe(self.law, gain)
            rows.append(
                {**meta, "doc": f"{meta['doc']}: controller.law.{gain} at a knot", "like": None}
            )
        doc = f"(gains, K) each gain at each knot; a row each for {', '.join(self.gains)}"
        every = {
            "doc": doc,
            "unit": ", ".join(dict.fromkeys(m["unit"] for m in rows)),
            "rows": tuple(rows),
        }
        if rows and all(
            m["low"] == rows[0]["low"] and m["strict"] == rows[0]["strict"] for m in rows
        ):
            every |= {"low": rows[0]["low"], "strict": rows[0]["strict"]}
        return every

    def check(self, reference: Signal) -> None:
        check_gains(self.law, self.gains)
        tanks = getattr(getattr(self.law, "model", None), "tanks", None)
        check_variable(self.variable, reference.channels, tanks)
        check_knots(self.knots)
        shape = (len(self.gains), np.shape(self.knots)[0])
        if np.shape(self.values) != shape:
            raise InputError(
                f"controller.values has shape {np.shape(self.values)}: must be {shape}, a row per"
                " gain, a column per knot"
            )
        for i, (gain, meta) in enumerate(zip(self.gains, self.metadata_of("values")["rows"])):
            if parameters(self.law).get(gain) is not None:
                raise InputError(
                    f"controller.law.{gain} is scheduled: set controller.values[{i},0] and so on,"
                    " one per knot"
                )
            for j, value in enumerate(self.values[i]):
                check_value(f"controller.values[{i},{j}]", value, meta)
        for gain in self.gains:
            if why := refusal(self.law, self.gains, gain, self._on_setpoint, reference.channels):
                raise InputError(f"controller.law.{gain} cannot be scheduled: {why}")
        for column in np.asarray(self.values).T:
            self._law(column).check(reference)
