"""Gain schedules: gains of a controller as piecewise-linear functions of a setpoint or a level."""

import functools
import re
from collections.abc import Sequence
from operator import attrgetter
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


def refusal(controller, gains, gain, on_setpoint, channels):
    """Return why `gain` cannot be scheduled together with the other `gains`, or None."""
    # Derived from the traced methods of the controller, not from its values.
    leaves, structure = jax.tree.flatten(controller)
    return _refusal(
        structure, tuple(np.shape(v) for v in leaves), gains, gain, on_setpoint, channels
    )


# a check of a loop comes before every run, and the answer depends on no value
@functools.lru_cache(maxsize=256)
def _refusal(structure, shapes, gains, gain, on_setpoint, channels):
    try:
        traced = _Traced(structure, shapes, gains, gain, channels)
        return _outside_the_step(traced, on_setpoint) or _in_the_step(traced)
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError):
        return "the controller branches on its value with Python's if, which cannot be traced"


class _Traced:
    """Methods of a controller traced for placeholders: which of them depend on one gain."""

    def __init__(self, structure, shapes, gains, gain, channels):
        self.number = jax.ShapeDtypeStruct((), jnp.result_type(float))
        self.structure, self.gain = structure, gain
        self.leaves = [jax.ShapeDtypeStruct(s, self.number.dtype) for s in shapes]
        self.others = [g for g in gains if g != gain]
        self.empty = jax.tree.unflatten(structure, self.leaves)
        model = getattr(self.empty, "model", None)
        tanks, pumps = (channels, channels) if model is None else (model.tanks, model.pumps)
        self.x, self.u, self.r = ((self.number,) * n for n in (tanks, pumps, channels))
        self.before = self._before()

    def method(self, name, *args, **fixed):
        """Return the use of the gain in one method, and the shapes of its results."""

        def f(value, rest, leaves, *args):
            values = {self.gain: value, **dict(zip(self.others, rest))}
            controller = with_values(jax.tree.unflatten(self.structure, leaves), values)
            return getattr(controller, name)(*args, **fixed)

        arguments = (self.number, (self.number,) * len(self.others), self.leaves, *args)
        return use_of(f, *arguments), jax.eval_shape(f, *arguments)

    def _before(self):
        """Return {method that runs before the loop: (use of the gain, shapes of its results)}."""
        samples = 3
        along = (jax.ShapeDtypeStruct((samples,), self.number.dtype),) * len(self.r)
        return {
            "prepare": self.method("prepare", along, along, along),
            "inputs": self.method("inputs", clock=Clock(dt=1.0, duration=samples - 1.0)),
            "init": self.method("init", self.x, self.u),
        }


def _outside_the_step(traced, on_setpoint):
    """Return why a gain cannot be scheduled that acts elsewhere than in `step`, or None."""
    for name, (use, _) in traced.before.items():
        if use.reached:
            return f"the controller uses it before the loop starts (in its {name})"
    estimate = Estimate(x=traced.x, d=traced.x)
    allocates = on_setpoint and traced.empty.allocates
    if allocates and traced.method("input_metric", estimate)[0].reached:
        return (
            "the controller's input_metric depends on it and does not receive the setpoint:"
            " schedule it on a level"
        )
    return None


def _in_the_step(traced):
    """Return why a gain cannot be scheduled for what `step` and `track` compute, or None."""
    number, x, r = traced.number, traced.x, traced.r
    plan, signals, state = (shapes for _, shapes in traced.before.values())
    row = lambda tree: jax.tree.map(lambda v: jax.ShapeDtypeStruct(v.shape[1:], v.dtype), tree)
    tick = Tick(t=number, r=r, dr=r, ddr=r, dt=number, plan=row(plan), own=row(signals))
    tick = tick._replace(inflow=x, flow=traced.u)
    step, (command, state) = traced.method("step", state, tick, Estimate(x=x, d=x))
    track, _ = traced.method("track", state, tick, command, traced.u)
    absent = parameters(traced.empty).get(traced.gain.split("[")[0], 0.0)
    own_size = int(np.prod(np.shape(absent), dtype=int))
    if step.looped or track.looped or max(step.largest, track.largest) > own_size:
        return (
            "the controller uses it in its design (matrices, or a loop), which would then be"
            " repeated at every sample"
        )
    return None if step.reached or track.reached else "the controller does not use it"


VARIABLE = re.compile(r"[rh][1-9]\d*")
LEVEL_LIMITS = {"limit", "lowest", "limit_Kc", "inner_low", "inner_high"}
"""Parameters of which `level_limits` of a controller are made."""


