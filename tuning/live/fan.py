"""Many plants of a case at once for any setting of its free parameters, by one compiled program."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.core.tree import get_value, with_values
from jaxtank.loop import run as lp
from jaxtank.loop.derivatives import sensitivities_compiled
from jaxtank.loop.rows_and_measures import rows_and_measures
from tuning.problem.bounds import Bound, bounds
from tuning.problem.scenarios import COARSE, noisy
from tuning.problem.slopes import contradicted
from tuning.search.setting import plants_of
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.sampling import check_whole, probabilities

PLANTS = 200
"""Plants of a fan."""

MOST_PLANTS = 2000
"""Plants that a fan may have: each keeps its rows."""

ROWS = 240
"""Rows of a fan, about: as many as a picture can show."""

LONGEST = 3_000_000
"""Samples of all plants together above which a fan runs at a longer step."""

CUTS = (0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
"""Quantiles of a fan [-]; the last one is the highest of all plants."""

MEASURED = ("rms_error_total", "max_level", "overflow_volume")
"""Measures of each plant."""

MORE = 0.1
"""Change of a parameter whose effect is reported, as a share of its value [-]."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Moved:
    """A fan at one setting of the free parameters; made by `Fan.move`."""

    values: Mapping[str, float]
    t: np.ndarray
    r: np.ndarray
    x: np.ndarray
    u: np.ndarray
    measures: Mapping[str, np.ndarray]
    nominal: Mapping[str, np.ndarray]
    slopes: Mapping[str, np.ndarray]
    steps: np.ndarray
    changes: Mapping[str, np.ndarray]
    failed: np.ndarray


