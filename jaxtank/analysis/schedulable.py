"""Gains of a controller that may follow a schedule, from their use in its traced methods."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Clock
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import parameters, with_values
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
    if (
        on_setpoint
        and traced.empty.allocates
        and traced.method("input_metric", estimate)[0].reached
    ):
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
    if not (step.reached or track.reached):
        return "the controller does not use it"
    return None