def check_gains(controller, gains):
    """Check that each of `gains` names a number among the leaves of a controller, once."""
    if not gains:
        raise InputError("a schedule needs at least one gain")
    names = parameters(controller)
    for gain in gains:
        if gains.count(gain) > 1:
            raise InputError(f"gain {gain} is scheduled twice")
        try:
            meta = describe(controller, gain)
        except InputError:
            known = [f"controller.{n}" for n in names]
            raise unknown("gain", f"controller.{gain}", known) from None
        if meta["kind"] == "static":
            raise InputError(
                f"gain controller.{gain}: cannot be scheduled, it is part of the compiled program"
                " and not a number"
            )
        if gain not in names and "[" not in gain:
            continue  # absent because it is scheduled
        if np.ndim(get_value(controller, gain)):
            raise InputError(
                f"gain controller.{gain} has shape {np.shape(get_value(controller, gain))}: name"
                f" its entries, as {gain}[0]"
            )


def check_variable(variable, outputs, tanks):
    """Check the operating variable of a schedule."""
    good = isinstance(variable, str) and VARIABLE.fullmatch(variable)
    most = (outputs if variable[0] == "r" else tanks) if good else 0
    if not good or (most is not None and int(variable[1:]) > most):
        levels = "" if tanks is None else f", or h1 to h{tanks}, the level of a tank"
        raise InputError(
            f"schedule variable {variable!r} does not exist: must be r1 to r{outputs}, the setpoint"
            f" of an output{levels}"
        )


def check_knots(knots):
    """Check that there are at least two knots, finite and increasing."""
    p = np.asarray(knots, dtype=float)
    if p.ndim != 1 or p.size < 2 or not np.all(np.isfinite(p)) or not np.all(np.diff(p) > 0):
        raise InputError(
            f"schedule knots {p.tolist()}: must be at least two finite numbers, each above the one"
            " before"
        )


class Memory(NamedTuple):
    """State of the scheduled controller, and its level [cm] where `track` needs one, else ()."""

    inner: Any
    at: Any


def interpolate(at, knots, values):
    """Return piecewise-linear functions of the operating variable, constant outside the knots."""
    # g(s) = v_1 + sum_j (v_{j+1} - v_j)/(p_{j+1} - p_j) (min(max(s, p_j), p_{j+1}) - p_j)
    count, intervals = np.shape(values)[0], np.shape(knots)[0] - 1
    parts = [portion(at, knots[j], knots[j + 1]) for j in range(intervals)]
    slope = lambda i, j: (values[i, j + 1] - values[i, j]) / (knots[j + 1] - knots[j])
    rises = lambda i: (slope(i, j) * parts[j] for j in range(intervals))
    return tuple(sum(rises(i), start=values[i, 0]) for i in range(count))


