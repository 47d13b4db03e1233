"""Records that sensors, observers, controllers and measures exchange; check of a random key."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.errors import InputError


def check_key(key: Any) -> None:
    """Check a random key: None, or one key of jax, typed or a row of unsigned integers."""
    kind, ndim = getattr(key, "dtype", None), len(getattr(key, "shape", ()))
    typed = kind is not None and jnp.issubdtype(kind, jax.dtypes.prng_key)
    if (typed and ndim == 0) or (
        kind == np.uint32 and (ndim == 1 or isinstance(key, jax.ShapeDtypeStruct))
    ):
        return
    if key is not None:
        words = f"has shape {key.shape}" if typed else f"is a {type(key).__name__}"
        raise InputError(
            f"key {words}: must be one random key, as jax.random.key(0), or None where there is no"
            " noise"
        )


class Tick(NamedTuple):
    """Inputs of controller and observer at sample k in addition to measurements."""

    t: Any  # time [s]
    r: tuple[Any, ...]  # setpoint r [cm]
    dr: tuple[Any, ...]  # its rate r' [cm/s]
    ddr: tuple[Any, ...]  # its second derivative r'' [cm/s^2]
    dt: Any = 0.0  # sampling period Ts [s]
    plan: Any = ()  # entry of the controller's `prepare` for this sample
    own: Any = ()  # this sample of the controller's own signals (`Controller.inputs`)
    # measured inflow of each tank [cm^3/s] for a controller that `reads_inflow`, else empty
    inflow: Sequence[Any] = ()
    # measured flow of each input [cm^3/s] for a controller that `reads_flow`, else empty
    flow: Sequence[Any] = ()


class Estimate(NamedTuple):
    """Output of an observer to a controller: tuples of scalars."""

    x: Sequence[Any]  # level estimate, one per tank [cm]
    # estimated disturbance of each level rate, what the model of the observer does not explain:
    # inflow over area [cm/s]; empty where none is estimated
    d: Sequence[Any] = ()
    # of a bank of H fault models: (2 H,) probabilities, then sizes of the faults; else empty
    modes: Any = ()
    # values of the entries of the model that the observer estimates (`Observer.coefficients`)
    coefficients: Sequence[Any] = ()


class Sample(NamedTuple):
    """State and signals at t_k, before the plant moves: tuples of scalars."""

    t: Any  # time [s]
    x: Sequence[Any]  # levels, one per tank [cm]
    y: Sequence[Any]  # measured levels, one per tank [cm]
    x_hat: Sequence[Any]  # estimated levels, one per tank [cm]
    # estimated disturbances of the level rates, one per tank [cm/s]; 0 where none is estimated
    d_hat: Sequence[Any]
    r: tuple[Any, ...]  # setpoint, one per output [cm]
    e: tuple[Any, ...]  # tracking error of the true output, x - r, one per output [cm]
    command: Sequence[Any]  # commands of the controller, one per pump [V]
    applied: Sequence[Any]  # the command within the pumps' limits, one per pump [V]
    u: Sequence[Any]  # inputs at the plant over [t_k, t_k + dt), one per pump [V]
    spilled: Sequence[Any]  # overflow over each rim during [t_k, t_k + dt) [cm^3]
    # volume that a negative inflow could not take from each tank in that time [cm^3]
    shortfall: Sequence[Any] = ()
    filtered: Any = 0.0  # 1 where the safety filter changed an input, else 0
    slack: Any = 0.0  # by which the controller gives up a limit of a level [cm]
    modes: Any = ()  # as in Estimate
    coefficients: Sequence[Any] = ()  # as in Estimate
