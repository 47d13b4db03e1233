"""On-off control with hysteresis: each pump or valve at one of two inputs."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.controllers.base import Controller
from jaxtank.core.errors import InputError
from jaxtank.core.labels import name_of
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import component, leaf
from jaxtank.core.vectors import each, take, zeros
from jaxtank.plants.base import Plant
from jaxtank.signals.base import Signal


@jax.custom_jvp
def switched(level: Any, on: Any, off: Any, running: Any) -> Any:
    """Return 1 from the sample at which a level reaches `on` until it reaches `off`, else 0."""
    filling = on < off
    start = jnp.where(filling, level <= on, level >= on)
    stop = jnp.where(filling, level >= off, level <= off)
    return jnp.where(start, 1.0, jnp.where(stop, 0.0, running))


def _refused(primals: Any, tangents: Any) -> Any:
    moving = [not isinstance(v, jax.custom_derivatives.SymbolicZero) for v in tangents[:3]]
    if any(moving):
        raise InputError(
            "controller: on-off switches at times that depend on the levels, and a run with samples"
            " has no derivative there: compare values of `on` and `off` by simulate"
            " or uncertainty with --set controller.on=VALUE, which need none"
        )
    return switched(*primals), jnp.zeros_like(primals[0])


switched.defjvp(_refused, symbolic_zeros=True)


@component
class OnOff(Controller):
    """Pump or valve i between two inputs by the level of output i, with hysteresis:

        u_i = high_i from where h_i passes on_i until it passes off_i, else low_i

    `on` below `off` fills a tank: the pump starts at or below `on` and stops at or above `off`.
    `on` above `off` empties it: a drain pump, or a valve in the outlet. The setpoints are not used.
    A run has no derivative by anything that moves a level: asking for one raises InputError.

    Examples
    --------
    >>> from jaxtank.plants import network
    >>> tank = network(area=1.0, drain=0.0, pump_gain=1.0, feeds=[(0, None)], rim=5.0)
    >>> switch = OnOff(model=tank, on=[1.0], off=[2.0], low=[0.0], high=[3.0])
    >>> tick = Tick(t=0.0, r=(1.5,), dr=(0.0,), ddr=(0.0,), dt=1.0)
    >>> state = switch.init((1.5,), (0.0,))
    >>> (u,), state = switch.step(state, tick, Estimate(x=(0.9,)))
    >>> (later,), state = switch.step(state, tick, Estimate(x=(1.5,)))
    >>> float(u), float(later)
    (3.0, 3.0)
    """

    reads_model = False
    model: Plant
    on: np.ndarray = leaf("cm", "level at which each input goes to `high`", shape=("output",))
    off: np.ndarray = leaf("cm", "level at which each input goes to `low`", shape=("output",))
    low: np.ndarray = leaf("V", "input while off", shape=("pump",))
    high: np.ndarray = leaf("V", "input while on", shape=("pump",))

    def init(self, x0: tuple, u0: tuple) -> Any:
        nearer = lambda u, low, high: abs(u - high) < abs(u - low)
        on = each(nearer, u0, self.low, self.high)
        return each(lambda on, zero: jnp.where(on, 1.0, 0.0) + 0.0 * zero, on, zeros(u0))

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        levels = take(estimate.x, self.model.outputs)
        running = each(switched, levels, self.on, self.off, state)
        pick = lambda on, low, high: jnp.where(on > 0.5, high, low)
        return each(pick, running, self.low, self.high), running

    def check_inputs(self) -> None:
        """Raise InputError unless each output has its pump or valve."""
        outputs, pumps = self.model.outputs, self.model.pumps
        if len(outputs) == pumps:
            return
        tank = name_of(self.model, "tank", outputs[0])
        entry = f'"{tank}"' if tank else f"{outputs[0] + 1}"
        raise InputError(
            f"controller: on-off needs one pump or valve per output: the model has {pumps} and"
            f" {len(outputs)}; [plant] outputs may name a tank several times, once for each pump"
            f" with its own `on` and `off`, as outputs = [{entry}, {entry}]"
        )

    def check(self, reference: Signal) -> None:
        self.check_inputs()
        same = np.asarray(self.on) == np.asarray(self.off)
        if np.any(same):
            raise InputError(
                f"controller.on = controller.off in output {int(np.argmax(same)) + 1}: a pump would"
                " start and stop at every sample: set them apart"
            )
