"""A controller and its observer as statements, the input of every language."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.core.records import Tick
from jaxtank.export.lowering import lower
from jaxtank.export.statements import Statement
from jaxtank.loop.closed_loop import control_state, initial
from jaxtank.loop.step import decide


def functions(case):
    """Return (step, begin), the functions of one sample and of the first state, of arrays."""
    # step(state, t, y, r, dr, ddr) -> (u, state), with t [s], y (tanks,) measured levels, r, dr,
    # ddr (outputs,) setpoints with their first and second time derivatives, and u (pumps,) inputs
    # within the limits of the pumps. begin(y, u) -> state, from the levels and inputs before the
    # first sample. `jaxtank.loop.step.decide`, which is called, has the order of one sample.
    loop, dt = case.loop, case.clock.dt

    def scalars(array):
        return tuple(array[i] for i in range(array.shape[0]))

    def begin(y, u):
        return loop.observer.init(scalars(y)), control_state(loop, scalars(y), scalars(u))

    def step(state, t, y, r, dr, ddr):
        observer, controller = state
        r, dr, ddr = map(scalars, (r, dr, ddr))
        samples = [tuple(v[None] for v in signal) for signal in (r, dr, ddr)]
        plan = jax.tree.map(lambda a: a[0], loop.controller.prepare(*samples))
        tick = Tick(t=t, r=r, dr=dr, ddr=ddr, dt=dt, plan=plan, own=())
        decision = decide(loop, observer, controller, tick, scalars(y))
        return jnp.stack(list(decision.applied)), (decision.observer, decision.controller)

    return step, begin


@dataclasses.dataclass(frozen=True)
class Program:
    """The statements of the two functions of a case, and the sizes of their arguments."""

    case: Case
    state: int
    """Number of entries of the state."""
    begin: list[Statement]
    first: list[Any]
    """Entries of the first state."""
    step: list[Statement]
    u: list[Any]
    """Inputs of the pumps."""
    after: list[Any]
    """Entries of the state after the step."""

    @property
    def tanks(self) -> int:
        """Number of tanks, the size of y."""
        return self.case.loop.plant.tanks

    @property
    def outputs(self) -> int:
        """Number of controlled tanks, the size of r, dr and ddr."""
        return len(self.case.loop.plant.outputs)

    @property
    def pumps(self) -> int:
        """Number of pumps, the size of u."""
        return self.case.loop.plant.pumps


def program(case: Case) -> Program:
    """Return the Program of a case."""
    plant = case.loop.plant
    step, begin = functions(case)
    real = functools.partial(jax.ShapeDtypeStruct, dtype=jnp.result_type(float))
    y, r, u = (real((n,)) for n in (plant.tanks, len(plant.outputs), plant.pumps))
    # the first state may have another type than the next ones: a number of the controller, an array
    # of the run
    ran = initial(case.loop, case.clock)
    state = jax.tree.map(
        lambda a: jax.ShapeDtypeStruct(np.shape(a), jnp.result_type(a)),
        (ran.observer, ran.controller),
    )
    size = sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(state))
    begun, first = lower(begin, {"y": y, "u": u})
    done, (inputs, *after) = lower(
        step, {"s": state, "t": real(()), "y": y, "r": r, "dr": r, "ddr": r}
    )
    result = Program(case, size, begun, _entries(first), done, list(inputs), _entries(after))
    if not len(result.first) == len(result.after) == size:
        raise InputError(
            f"{case.name}: the first state of its controller has {len(result.first)} numbers, the"
            f" next one {len(result.after)}; a controller to export keeps its size"
        )
    return result


def _entries(arrays):
    return [e for array in arrays for e in np.ravel(array)]
