"""PI, PID and fractional PI, one loop per pump (gouta2022, Table 4; gouta2022 notes S4.5)."""

import functools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxtank.controllers.base import Controller
from jaxtank.controllers.feedback_linearisation import authority, check_own_pumps, drift
from jaxtank.core.clock import pointwise
from jaxtank.core.errors import InputError
from jaxtank.core.labels import OF_OPENINGS, input_unit, name_of
from jaxtank.core.numerics import clip
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.text import shortened
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.core.vectors import each, is_array, take
from jaxtank.plants.base import Plant
from jaxtank.signals.base import Signal

FILTER = 8.0  # the derivative's filter has the time constant Td/8 where no N is given
LOWEST, HIGHEST, SECTIONS = 1e-3, 1e2, 5  # Oustaloup's band [rad/s] and N: 2N + 1 sections

ENDLESS = 1e6
"""Integral times of so many tracking times are infinite: the integral would keep what the
anti-windup has added [-]."""


option = functools.partial(leaf, like="Kc", default=None, shape="output")
"""A leaf of a PID that may be left out."""


class Memory(NamedTuple):
    """State of the loops: vectors with one entry per pump."""

    integral: Any  # integral action I [V]
    slow: Any  # filtered level [cm], empty without derivative action
    sections: tuple  # states of the fractional filter, a tuple per loop, empty without
    error: Any  # r - y of this sample [cm]


def oustaloup(g):
    """Return direct gain, poles and residues of s^g on [1e-3, 1e2] rad/s:"""
    # Zeros wb (wh/wb)^((j + N + (1-g)/2)/(2N+1)), poles with (1+g)/2, j = -N .. N, gain wh^g
    # (Oustaloup 2000; gouta2022 notes S4.5).
    j = np.arange(2 * SECTIONS + 1)
    share = lambda shift: (j + 0.5 * (1.0 + shift)) / (2 * SECTIONS + 1)
    at = lambda shift: LOWEST * (HIGHEST / LOWEST) ** share(shift)
    zeros, poles, gain = at(-g), at(g), HIGHEST**g
    apart = jnp.where(np.eye(j.size, dtype=bool), 1.0, poles[None, :] - poles[:, None])
    residues = gain * jnp.prod(zeros[None, :] - poles[:, None], axis=1) / jnp.prod(apart, axis=1)
    return gain, poles, residues


