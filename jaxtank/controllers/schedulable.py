"""Which gains of a law can be scheduled, on what, and why not the others."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import describe, get_value, parameters, with_values
from jaxtank.xla.reachability import use_of

VARIABLE = re.compile(r"[rh][1-9]\d*")


def check_gains(law, gains):
    """Raise InputError unless every one of `gains` names a number among the leaves of `law`, once."""
    if not gains:
        raise InputError("a schedule needs at least one gain")
    names = [n for n in parameters(law)]
    for gain in gains:
        if gains.count(gain) > 1:
            raise InputError(f"gain {gain} is scheduled twice")
        try:
            meta = describe(law, gain)
        except InputError:
            raise unknown("gain", f"controller.{gain}", [f"controller.{n}" for n in names]) from None
        if meta["kind"] == "static":
            raise InputError(f"gain controller.{gain}: cannot be scheduled, it is part of the compiled program and not a number")
        if gain not in names and "[" not in gain:
            continue  # absent because it is scheduled
        if np.ndim(get_value(law, gain)):
            raise InputError(f"gain controller.{gain} has shape {np.shape(get_value(law, gain))}: name its entries, as {gain}[0]")


def check_variable(variable, outputs, tanks):
    """Raise InputError unless `variable` is a setpoint of one of `outputs` or a level of one of `tanks` (None: not known)."""
    good = isinstance(variable, str) and VARIABLE.fullmatch(variable)
    most = (outputs if variable[0] == "r" else tanks) if good else 0
    if not good or (most is not None and int(variable[1:]) > most):
        levels = "" if tanks is None else f", or h1 to h{tanks}, the level of a tank"
        raise InputError(
            f"schedule variable {variable!r} does not exist: must be r1 to r{outputs}, the setpoint of an output{levels}"
        )


def check_knots(knots):
    """Raise InputError unless there are at least two knots, finite and increasing."""
    p = np.asarray(knots, dtype=float)
    if p.ndim != 1 or p.size < 2 or not np.all(np.isfinite(p)) or not np.all(np.diff(p) > 0):
        raise InputError(f"schedule knots {p.tolist()}: must be at least two finite numbers, each above the one before")


def refusal(law, gains, gain, on_setpoint, channels):
    """Why `gain` cannot be scheduled together with the other `gains`, or None; read from the law's traced methods, not from its values.

    law: with absent (None) gains or without; on_setpoint: the operating variable is a setpoint; channels: of the reference.
    """
    leaves, structure = jax.tree.flatten(law)
    return _refusal(structure, tuple(np.shape(v) for v in leaves), gains, gain, on_setpoint, channels)


@functools.lru_cache(maxsize=256)  # a check of a loop comes before every run, and the answer depends on no value
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
        f = lambda value, rest, leaves, *args: getattr(with_gains(value, rest, leaves), name)(*args, **fixed)
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
            return "the law's input_metric uses it, which is not told the setpoint: schedule it on a level"
        plan, own, state = (found for _, found in before.values())
        row = lambda tree: jax.tree.map(lambda v: jax.ShapeDtypeStruct(v.shape[1:], v.dtype), tree)
        tick = Tick(t=number, r=r, dr=r, ddr=r, dt=number, plan=row(plan), own=row(own))
        step, (command, state) = method("step", state, tick, estimate)
        track, _ = method("track", state, tick, command, u)
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError):
        return "the law decides on its value with Python's if, which a schedule cannot follow"
    own_size = int(np.prod(np.shape(parameters(empty).get(gain.split("[")[0], 0.0)), dtype=int))
    if step.looped or track.looped or max(step.largest, track.largest) > own_size:
        return "the law designs with it (matrices, or a loop of its own), which would be done anew at every sample"
    if not (step.reached or track.reached):
        return "the law does not use it"
    return None
