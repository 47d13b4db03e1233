"""Estimates of an observer: what they contain other than inflows, and whether they are used."""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false, reportUnknownLambdaType=false

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.analysis.linear_model import linearise
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.labels import label_of
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.units import local
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.steady import steady_state
from jaxtank.loop.trajectory import Trajectory
from jaxtank.observers import DisturbanceObserver, ExtendedKalman, Kalman
from jaxtank.xla.reachability import use_of

FAR = 0.1
"""Share of the linear model's own change of a rate by which it may be wrong without a note [-]."""


def withheld(loop: ClosedLoop) -> Any:
    """Rates (n,) [cm/s] that offset dead zones of running pumps take from the observer's model."""
    plant, bank = loop.plant, loop.actuator
    x = tuple(np.asarray(loop.x0, dtype=float))
    offset = np.broadcast_to(np.asarray(bank.offset, dtype=float), (plant.pumps,))
    rates = [np.asarray(plant.derivative(0.0, x, tuple(u), None)) for u in (0.0 * offset, offset)]
    return rates[0] - rates[1]


@jax.jit
def linear_distance(observer: Kalman, x: Any, u: Any) -> tuple[Any, Any, Any]:
    """(distances of x [cm], errors [cm/s], changes [cm/s]) (rows, n) of the linear model."""
    A, B, _ = linearise(observer.model, observer.levels, observer.inputs)

    def rates(x: Any, u: Any) -> Any:
        return jnp.stack(observer.model.derivative(0.0, tuple(x), tuple(u), None))

    centre = (jnp.asarray(observer.levels), jnp.asarray(observer.inputs))
    dx, du = (jnp.asarray(v) - of for v, of in zip((x, u), centre))
    error = rates(*centre) + dx @ A.T + du @ B.T - jax.vmap(rates)(jnp.asarray(x), jnp.asarray(u))
    return jnp.abs(dx), jnp.abs(error), jnp.abs(dx) @ jnp.abs(A).T


def _far(loop: ClosedLoop, x: Any, u: Any, when: str) -> list[str]:
    """A sentence where the linear model of a Kalman filter is wrong at levels x."""
    observer = loop.observer
    if not isinstance(observer, Kalman):
        return []
    distance, error, change = map(np.asarray, linear_distance(observer, x, u))
    if not np.any(error > FAR * change):
        return []
    i, j = (int(np.argmax(v.max(axis=0))) for v in (distance, error))
    length, rate = (local(unit, loop.units) for unit in ("cm", "cm/s"))
    farthest, worst = (label_of(loop.plant, "tank", k) for k in (i, j))
    return [
        f"observer.levels: {when} the level of {farthest} is up to {distance.max():.3g} {length}"
        f" from the operating level {float(np.asarray(observer.levels)[i]):g} {length}, and the"
        f" linear model is wrong by up to {error.max():.3g} {rate} in the rate of {worst}: the"
        " filter's estimates have that error in them; choose operating levels nearer by, or the"
        " extended filter"
    ]


def needs_run(loop: ClosedLoop) -> bool:
    """Return whether `estimate_notes` may have something to say of a run."""
    estimates = isinstance(loop.observer, DisturbanceObserver | ExtendedKalman)
    return isinstance(loop.observer, Kalman) or (estimates and bool(np.any(withheld(loop))))


def estimate_notes(loop: ClosedLoop, run: Trajectory) -> list[str]:
    """Return sentences on what the estimates of a run contain that is no inflow."""
    sentences = _far(loop, run.x, run.applied, "in this run")
    parts = withheld(loop) if np.any(np.asarray(run.d_hat)) else np.zeros(1)
    if np.any(parts):
        values = ", ".join(f"{v:.3g}" for v in parts)
        sentences.append(
            "d_hat is the part of the level rates that the observer's model does not explain: it"
            f" contains inflows, and the flow lost in offset dead zones while pumps run, {values}"
            f" {local('cm/s', loop.units)} of the tanks in order"
        )
    return sentences


def design_notes(loop: ClosedLoop, clock: Clock) -> list[str]:
    """Sentences on a Kalman filter at the setpoints farthest from its operating levels."""
    observer = loop.observer
    if not isinstance(observer, Kalman):
        return []
    setpoints = np.stack(loop.reference.sample(clock)[0], axis=-1)
    away = np.abs(setpoints - np.asarray(observer.levels)[list(loop.plant.outputs)]).max(axis=1)
    try:
        x, u = steady_state(loop, setpoints[int(np.argmax(away))], observer.model)
    except (InputError, FloatingPointError):
        return []
    return _far(loop, x[None], u[None], "at rest at the setpoints")


def is_unused(loop: ClosedLoop) -> bool:
    """Return True if the observer estimates disturbances and the controller does not use them."""
    # By tracing one sample, which serves custom controllers too; nothing is computed.
    if loop.controller.ignores_disturbance or loop.observer.mode_names(loop.plant):
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
    clock = Clock(dt=1.0, duration=0.0)
    signals: Any = jax.eval_shape(lambda r: loop.controller.announced(clock, r), along)
    plan, signals = jax.tree.map(
        lambda v: jax.ShapeDtypeStruct(v.shape[1:], v.dtype), (plan, signals)
    )
    tick = Tick(t=number, r=r, dr=r, ddr=r, dt=number, plan=plan, own=signals)
    tick = tick._replace(inflow=x, flow=u)

    def decided(d: Any, x: Any, u: Any, tick: Any) -> Any:
        return loop.controller.step(loop.controller.init(x, u), tick, Estimate(x=x, d=d))

    return not use_of(decided, d, x, u, tick).reached