@component
class PID(Controller):
    """One PI(D) loop per pump, output i to pump i:

        v = base + Kc (r - y) + I - Kc Td y'_f,    I' = Kc/Ti^order D^(1-order) [(r - y) + Ti (u -
        v)/(Tt Kc)]

    (gouta2022 Table 4; gouta2022 notes S4.5) with r, y [cm], v [V], u the input v after the limits,
    and the derivative of the measurement filtered by a lag of Td/N, N = 8 if left out; if
    Td/N is much shorter than the sampling period, by the backward difference of a sample. With
    action = "direct" the input rises with the level, as that of a valve in the outlet: Kc, above 0,
    then counts as -Kc. `anti_windup`: with "back-calculation" the tracking time is Tt; it is Ti
    without Tt, and with "conditioned" (Hanus 1987); with "clamping" the integral stops while v is
    beyond a limit and the error drives it further. Without Ti, or with Ti infinite, there is no
    integral action and nothing to wind up; an infinite entry does so to its loop alone.
    With `b` the proportional part is Kc (b r - y), from an integral that
    starts without a bump where y = r; errors within `deadband` count as 0, or with `gap_gain` by
    this share (gap control of an averaging level), and larger ones by what is beyond it. With
    `error_span` S the error e counts as e |e|/S (error-squared control; Shinskey, Process Control
    Systems, 1996, ch. 6). With `inflow_gain` the product with the measured inflow of the output's
    tank, or of the tanks `inflow_of`, is added to v. Without Td there is no derivative; without
    `order` the
    integral is of order one, with it s^-order = (1/s) s^(1-order), where the second factor is
    Oustaloup's filter: a true integrator is kept. base = bias, or with `feed_forward` the
    steady-state input of the model on the reference, (r' - f(r))/c2, less d/c2 for a disturbance d
    of the level rate [cm/s] that the observer estimates. Without `feed_forward` no estimate of a
    disturbance is used. A Ti of 1e6 Tt or more, which can only be meant as infinite, is.

    Examples
    --------
    >>> from jaxtank.plants.rigs import coupled_tanks
    >>> rig = coupled_tanks(
    ...     area=225.0, drain=0.8, pipe=0.9, pump_gain=35.0, rim=30.0, outputs=(0,), feeds=(0,)
    ... )
    >>> controller = PID(model=rig, Kc=[4.0], Ti=[6.0], Tt=[36.0], bias=[5.0])
    >>> tick = Tick(t=0.0, r=(8.0,), dr=(0.0,), ddr=(0.0,), dt=0.1)
    >>> (v,), _ = controller.step(controller.init((7.5, 7.0), (5.0,)), tick, Estimate(x=(7.5, 7.0)))
    >>> float(v)  # bias + Kc (r - y)
    7.0
    """

    model: Plant
    Kc: np.ndarray = leaf(
        "V/cm", "gain Kc, not 0; below 0 where a pump lowers its output", shape="output"
    )
    Ti: np.ndarray | None = option("s", "integral time Ti; inf: none", **POSITIVE, infinite=True)
    Td: np.ndarray | None = option("s", "derivative time Td", **POSITIVE)
    order: np.ndarray | None = option("-", "order of the integral (lambda)", **POSITIVE, high=1.0)
    Tt: np.ndarray | None = option(
        "s", "tracking time of back-calculation; left out: Ti, also where that is tuned", **POSITIVE
    )
    b: np.ndarray | None = option(
        "-", "weight of the setpoint in the proportional part; left out: 1", low=0.0
    )
    deadband: np.ndarray | None = option(
        "cm", "errors up to it, of either sign, count as 0", low=0.0
    )
    gap_gain: np.ndarray | None = option(
        "-", "share of the gain within the deadband (gap control); left out: 0", low=0.0, high=1.0
    )
    error_span: np.ndarray | None = option(
        "cm",
        "the error counts squared, and as itself at this size; left out: as itself",
        **POSITIVE,
    )
    N: np.ndarray | None = option(
        "-", "the derivative is filtered by a lag of Td/N; left out: 8", **POSITIVE
    )
    inflow_gain: np.ndarray | None = option(
        "V s/cm^3", "input added for a unit of the measured inflow; left out: no inflow is measured"
    )
    inflow_of: tuple = static(
        "-", "the tank of the measured inflow of each output; left out: its own", default=()
    )
    action: str = static(
        "-",
        "direct: the input rises with the level (Kc above 0 counts as -Kc); reverse: it falls",
        choices=("reverse", "direct"),
        default="reverse",
    )
    bias: np.ndarray = leaf("V", "input added where there is no feed-forward", shape="output")
    feed_forward: bool = static(
        "-", "add the model's input on the reference", choices=(False, True), default=False
    )
    anti_windup: str = static(
        "-",
        "what the integral does while an input is at a limit",
        choices=("back-calculation", "clamping", "conditioned"),
        default="back-calculation",
    )

    def __post_init__(self) -> None:
        Ti: Any = self.Ti
        concrete = isinstance(Ti, np.ndarray | jax.Array) and not isinstance(Ti, Tracer)
        if not concrete or not np.size(Ti):
            return
        Tt = cast(Any, self.Tt)  # Ti may be as good as infinite beside it
        tracking = isinstance(Tt, np.ndarray | jax.Array) and not isinstance(Tt, Tracer)
        endless = np.isinf(np.asarray(Ti)) | (np.asarray(ENDLESS * Tt <= Ti) if tracking else False)
        if np.all(endless):
            object.__setattr__(self, "Ti", None)  # no state that never moves
        elif np.any(endless) and np.shape(Ti)[-1] > 1:  # `track` reads inf of several loops alone
            object.__setattr__(self, "Ti", np.where(endless, np.inf, Ti))

    @property
    def arrays(self) -> bool:
        """Vectors of many tanks may be arrays, but with feed-forward and of fractional order."""
        return not self.feed_forward and self.order is None

    def inputs_of(self, output: int) -> tuple[int, ...]:
        """Return the inputs that the loop of an output moves."""
        return (output,)

    def joint_inputs(self) -> list[tuple[int, ...]]:
        several = [self.inputs_of(i) for i in range(len(self.model.outputs))]
        return [inputs for inputs in several if len(inputs) > 1]

    @property
    def reversed_inputs(self) -> tuple[int, ...]:
        """The inputs that fall where the loop's output rises."""
        return ()

    def metadata_of(self, field: str) -> dict[str, Any]:
        """Return changes of a field's metadata: what moves valves is an opening, without unit."""
        metadata = type(self).__dataclass_fields__[field].metadata
        unit, drive = metadata.get("unit"), self.model.units[1]
        if unit not in OF_OPENINGS or metadata.get("shape") != ("output",):
            return {}
        opens = [
            all(input_unit(self.model, j, drive) == "-" for j in self.inputs_of(i))
            for i in range(len(self.model.outputs))
        ]
        units = tuple(OF_OPENINGS[unit] if valve else unit for valve in opens)
        return {"entry_units": units, **({"unit": units[0]} if all(opens) else {})}

    @pointwise
    def prepare(self, r: tuple, dr: tuple, ddr: tuple) -> Any:
        if not self.feed_forward:
            return ()
        rows = zip(dr, drift(self.model, r), authority(self.model))
        return tuple((rate - f) / c for rate, f, c in rows)

    @property
    def reads_model(self) -> bool:
        return self.feed_forward

    @property
    def reads_inflow(self) -> bool:
        return self.inflow_gain is not None

    @property
    def signed_gain(self) -> Any:
        """Kc of e = r - y: below 0 of a direct action."""
        return self.Kc if self.action == "reverse" else -cast(Any, self.Kc)

    @property
    def inflow_tanks(self) -> tuple[int, ...]:
        """The tank of the measured inflow of each output."""
        return self.inflow_of or tuple(self.model.outputs)

    def init(self, x0: tuple, u0: tuple) -> Any:
        none: Any = each(lambda u: 0.0 * u, u0) if is_array(u0) else (0.0 * u0[0],) * len(u0)
        integral: Any = () if self.Ti is None else none
        if self.b is not None and self.Ti is not None:  # no bump where y = r
            y = take(x0, self.model.outputs)
            Kc, weight = self.signed_gain, self._weight()
            integral = each(lambda y, k, b: k * (1.0 - b) * y, y, Kc, weight)
        return Memory(
            integral=integral,
            slow=() if self.Td is None else take(x0, self.model.outputs),
            sections=() if self.order is None else tuple((z,) * (2 * SECTIONS + 1) for z in none),
            error=none,
        )

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        base = tick.plan if self.feed_forward else self.bias
        if self.feed_forward and estimate.d:
            pushed = zip(base, self.model.output(estimate.d), authority(self.model))
            base = tuple(u - d / c for u, d, c in pushed)
        if self.inflow_gain is not None and len(tick.inflow):
            inflow = take(tick.inflow, self.inflow_tanks)
            base = each(lambda d, k, b: b + k * d, inflow, self.inflow_gain, base)
        y, Kc = take(estimate.x, self.model.outputs), self.signed_gain
        e = self._counted(each(operator.sub, tick.r, y))
        if self.Ti is None:
            v = each(lambda e, b, k: b + k * e, e, base, Kc)
        else:
            v = each(lambda e, b, k, i: b + k * e + i, e, base, Kc, state.integral)
        if self.b is not None and self.Ti is not None:
            weight = self._weight()
            v = each(lambda v, r, k, b: v - k * (1.0 - b) * r, v, tick.r, Kc, weight)
        slow = state.slow
        if self.Td is not None:
            # the filtered derivative is N (y - slow)/Td, with a lag that is exact for a level held
            # over the sample; where that is shorter than the sample, the difference of a sample
            N = () if self.N is None else (self.N,)
            of = lambda n: n[0] if n else FILTER
            gain = lambda Td, n: jnp.minimum(of(n), Td / tick.dt)
            less = lambda v, k, y, s, Td, *n: v - (gain(Td, n) * k) * (y - s)
            v = each(less, v, Kc, y, slow, self.Td, *N)
            lag = lambda y, s, Td, *n: s + (1.0 - jnp.exp(-tick.dt * of(n) / Td)) * (y - s)
            slow = each(lag, y, slow, self.Td, *N)
        return v, state._replace(slow=slow, error=e)

    def _counted(self, e: Any) -> Any:
        """Errors as they count: less within the deadband, squared with an error span."""
        if self.gap_gain is not None:
            gap = lambda e, d, share: e - (1.0 - share) * clip(e, -d, d)
            e = each(gap, e, self.deadband, self.gap_gain)
        elif self.deadband is not None:
            e = each(lambda e, d: e - clip(e, -d, d), e, self.deadband)
        if self.error_span is not None:
            e = each(lambda e, span: e * jnp.abs(e) / span, e, self.error_span)
        return e

    def track(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        if self.Ti is None:
            return state
        Kc = self.signed_gain
        # of one loop an infinite Ti is None; of several, 1 s stands in and the integral stays 0
        several = np.shape(self.Ti)[-1:] != (1,)
        finite = lambda Ti: jnp.where(jnp.isinf(Ti), 1.0, Ti) if several else Ti
        unless_infinite = lambda Ti, i: jnp.where(jnp.isinf(Ti), 0.0, i) if several else i
        signals = command, applied, state.error
        if self.anti_windup == "back-calculation" and self.Tt is not None:
            tracked = lambda v, u, e, Ti, Tt, Kc: e + (finite(Ti) / (Tt * Kc)) * (u - v)
            w = each(tracked, *signals, self.Ti, self.Tt, Kc)
        elif self.anti_windup != "clamping":
            w = each(lambda v, u, e, Kc: e + (u - v) / Kc, *signals, Kc)
        else:
            clamped = lambda v, u, e, Kc: jnp.where(Kc * e * (v - u) > 0.0, 0.0, e)
            w = each(clamped, *signals, Kc)
        if self.order is None:
            moved = lambda w, i, Kc, Ti: unless_infinite(Ti, i + (tick.dt * Kc / finite(Ti)) * w)
            return state._replace(integral=each(moved, w, state.integral, Kc, self.Ti))
        return self._fractional(state, tick, w)

    def transfer(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        if self.Ti is None:
            return state
        several = np.shape(self.Ti)[-1:] != (1,)  # an infinite Ti keeps its integral at 0
        moves = lambda Ti: jnp.where(jnp.isinf(Ti), 0.0, 1.0) if several else 1.0
        move = lambda i, u, v, Ti: i + moves(Ti) * (u - v)
        integral = each(move, state.integral, applied, command, self.Ti)
        fresh = jax.tree.map(lambda s: 0.0 * s, state.sections)
        return state._replace(integral=integral, sections=fresh)

    @property
    def bumpless(self) -> bool:
        return self.Ti is not None and not np.any(np.isinf(cast(Any, self.Ti)))

    def _weight(self) -> Any:
        """Setpoint weights; 1 of a loop whose integral time is infinite."""
        Ti, b = cast(Any, self.Ti), cast(Any, self.b)
        return jnp.where(jnp.isinf(Ti), 1.0, b) if np.shape(Ti)[-1:] != (1,) else b

    def _fractional(self, state, tick, w):
        """The state after errors w (m,) at the input of fractional integrals."""
        integral, sections, order, Ti = [], [], cast(Any, self.order), cast(Any, self.Ti)
        Kc = self.signed_gain
        for i, error in enumerate(w):
            gain, poles, residues = oustaloup(1.0 - order[i])
            keep = jnp.exp(-poles * tick.dt)
            enter = residues * (1.0 - keep) / poles
            rate = gain * error + sum(state.sections[i])
            integral.append(state.integral[i] + tick.dt * Kc[i] * Ti[i] ** -order[i] * rate)
            now = enumerate(state.sections[i])
            sections.append(tuple(keep[j] * s + enter[j] * error for j, s in now))
        return state._replace(integral=tuple(integral), sections=tuple(sections))

    def check(self, reference: Signal) -> None:
        self.check_inputs()
        self.check_gains()

    def check_inputs(self) -> None:
        """Raise InputError unless there is an input for each output."""
        model, pumps = self.model, self.model.pumps
        outputs = len(model.outputs)
        if outputs == pumps:
            return
        more = ": name as many of its tanks in plant.outputs"
        if pumps > outputs:
            names = [name_of(model, "pump", j) or j + 1 for j in range(pumps)]
            lead = f"lead = {shortened(names[:outputs])}"
            shared = (
                " output, and the others hold their `initial`; several inputs that share one level"
                ' are kind = "split-range", with sequence = [the first, the second, ...]'
            )
            more = f": write {lead} in [controller], the input of each{shared}"
            if type(self) is not PID:  # which alone has it
                more = f'; kind = "pid" may have {lead}, the input of each{shared}'
        raise InputError(
            f"PID needs one pump per output: the model has {pumps} and {outputs}{more}"
        )

    def check_gains(self) -> None:
        """Raise InputError for gains that do not go together."""
        if isinstance(self.Kc, np.ndarray) and not np.all(self.Kc):
            raise InputError(
                f"controller.Kc = {self.Kc}: must not be 0; a negative gain is for a pump that"
                " lowers its output"
            )
        self._check_options()
        if self.Ti is None and self.order is not None:
            raise InputError("controller.order: needs an integral time, controller.Ti [s]")
        if self.b is not None and self.Ti is None:
            raise InputError(
                "controller.b: needs an integral time, controller.Ti [s]: without one a weight of"
                " the setpoint is an error that stays"
            )
        if self.feed_forward:
            check_own_pumps(self.model)

    def _check_options(self) -> None:
        """Raise InputError for an option without what it needs."""
        if self.action == "direct" and isinstance(self.Kc, np.ndarray) and np.any(self.Kc < 0):
            raise InputError(
                f'controller.Kc = {self.Kc}: must be above 0 with action = "direct", which turns'
                ' the sign; a negative Kc is the same with action = "reverse"'
            )
        if self.gap_gain is not None and self.deadband is None:
            raise InputError("controller.gap_gain: needs the half width, controller.deadband")
        if self.N is not None and self.Td is None:
            raise InputError("controller.N: needs a derivative time, controller.Td [s]")
        if self.inflow_of and len(self.inflow_of) != len(self.model.outputs):
            raise InputError(
                f"controller.inflow_of: must have a tank for each of {len(self.model.outputs)}"
                f" outputs, not {len(self.inflow_of)}"
            )
        if self.inflow_of and self.inflow_gain is None:
            raise InputError("controller.inflow_of: needs controller.inflow_gain")


class SharedPID(PID):
    """A PID per output that acts on the inputs by `shared`, whose inverse is `total`."""

    def shared(self, v: Any, inflow: Any = ()) -> tuple[Any, ...]:
        """Return the inputs (m,) of PID outputs v (outputs,) and measured inflows (n,), if any."""
        raise NotImplementedError

    def total(self, u: Any) -> tuple[Any, ...]:
        """Return the PID outputs (outputs,) of inputs u (m,)."""
        raise NotImplementedError

    def init(self, x0: tuple, u0: tuple) -> Any:
        return PID.init(self, x0, self.total(u0))

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        v, state = PID.step(self, state, tick, estimate)
        return self.shared(v, tick.inflow), state

    def track(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        return PID.track(self, state, tick, self.total(command), self.total(applied))

    def transfer(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        return PID.transfer(self, state, tick, self.total(command), self.total(applied))
