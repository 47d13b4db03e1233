"""Arithmetic operations of a traced program: a cost that does not depend on the machine."""

import math
from typing import Any

import jax
import numpy as np

from jaxtank.core.clock import Clock
from jaxtank.core.records import Tick
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.step import decide

ONE_EACH = frozenset(  # primitives with one operation for each entry of their result
    ("add", "add_any", "sub", "mul", "div", "sqrt", "rsqrt", "max", "min", "neg", "abs", "sign")
    + ("exp", "log", "tanh", "pow", "integer_pow")
)


def operations(jaxpr: Any) -> int:
    """Return the arithmetic operations of a jaxpr; a loop without a fixed length counts once."""
    count = 0
    for eqn in jaxpr.eqns:
        name, size = eqn.primitive.name, math.prod(eqn.outvars[0].aval.shape) if eqn.outvars else 0
        if name in ONE_EACH:
            count += size
        elif name == "dot_general":
            ((summed, _), _) = eqn.params["dimension_numbers"]
            shape = eqn.invars[0].aval.shape
            count += 2 * size * math.prod(shape[i] for i in summed)
        elif name.startswith(("reduce_", "cum")):
            count += math.prod(eqn.invars[0].aval.shape)
        passes = eqn.params.get("length", 1) if name == "scan" else 1
        parts = jax.tree.leaves([*eqn.params.values()], is_leaf=lambda part: hasattr(part, "eqns"))
        inner = (getattr(part, "jaxpr", part) for part in parts if hasattr(part, "eqns"))
        count += passes * sum(map(operations, inner))
    return count


def sample_operations(loop: ClosedLoop, clock: Clock) -> int:
    """Return the arithmetic operations of observer and controller in one sample."""
    levels = tuple(map(float, np.ravel(loop.x0)))
    before = tuple(map(float, np.ravel(loop.actuator.initial)))
    outputs = tuple(levels[i] for i in loop.plant.outputs)
    state = loop.observer.init(levels), loop.controller.init(levels, before)

    def sample(state: Any, y: Any, r: Any, dr: Any) -> Any:
        return decide(loop, state[0], state[1], Tick(t=0.0, r=r, dr=dr, ddr=dr, dt=clock.dt), y)

    return operations(jax.make_jaxpr(sample)(state, levels, outputs, outputs).jaxpr)