class Fan:
    """A case on `plants` plants drawn from what it calls uncertain, ready to run at any setting."""

    # The plants and their sensor noise are those of `tuning.ensemble(case, samples=plants,
    # key=seed)`.

    def __init__(
        self, case: Case, free: Mapping[str, Any] | None = None, plants: int = PLANTS, seed: int = 0
    ):
        check_whole("plants", plants, 1, MOST_PLANTS)
        check_whole("seed", seed, 0, 2**31 - 1)
        self.bounds: list[Bound] = bounds(case.loop, dict(case.free if free is None else free))
        self.given, self.case, self.plants = case, quick(case, plants), plants
        lp.check(self.case.loop, self.case.clock, jax.random.key(seed))
        draws = Draws(case.loop, plants_of(case))
        self.rows = draws.values(probabilities("random", draws.dimensions, plants, seed))
        self.keys = None
        if noisy(case):
            numbers = np.arange(plants, dtype=np.uint32)
            self.keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(seed), i))(numbers)
        self.measured = tuple(m for m in MEASURED if ms.serves(m, case.loop))
        self.every = max(1, (self.case.clock.samples - 1) // ROWS)
        self.program = jax.jit(self._program)

    @property
    def start(self) -> dict[str, float]:
        """The values of the case, within the ranges."""
        own = {b.name: float(np.asarray(get_value(self.given.loop, b.name))) for b in self.bounds}
        return {b.name: float(np.clip(own[b.name], b.low, b.high)) for b in self.bounds}

    def move(self, values: Mapping[str, float] | None = None) -> Moved:
        """Return the fan at `values`; parameters that are not named keep the values of the case."""
        # Raises InputError for a name that is not free, and a value outside its range.
        values = self._checked(values or {})
        with jax.enable_x64(True):
            found = self.program(self.case.loop, self.rows, self.keys, values)
        rows, measures, broken, nominal, slopes, beside = jax.tree.map(np.asarray, found)
        good = ~broken
        x, u = (_quantiles(v, good) for v in (rows.x, rows.u))
        # those of the reference are the same on every plant
        return Moved(
            values=values,
            t=rows.t[0],
            r=rows.r[0],
            x=x,
            u=u,
            measures=measures,
            nominal=nominal,
            slopes=slopes,
            steps=np.array([self._step(b, values[b.name]) for b in self.bounds]),
            changes={m: v - nominal[m] for m, v in beside.items()},
            failed=broken,
        )

    def _program(self, loop, rows, keys, values):
        """Rows and measures of every plant; measures and slopes of the plant of the case."""
        clock, names = self.case.clock, self.measured

        def one(own, key):
            here = with_values(with_values(loop, own), values)
            return rows_and_measures(here, clock, key, self.every, names)

        saved, measures, broken = jax.vmap(one, in_axes=(0, None if keys is None else 0))(
            rows, keys
        )
        key = None if keys is None else keys[0]
        order = tuple(b.name for b in self.bounds)  # that of `values` is by name inside jit
        at = tuple(values[name] for name in order)
        nominal, slopes, _, _ = sensitivities_compiled(loop, clock, names, order, at, key)

        def run(at):
            here = with_values(loop, dict(zip(order, at)))
            return lp.evaluate_and_flag(here, clock, names, key)[0]

        moves = jnp.diag(jnp.stack([self._step(b, v) for b, v in zip(self.bounds, at)]))
        beside = jax.vmap(jax.vmap(run))(jnp.stack(at) + jnp.stack([moves, -moves]))
        return saved, measures, broken, nominal, slopes, beside

    def _step(self, b: Bound, value: Any) -> Any:
        """The change by MORE of a parameter at a value."""
        return MORE * jnp.where(value == 0, b.high - b.low, jnp.abs(value))

    def _checked(self, values: Mapping[str, float]) -> dict[str, float]:
        """All values as numbers, in the order of the bounds."""
        known = self.start
        for name, value in values.items():
            if name not in known:
                raise InputError(f"{name} is not free: those are {', '.join(known)}")
            known[name] = float(value)
        for b in self.bounds:
            if not b.low <= known[b.name] <= b.high:
                raise InputError(
                    f"{b.name} = {known[b.name]:g} {b.unit}: must lie within"
                    f" {b.low:g} to {b.high:g} {b.unit}"
                )
        return known

    def case_at(self, values: Mapping[str, float]) -> Case:
        """Return the case, at its own step, with `values` set."""
        return self.given.replace(loop=with_values(self.given.loop, dict(values)))

    def over(self, moved: Moved) -> np.ndarray:
        """Return (plants, tanks) True where a level rises above its rim."""
        rims = np.asarray(self.case.loop.plant.rim, dtype=float)
        found = moved.measures["max_level"] > rims * (1.0 + 1e-9)
        if "overflow_volume" in moved.measures:
            found |= moved.measures["overflow_volume"] > 0
        return found | moved.failed[:, None]

    def sentences(self, moved: Moved) -> list[str]:
        """Return the fan in words: plants over a rim, error, effect of each parameter."""
        over, length = self.over(moved), self.case.loop.units[0]
        good = ~moved.failed
        share = 100.0 * over.any(axis=1).mean()
        line = f"{share:.3g} % of {self.plants} plants rise above a rim"
        if over.any():
            tank = int(np.argmax(over.mean(axis=0)))
            line += f" (most often tank {tank + 1}: {100.0 * over[:, tank].mean():.3g} %)"
        found = [line]
        if moved.failed.any():
            found.append(f"{int(moved.failed.sum())} of {self.plants} plants diverge")
        if good.any():
            error = moved.measures["rms_error_total"][good]
            found.append(
                f"rms error: mean {error.mean():.4g} {length}, worst {error.max():.4g} {length},"
                f" plant of the case {float(moved.nominal['rms_error_total']):.4g} {length}"
            )
        return found + [self._effect(moved, k, b) for k, b in enumerate(self.bounds)]

    def _effect(self, moved: Moved, k: int, b: Bound) -> str:
        """What 10 % more of one parameter changes."""
        value, length = moved.values[b.name], self.case.loop.units[0]
        by, names = moved.steps[k], ("rms_error_total", "max_level")
        words = f"10 % more {b.name}" if value else f"{b.name} + {by:.3g} {b.unit}"
        effects = {m: by * moved.slopes[m][..., k] for m in names}
        runs = {m: moved.changes[m][:, k] for m in names}
        note = ""
        if any(
            np.any(contradicted(np.stack([v, -v]), runs[m], moved.nominal[m]))
            for m, v in effects.items()
        ):
            effects = {m: change[0] for m, change in runs.items()}
            note = " (by a run: the derivative is that of a chaotic or exploding loop)"
        error, levels = (np.ravel(effects[m]) for m in names)
        if not (np.isfinite(error).all() and np.isfinite(levels).all()):
            return f"{words}: no effect to report, the run diverges"
        tank = int(np.argmax(np.abs(levels)))
        return (
            f"{words}: error {error[0]:+.2g} {length},"
            f" highest level {levels[tank]:+.2g} {length} at tank {tank + 1}{note}"
        )


def quick(case: Case, plants: int) -> Case:
    """Return the case at ten times its step, if all its plants have more than LONGEST samples and
    the longer step is allowed; else the case itself.
    """
    clock = dataclasses.replace(case.clock, dt=case.clock.dt * COARSE)
    if case.clock.samples * plants <= LONGEST or clock.samples < ROWS:
        return case
    try:
        found = case.replace(clock=clock)
        lp.check(found.loop, clock, jax.random.key(0))
        if case.loop.safety_filter is not None:  # it is designed for the step
            found = found.without_safety_filter().with_safety_filter(**(case.safety or {}))
        return found
    except InputError:  # a dead time that is no multiple of the longer step, for one
        return case


def _quantiles(values: np.ndarray, good: np.ndarray) -> np.ndarray:
    """(6, rows, n) quantiles CUTS of (plants, rows, n) over the plants that did not diverge."""
    if not good.any():
        return np.full((len(CUTS), *values.shape[1:]), np.nan)
    ordered = np.sort(values[good] if not good.all() else values, axis=0)
    places = np.asarray(CUTS) * (len(ordered) - 1)
    low = np.floor(places).astype(int)
    high, share = np.minimum(low + 1, len(ordered) - 1), (places - low)[:, None, None]
    return ordered[low] + share * (ordered[high] - ordered[low])