@component
class Scheduled(Controller):
    """A controller whose `gains` depend on an operating variable: linear between knots, constant
    outside them (see `interpolate`).

    gains: names of leaves of the controller `law`, "k" or an entry "Kc[0]", "K[0,1]". A scheduled
    leaf that is a number is absent (None) in `law`; of an array the scheduled entries are not used.
    variable: "r1", the setpoint of output 1, or "h2", the estimated level of tank 2, counted
    from 1 as on the rig. Build one with `jaxtank.rig.values.schedule`.

    `check` refuses a gain that is used before the loop (`prepare`, `inputs`, `init`), or from which
    `step` designs matrices or computes in a loop (weights of a Riccati equation or of a predictive
    controller, the order of a fractional integral): the former would not be scheduled, the latter
    would be repeated at every sample. Inside a trace, where nothing is checked, the former ends in
    a non-finite run: before the loop the scheduled gains are NaN.

    Examples
    --------
    >>> from jaxtank.controllers import StateFeedback
    >>> from jaxtank.plants.rigs import johansson
    >>> scheduled = Scheduled(
    ...     law=StateFeedback(model=johansson("minimum")[0], K=np.zeros((2, 4))),
    ...     knots=[10.0, 14.0],
    ...     values=[[0.1, 0.3]],
    ...     gains=("K[0,0]",),
    ...     variable="r1",
    ... )
    >>> tick = Tick(t=0.0, r=(12.0, 12.0), dr=(), ddr=(), plan=((12.0, 12.0, 2.0, 2.0), (3.0, 3.0)))
    >>> estimate = Estimate(x=(13.0, 12.0, 2.0, 2.0))
    >>> (u1, u2), _ = scheduled.step(scheduled.init((), ()), tick, estimate)
    >>> round(float(u1), 6), float(u2)  # 3 V - K[0,0] 1 cm, with K[0,0] = 0.2 V/cm at 12 cm
    (2.8, 3.0)
    """

    law: Controller
    knots: np.ndarray = leaf("cm", "positions of the operating variable, increasing", shape="knot")
    values: np.ndarray = leaf("-", "each gain at each knot", shape=("gain", "knot"))
    gains: tuple = static(doc="leaves of the controller that are scheduled, one per row of values")
    variable: str = static(
        doc="operating variable: r1, a setpoint, or h1, a level estimate, and so on, counted from 1"
    )

    def _with_gains(self, gains):
        return with_values(self.law, dict(zip(self.gains, gains)))

    def _without_gains(self):
        return self._with_gains((np.nan,) * len(self.gains))

    def _controller_at(self, at):
        return self._with_gains(interpolate(at, self.knots, self.values))

    @property
    def _index(self):
        return int(self.variable[1:]) - 1

    @property
    def _on_setpoint(self):
        return self.variable.startswith("r")

    allocates = property(attrgetter("law.allocates"))
    reads_inflow = property(attrgetter("law.reads_inflow"))
    reads_flow = property(attrgetter("law.reads_flow"))
    limits_levels = property(attrgetter("law.limits_levels"))
    reads_ahead = property(attrgetter("law.reads_ahead"))

    @pointwise
    def prepare(self, r: tuple, dr: tuple, ddr: tuple) -> Any:
        return self._without_gains().prepare(r, dr, ddr)

    @pointwise
    def inputs(self, clock: Clock) -> Any:
        return self._without_gains().inputs(clock)

    @pointwise
    def announced(self, clock: Clock, r: tuple) -> Any:
        return self._without_gains().announced(clock, r)

    def joint_inputs(self) -> list[tuple[int, ...]]:
        return self.law.joint_inputs()

    @property
    def keeps_limits(self) -> bool:
        return self.law.keeps_limits

    def level_limits(self) -> list[tuple[int, float, float]]:
        scheduled = {gain.partition("[")[0] for gain in self.gains}
        return [] if scheduled & LEVEL_LIMITS else self.law.level_limits()

    def slack(self, state: Any) -> Any:
        return self.law.slack(state.inner)

    def init(self, x0: tuple, u0: tuple) -> Any:
        at = () if self._on_setpoint else x0[self._index]
        return Memory(inner=self._without_gains().init(x0, u0), at=at)

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        at = tick.r[self._index] if self._on_setpoint else estimate.x[self._index]
        command, inner = self._controller_at(at).step(state.inner, tick, estimate)
        return command, Memory(inner=inner, at=state.at if self._on_setpoint else at)

    def track(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        controller = self._controller_then(state, tick)
        return state._replace(inner=controller.track(state.inner, tick, command, applied))

    def transfer(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        controller = self._controller_then(state, tick)
        return state._replace(inner=controller.transfer(state.inner, tick, command, applied))

    @property
    def bumpless(self) -> bool:
        return self._without_gains().bumpless

    def _controller_then(self, state: Any, tick: Tick) -> Controller:
        """The controller of the sample that `state` is from."""
        return self._controller_at(tick.r[self._index] if self._on_setpoint else state.at)

    def input_metric(self, estimate: Estimate) -> tuple | None:
        # the setpoint is not available here: `check` refuses gains that would need it
        if self._on_setpoint:
            return self._without_gains().input_metric(estimate)
        return self._controller_at(estimate.x[self._index]).input_metric(estimate)

    def metadata_of(self, field: str) -> dict[str, Any]:
        """Return changes of a field's metadata: values have units and ranges of their gains."""
        if field != "values":
            return {}
        metas = {gain: describe(self.law, gain) for gain in self.gains}
        words = lambda gain, meta: f"{meta['doc']}: controller.law.{gain} at a knot"
        rows = tuple({**m, "doc": words(gain, m), "like": None} for gain, m in metas.items())
        doc = f"each gain at each knot; a row each for {', '.join(self.gains)}"
        units = ", ".join(dict.fromkeys(m["unit"] for m in rows))
        ends = [{name: m[name] for name in ("low", "strict")} for m in rows]
        same = ends[0] if ends and all(end == ends[0] for end in ends) else {}
        return {"doc": doc, "unit": units, "rows": rows, **same}

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
        # first: only a controller that serves the rig can be traced
        for column in np.asarray(self.values).T:
            self._with_gains(column).check(reference)
        for gain in self.gains:
            if why := refusal(self.law, self.gains, gain, self._on_setpoint, reference.channels):
                raise InputError(f"controller.law.{gain} cannot be scheduled: {why}")
