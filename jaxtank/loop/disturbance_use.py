"""Whether a disturbance that the observer of a loop estimates has an effect on its inputs."""
# jax leaves the types of eval_shape and trees partly open.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false

from typing import Any

import jax
import jax.numpy as jnp

from jaxtank.core.clock import Clock
from jaxtank.core.records import Estimate, Tick
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.xla.reachability import use_of


def is_unused(loop: ClosedLoop) -> bool:
    """Return True if the observer estimates disturbances and the controller does not use them."""
    # Found by tracing one sample, so that controllers of a user's own are judged too; nothing is
    # computed. False where a setting of the controller states that they are not to be used.
    if loop.controller.ignores_disturbance:
        return False
    number = jax.ShapeDtypeStruct((), jnp.result_type(float))
    x, u, r = ((number,) * n for n in (loop.plant.tanks, loop.plant.pumps, loop.reference.channels))

    def estimated(x: Any, t: Any) -> Any:
        tick = Tick(t=t, r=(), dr=(), ddr=(), dt=t)
        return loop.observer.step(loop.observer.init(x), tick, x)[0].d

    d = tuple(jax.eval_shape(estimated, x, number))
    if not d:
        return False
    along = tuple(jax.ShapeDtypeStruct((1,), number.dtype) for _ in r)
    plan: Any = jax.eval_shape(loop.controller.prepare, along, along, along)
    signals: Any = jax.eval_shape(lambda: loop.controller.inputs(Clock(dt=1.0, duration=0.0)))
    plan, signals = jax.tree.map(_row, (plan, signals))
    tick = Tick(t=number, r=r, dr=r, ddr=r, dt=number, plan=plan, own=signals)

    def decided(d: Any, x: Any, u: Any, tick: Any) -> Any:
        return loop.controller.step(loop.controller.init(x, u), tick, Estimate(x=x, d=d))

    return not use_of(decided, d, x, u, tick).reached


def _row(v: Any) -> Any:
    """The placeholder of one sample of an array (samples, ...)."""
    return jax.ShapeDtypeStruct(v.shape[1:], v.dtype)
