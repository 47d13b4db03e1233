"""Bank of extended Kalman filters, one for each single fault of a rig, with their probabilities."""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.labels import label_of
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static, with_entries
from jaxtank.core.units import local
from jaxtank.observers.base import Observer
from jaxtank.observers.checks import check_model, check_tanks
from jaxtank.plants.base import Plant
from jaxtank.plants.runge_kutta import advance

RESTART = 1.0
"""Evidence against a fault at which its filter begins again [-]: its size is then still open, its
standard deviation a third of that before.
"""

LEAST = 0.1
"""Least size of a fault, as a share of the standard deviation of its size before it is known."""

ABSENT = 1e3  # evidence against the plug of an opening that the rig does not have [-]

FORGOTTEN = 1e5  # time in which a size gains its initial variance [s]: it may change

REPEATED = 0.05  # standard deviation of a repeated reading, as a share of that of the noise [-]


class Mode(NamedTuple):
    """A single fault: its kind, the leaf and entry of the model that it changes or the tank whose
    sensor it is of, and the sign that its size must have; 0: either.
    """

    kind: str
    field: str = ""
    index: int = 0
    sign: int = 0


class Bank(NamedTuple):
    """State of H filters of n levels and the size of a fault each."""

    z: Any  # (H, n + 1) levels [cm], size of the fault
    P: Any  # (H, n + 1, n + 1) their covariances
    score: Any  # (H,) logarithm of what each filter's probability is proportional to
    y: tuple  # (n) last readings [cm]
    u: tuple  # (m) last inputs within the pumps' limits [V]


@component
class FaultBank(Observer):
    """Extended Kalman filters in parallel, one of the rig without a fault and one for each single
    fault, with the probability of each: leak of a tank, plug of an outlet, orifice, pipe or valve,
    loss of a pump, offset and freeze of a sensor.

    The filter of a fault has its size as one more state s: the drain is drain + s a with a the
    largest opening of the rig (of a linear outlet the area with the same flow at half the highest
    rim; a thousandth of the largest cross-section where all are below a ten-thousandth of it), an
    orifice, pipe, valve or pump is (1 + s) times itself, and so is its linear outlet, a reading is
    h + s. A frozen sensor is not used, and its reading is predicted to be the last one. All
    filters begin at the same levels, with s = 0 and the standard deviation `share` (or `offset`
    of a sensor), and their logarithm of the likelihood,

        score += -1/2 sum_i (nu_i^2 / S_i + log S_i),

    makes their probabilities, p = P(|s| > LEAST, with its sign) exp(score) / sum. A filter that
    falls by RESTART below log(prior) of the most probable one begins again at its levels, or at
    the reading of a sensor that is wrong in that one alone: a fault may begin, and end, at any
    sample (Page's CUSUM test, 1954, with the size estimated). A run without faults has about
    `prior` false alarms for each restart, if process and measurement are what they say: an error
    of the model is a fault to the bank.

    The controller receives the mean of the levels over the filters, and the mean of what their
    faults add to the level rates, d [cm/s].

    Examples
    --------
    >>> from jaxtank.plants.rigs import johansson
    >>> observer = FaultBank(
    ...     model=johansson("minimum")[0],
    ...     process=[1e-5] * 4,
    ...     measurement=[0.01] * 4,
    ...     spread=[0.01] * 4,
    ...     measured=(0, 1, 2, 3),
    ... )
    >>> [mode.kind for mode in observer.modes][:3], len(observer.modes)
    (['none', 'leak', 'leak'], 21)
    """

    model: Plant
    process: np.ndarray = leaf(
        "cm^2/s",
        "variance that each level's own disturbance gains per second (Q)",
        low=0.0,
        shape="tank",
    )
    measurement: np.ndarray = leaf(
        "cm^2",
        "variance of each sensor's noise (r); of unmeasured tanks not used",
        **POSITIVE,
        shape="tank",
    )
    spread: np.ndarray = leaf(
        "cm^2", "variance of the initial estimate at t = 0", low=0.0, shape="tank"
    )
    share: float = leaf(
        "-",
        "standard deviation of the size of a fault of the plant before it is known",
        **POSITIVE,
        default=lambda known: 0.3,
    )
    offset: float = leaf(
        "cm",
        "standard deviation of a sensor's offset before it is known; left out: 1/30 of the rim",
        **POSITIVE,
        default=lambda known: float(np.max(np.asarray(known["model"].rim))) / 30.0,
    )
    prior: float = leaf(
        "-",
        "probability of each fault before there is evidence of it",
        **POSITIVE,
        default=lambda known: 1e-6,
    )
    measured: tuple = static(doc="tanks whose levels are measured, counted from 0")
    freezes: bool = static(
        doc="whether a sensor may freeze; noise tells its reading from a level at rest",
        choices=(True, False),
        default=True,
    )
    integrator: str = static(
        doc="how the model is integrated", choices=("rk4", "midpoint"), default="midpoint"
    )

    @property
    def modes(self) -> list[Mode]:
        """The mode without a fault, then every single fault."""
        model, n = cast(Any, self.model), range(self.model.tanks)
        counts = {"orifice": len(model.links), "pipe": len(model.pipes)}
        counts["valve"] = len(model.valves)
        return [
            Mode("none"),
            *(Mode("leak", "drain", i, 1) for i in n),
            *(Mode("plug", "drain", i, -1) for i in n),
            *(Mode("plug", field, k, -1) for field, m in counts.items() for k in range(m)),
            *(Mode("pump loss", "pump_gain", j, -1) for j in range(len(model.feeds))),
            *(Mode("offset", "", i) for i in self.measured),
            *(Mode("freeze", "", i) for i in self.measured if self.freezes),
        ]

    def init(self, x0: tuple) -> Any:
        count, n = len(self.modes), range(len(x0))
        zero = jnp.zeros(count) + 0.0 * x0[0]
        spread = [*(self.spread[i] + zero for i in n), self._prior(zero)]
        score = zero + jnp.log(self.prior) * (np.arange(count) > 0)
        still = (0.0 * x0[0],) * self.model.pumps
        P = jnp.stack(spread, axis=1)[:, :, None] * np.eye(len(x0) + 1)
        return Bank(jnp.stack([*(zero + h for h in x0), zero], axis=1), P, score, x0, still)

    def _prior(self, zero):
        """(H,) variances of the sizes before they are known."""
        kinds = [mode.kind for mode in self.modes]
        of = {"none": 0.0, "freeze": 0.0, "offset": self.offset**2}
        return jnp.stack([zero[0] + of.get(kind, self.share**2) for kind in kinds])

    def _masks(self):
        """Per mode, 1 where the offset and the freeze are of a tank: arrays (n, H)."""
        n = range(self.model.tanks)
        return (
            np.array([[float(m.kind == kind and m.index == i) for m in self.modes] for i in n])
            for kind in ("offset", "freeze")
        )

    def _totals(self, state):
        """(H,) scores with the logarithm of the probability that each size is one of its fault."""
        z, variance, prior = state.z[:, -1], state.P[:, -1, -1], self._prior(0.0 * state.score)
        signs = np.array([float(mode.sign) for mode in self.modes])
        # a root of 0 has no slope: modes without a size are left out by `sized` alone
        sized = np.array([mode.kind not in ("none", "freeze") for mode in self.modes])
        before, now = (jnp.where(sized, v, 1.0) for v in (prior, variance))
        size, least = jnp.where(signs == 0.0, jnp.abs(z), signs * z), LEAST * jnp.sqrt(before)
        # the logistic function in place of the normal distribution's, within 1 %
        ratio = 1.702 * (size - least) / jnp.sqrt(now)
        likely = jax.nn.log_sigmoid(ratio) - jax.nn.log_sigmoid(-1.702 * LEAST)
        impossible = jnp.stack([0.0 * z[0] + absent for absent in self._absent()])
        return state.score + jnp.where(sized, likely, 0.0) - ABSENT * impossible

    def step(self, state: Any, tick: Tick, y: Sequence) -> tuple[Estimate, Any]:
        z, P, score = state.z, state.P, state.score
        offsets, freezes = self._masks()
        for i in self.measured:
            of, frozen, r = offsets[i], freezes[i], self.measurement[i]
            PH = P[:, :, i] + of[:, None] * P[:, :, -1]
            S = jnp.where(frozen > 0.0, REPEATED**2 * r, PH[:, i] + of * PH[:, -1] + r)
            nu = jnp.where(frozen > 0.0, y[i] - state.y[i], y[i] - z[:, i] - of * z[:, -1])
            K = PH * ((1.0 - frozen) / S)[:, None]
            z = z + K * nu[:, None]
            P = _symmetric(P - K[:, :, None] * PH[:, None, :])
            score = score - 0.5 * (nu * nu / S + jnp.log(S))
        state = Bank(z, P, score, tuple(y), state.u)
        state = state._replace(score=score - jnp.max(self._totals(state)))
        p = jax.nn.softmax(self._totals(state))
        levels = tuple(jnp.sum(p * z[:, i]) for i in range(len(y)))
        d = tuple(jnp.sum(p * v) for v in self._added(state))
        modes = jnp.concatenate([p, self._sizes(z[:, -1])])
        return Estimate(x=levels, d=d, modes=modes), self._restarted(state)

    def _restarted(self, state):
        """The state with the filters that have fallen behind begun again."""
        totals, zero = self._totals(state), 0.0 * state.score
        best, n = jnp.arange(len(self.modes)) == jnp.argmax(totals), len(state.y)
        of_best = lambda v: jnp.sum(
            jnp.where(best.reshape(-1, *[1] * (v.ndim - 1)), v, 0.0), axis=0
        )
        again = totals < jnp.log(self.prior) - RESTART
        # without a wrong sensor its reading is the level
        doubted = [of_best(a + b) > 0.0 for a, b in zip(*map(jnp.asarray, self._masks()))]
        doubted = jnp.stack(doubted)
        z = jnp.where(doubted, jnp.stack(state.y), of_best(state.z[:, :-1]))
        noise = jnp.asarray(self.measurement) * np.eye(n)
        P = jnp.where(doubted[:, None] | doubted, noise, of_best(state.P[:, :-1, :-1]))
        z = jnp.append(z + zero[:, None], zero[:, None], axis=1)
        last = self._prior(zero)[:, None, None] * np.diag([0.0] * n + [1.0])
        P = jnp.pad(P, (0, 1)) + last
        return state._replace(
            z=jnp.where(again[:, None], z, state.z),
            P=jnp.where(again[:, None, None], P, state.P),
            score=jnp.where(again, jnp.log(self.prior), state.score),
        )

    def _faulty(self, s, mode):
        """The model with the fault of a mode, of size s; mode: (H,) 1 at its place, else 0."""
        changes = []
        for k, ((kind, field, i, _), scale) in enumerate(zip(self.modes, self._scales())):
            if field:
                add = lambda value, k=k, scale=scale: value + mode[k] * s * scale
                changes.append((f"{field}[{i}]", add))
            if kind == "plug" and self._resistance(field) is not None:
                more = lambda value, k=k: _narrowed(value, mode[k] * s)
                changes.append((f"{field}_resistance[{i}]", more))
        return with_entries(self.model, changes)

    def _resistance(self, field):
        """(entries,) resistances of the linear outlets beside openings; None: there are none."""
        return getattr(self.model, f"{field}_resistance", None)

    def _openings(self, field):
        """(entries,) areas of openings, with those of what is linear beside them."""
        model = cast(Any, self.model)
        area, resistance = jnp.asarray(getattr(model, field)), self._resistance(field)
        if resistance is None:
            return area
        head = 0.5 * jnp.max(jnp.asarray(model.rim))
        return area + jnp.sqrt(0.5 * head / model.gravity) / jnp.asarray(resistance)

    def _scales(self):
        """What a size of 1 adds to the entry of each mode: the largest opening to a leak's."""
        model = cast(Any, self.model)
        fields = [name for name in ("drain", "orifice", "pipe", "valve") if hasattr(model, name)]
        openings = [self._openings(name) for name in fields if getattr(model, name) is not None]
        largest = jnp.max(jnp.concatenate(openings))
        section = jnp.max(jnp.asarray(model.area))
        largest = jnp.where(largest > 1e-4 * section, largest, 1e-3 * section)
        of = lambda mode: getattr(model, mode.field)[mode.index] if mode.field else 1.0
        return [largest if mode.kind == "leak" else of(mode) for mode in self.modes]

    def _absent(self):
        """Whether each mode is of an opening or a pump that the rig does not have."""
        sizes = {field: self._openings(field) for kind, field, *_ in self.modes if kind == "plug"}
        sizes["pump_gain"] = cast(Any, self.model).pump_gain
        return [
            sizes[mode.field][mode.index] == 0.0 if mode.kind in ("plug", "pump loss") else False
            for mode in self.modes
        ]

    def _added(self, state):
        """(n) arrays (H,) of what the faults add to the level rates [cm/s]."""

        def added(z, mode):
            plants = self._faulty(z[-1], mode), self.model
            rates = [plant.derivative(0.0, tuple(z[:-1]), state.u, None) for plant in plants]
            return tuple(a - b for a, b in zip(*rates))

        return jax.vmap(added)(state.z, np.eye(len(self.modes)))

    def predict(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        n = len(state.y)

        def moved(z, mode):
            """((n + 1) state, its (n + 1, n + 1) derivative); the size of a fault stays."""

            def onward(z):
                x, plant = tuple(z[:-1]), self._faulty(z[-1], mode)
                x = advance(plant, self.integrator, tick.t, x, applied, None, tick.dt, 1).x
                return jnp.stack([*x, z[-1]])

            along = lambda direction: jax.jvp(onward, (z,), (direction,))[1]
            return onward(z), jax.vmap(along, out_axes=1)(np.eye(n + 1))

        z, F = jax.vmap(moved)(state.z, np.eye(len(self.modes)))
        FP = jnp.sum(F[:, :, :, None] * state.P[:, None, :, :], axis=2)
        P = jnp.sum(FP[:, :, None, :] * F[:, None, :, :], axis=3)
        zero = 0.0 * state.score
        gained = [*(self.process[i] + zero for i in range(n)), self._prior(zero) / FORGOTTEN]
        P = P + tick.dt * jnp.stack(gained, axis=1)[:, :, None] * np.eye(n + 1)
        return state._replace(z=z, P=_symmetric(P), u=tuple(applied))

    def check(self, plant: Plant) -> None:
        check_model(self, plant)
        check_tanks(self, "measured", plant)
        if not all(hasattr(self.model, name) for name in ("links", "pipes", "valves", "feeds")):
            raise InputError("observer fault-bank: needs the model of a rig of tanks (TankNetwork)")

    def mode_names(self, plant: Plant) -> tuple[tuple[str, str], ...]:
        units = {"leak": local("cm^2", plant.units), "offset": plant.units[0], "freeze": ""}
        return tuple((_name(mode, plant), units.get(mode.kind, "-")) for mode in self.modes)

    def _sizes(self, s):
        """(H,) sizes as reports have them: area of a leak, share that is lost, offset."""
        by = {"leak": self._scales()[1], "plug": -1.0, "pump loss": -1.0}
        return jnp.stack([s[k] * by.get(mode.kind, 1.0) for k, mode in enumerate(self.modes)])


def _narrowed(resistance, s):
    """The resistance of a linear outlet that is (1 + s) times as wide; inf: there is none."""
    finite = jnp.isfinite(resistance)
    wide = jnp.maximum(1.0 + s, 1e-3)
    return jnp.where(finite, jnp.where(finite, resistance, 1.0) / wide, resistance)


def _symmetric(P):
    """(H, N, N) matrices without what round-off makes of their symmetry."""
    return 0.5 * (P + jnp.swapaxes(P, 1, 2))


def _name(mode, plant):
    """What reports call a mode."""
    if mode.kind == "none":
        return "none"
    if mode.field == "drain" or not mode.field:
        tank = label_of(plant, "tank", mode.index)
        return {
            "leak": f"leak of {tank}",
            "plug": f"plug of the outlet of {tank}",
            "offset": f"offset of the sensor of {tank}",
            "freeze": f"freeze of the sensor of {tank}",
        }[mode.kind]
    if mode.field == "pump_gain":
        return f"loss of {label_of(plant, 'pump', mode.index)}"
    if mode.field == "valve":
        return f"plug of {label_of(plant, 'pump', len(plant.feeds) + mode.index)}"
    ends = plant.links[mode.index] if mode.field == "orifice" else plant.pipes[mode.index]
    first, second = (label_of(plant, "tank", i) for i in ends)
    return f"plug of the {mode.field} from {first} to {second}"
