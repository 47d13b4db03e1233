"""A case whose coefficients, start and readings are variables of the unit cube."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.case import Case
from jaxtank.controllers import OpenLoop
from jaxtank.core.clock import CHUNK, Clock, pointwise, sample_times
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import clip, lower_clip, smooth_sqrt
from jaxtank.core.tree import component, get_value, leaf, split_index, static, with_values
from jaxtank.instruments.base import Sensor
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.limits import without_overflow
from jaxtank.loop.closed_loop import ClosedLoop, initial, inputs, is_broken
from jaxtank.loop.step import step
from jaxtank.plants.faults import Faults
from jaxtank.safety.box import band_of, top_of
from jaxtank.safety.filter import SHALLOW, SafetyFilter
from jaxtank.safety.of_case import FLOWS
from jaxtank.safety.worst_case import rates_of
from jaxtank.signals.base import Table
from jaxtank.xla.hoist import scan
from tuning.uncertainty.distributions import Discrete, stated
from tuning.uncertainty.draws import ends_of
from tuning.uncertainty.sampling import spread_of


class Coefficient(NamedTuple):
    """One number of the loop and its interval, in its own unit."""

    name: str
    nominal: float
    low: float
    high: float
    varies: bool


def coefficients_of(case: Any, distributions: Any = None) -> list[Coefficient]:
    """Return the coefficients of a case that lie in intervals, with their intervals."""
    loop = case.loop
    if distributions is None:
        coefficients = own_coefficients(case)
    else:
        distributions = stated(distributions, loop)
        if chosen := [name for name in distributions if is_chosen(name)]:
            raise InputError(
                f"attack chooses starts and reading errors itself: leave out {', '.join(chosen)};"
                " --start own keeps to the case's start, and --set sensor.noise=VALUE widens the"
                " errors"
            )
        coefficients = _coefficients(loop, _intervals(loop, distributions))
    if not coefficients:
        raise InputError(
            f"attack {case.name}: no interval is wider than 0: name what varies, as --spread 0.05"
            " or --vary plant.drain=uniform:5%"
        )
    return coefficients


def _coefficients(loop, ends):
    return [c for name, (a, b) in ends.items() for c in _entries(loop, name, a, b)]


def own_coefficients(case: Any) -> list[Coefficient]:
    """Return the Coefficients of the tolerances of a case: those of which a proof may be."""
    return _coefficients(case.loop, _ends_of_box(case))


def _ends_of_box(case):
    """{name: (low, high)} of the filter's box, and of other uncertain parameters of the case."""
    safety_filter = filter_or_design(case)
    if safety_filter is None:
        return _intervals(case.loop, spread_of(case))
    least, most = safety_filter.least, safety_filter.most
    leaves = [f.name for f in dataclasses.fields(least) if f.metadata.get("kind") == "leaf"]
    names = [name for name in leaves if getattr(least, name) is not None]
    ends = {f"plant.{name}": (getattr(least, name), getattr(most, name)) for name in names}
    others = {n: s for n, s in case.uncertain.items() if not n.startswith("plant.")}
    return ends | (_intervals(case.loop, stated(others)) if others else {})


def filter_or_design(case: Any) -> Any:
    """Return the safety filter of a case, or the one that fits it; None without a tank network."""
    if case.loop.safety_filter is not None:
        return case.loop.safety_filter
    try:
        return case.safety_design()[0]
    except InputError:
        return None


def is_chosen(name: str) -> bool:
    """Return whether a parameter is of the start or the sensors, which an attack varies itself."""
    return split_index(name)[0].split(".")[0] in ("sensor", "x0")


def _intervals(loop, distributions):
    """{name: (low, high)} of {name: distribution}, without those of the start and the sensors."""
    for name, distribution in distributions.items():
        if isinstance(distribution, Discrete):
            raise InputError(f"attack: {name} is discrete: must have an interval, as uniform:5%")
    return {n: pair for n, pair in ends_of(loop, distributions).items() if not is_chosen(n)}


def _entries(loop, name, low, high):
    """The Coefficients of the entries of one parameter whose interval has a width."""
    base, index = split_index(name)
    whole = np.asarray(get_value(loop, base), dtype=float)
    nominal = np.asarray(get_value(loop, name), dtype=float)
    varies = base.removeprefix("plant.") in FLOWS and whole.ndim == 1
    low, high = (np.broadcast_to(np.asarray(v, dtype=float), nominal.shape) for v in (low, high))
    for at in np.ndindex(nominal.shape):
        splits_nothing = base == "plant.split" and loop.plant.feeds[(index or at)[0]][1] is None
        if high[at] > low[at] and not splits_nothing:
            entry = f"{base}[{','.join(map(str, index or at))}]" if index or at else base
            yield Coefficient(entry, float(nominal[at]), float(low[at]), float(high[at]), varies)


@component
class GivenErrors(Sensor):
    """Readings y = h + error, a given error of each sample; an ADC reads no more than `top`."""

    error: Any = leaf("cm", "error of each tank's reading at each sample", shape=("sample", "tank"))
    top: tuple = static("cm", "highest level that can be read, None without an ADC")

    def draw(self, key: Any, samples: int, piece: Any = None) -> tuple[Any, ...]:
        """Return the (n) errors (samples,) [cm] of a run, or of the chunk `piece` of it."""
        error = jnp.asarray(self.error)
        if piece is not None:
            error = jax.lax.dynamic_slice_in_dim(error, piece * CHUNK, samples, 1)
        return tuple(error[i, :samples] for i in range(error.shape[0]))

    def step(self, state: Any, x: Any, xi: Any, dt: Any) -> tuple[Sequence[Any], Any]:
        y = tuple(h + e for h, e in zip(x, xi))
        return tuple(v if t is None else clip(v, 0.0, t) for v, t in zip(y, self.top)), state


@component
class Course:
    """Entries of the plant, constant over equal windows and unknown to controller and filter."""

    value: Any = leaf(
        "-", "value of each entry in each window, in its own unit", shape=("window", "entry")
    )
    length: Any = leaf("s", "length of a window", low=0.0, strict=True)
    names: tuple[str, ...] = static(doc="entries of the plant, as drain[1]")
    then: Faults | None = None

    @pointwise
    def sample(self, clock: Clock) -> tuple[Any, Any]:
        """Return (values (samples,) of each entry, samples of the faults that follow)."""
        value = jnp.asarray(self.value)
        window = _window(clock, self.length, value.shape[1])
        now = tuple(value[i, window] for i in range(value.shape[0]))
        return now, () if self.then is None else self.then.sample(clock)

    def apply(self, plant: Any, active: Sequence[Any]) -> Any:
        """Return the plant of a sample; active: a sample of `sample`."""
        now, then = active
        changed = {}
        for name, v in zip(self.names, now):
            field, (index,) = split_index(name)
            value = getattr(plant, field)
            changed.setdefault(field, [value[i] for i in range(len(value))])[index] = v
        plant = dataclasses.replace(plant, **{f: tuple(e) for f, e in changed.items()})
        return plant if self.then is None else self.then.apply(plant, then)


def _window(clock, length, count):
    """(samples,) index of the window of `length` [s] in which each sample lies."""
    window = jnp.floor((sample_times(clock) + 1e-7 * clock.dt) / length).astype(int)
    return jnp.clip(window, 0, count - 1)


SWITCHES = 64  # windows of the commands in place of a controller's
MEMORY = 1 << 29  # bytes that the states of a batch of runs may take for reverse mode


class Levels(NamedTuple):
    """Highest level to which each tank rose after the start (n,) [cm], and when (n,) [s]."""

    highest: Any
    time: Any


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Attacked:
    """A case as a function of variables in the unit cube."""

    case: Case
    coefficients: list[Coefficient]
    windows: int
    pumps: str
    start: str
    noise: bool
    ceiling: np.ndarray
    band: np.ndarray = dataclasses.field(init=False)
    shapes: dict[str, tuple] = dataclasses.field(init=False)
    original: Case = dataclasses.field(init=False)
    physical_rims: bool = dataclasses.field(init=False)

    def __post_init__(self):
        case, loop = self.case, without_overflow(self.case.loop)
        original, physical_rims = case.replace(loop=loop), bool(case.loop.plant.overflow)
        if self.pumps != "own":
            loop = _without_controller(loop, case.clock)
        band, tanks = reading_band(loop), loop.plant.tanks
        varying = [c for c in self.coefficients if c.varies]
        constant = [c for c in self.coefficients if not c.varies]
        read, noisy = np.any(band > 0.0), np.any(band > 0.0) and self.noise
        shapes = {
            "varying": (len(varying), self.windows),
            "constant": (len(constant),),
            **({"start": (tanks,)} if self.start == "any" else {}),
            **({"bias": (tanks,)} if read else {}),
            **({"noise": (tanks, case.clock.samples)} if noisy else {}),
            **({"command": (SWITCHES, loop.plant.pumps)} if self.pumps == "random" else {}),
        }
        vars(self).update(  # the fields of a frozen class
            original=original,
            physical_rims=physical_rims,
            case=case.replace(loop=loop),
            coefficients=[*varying, *constant],
            band=band,
            shapes=shapes,
        )

    def nominal(self) -> dict[str, np.ndarray]:
        """Return the values (see `values`) of the unchanged case, without reading errors."""
        nominal, varying = np.array([c.nominal for c in self.coefficients]), self.shapes["varying"]
        loop, clock = self.case.loop, self.case.clock
        values = {
            "varying": np.repeat(nominal[: varying[0], None], self.windows, axis=1),
            "constant": nominal[varying[0] :],
            "x0": np.asarray(loop.x0, dtype=float),
        }
        if "bias" in self.shapes:
            values["error"] = np.zeros((loop.plant.tanks, clock.samples if self.noise else 1))
        if self.pumps != "own":
            full = _commands(self.original.loop)[2]
            values["command"] = np.repeat(full[None], SWITCHES, axis=0)
        return values

    def values(self, z: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values that variables z in the unit cube stand for."""
        loop, n = self.case.loop, self.shapes["varying"][0]
        low, high = (np.array([c[i] for c in self.coefficients]) for i in (2, 3))
        values = {
            "varying": low[:n, None] + (high - low)[:n, None] * z["varying"],
            "constant": low[n:] + (high - low)[n:] * z["constant"],
            "x0": self._start(z["start"]) if "start" in z else jnp.asarray(loop.x0),
        }
        if "bias" in z:
            error = (2.0 * z["bias"] - 1.0)[:, None]
            if "noise" in z:
                error = clip(error + (2.0 * z["noise"] - 1.0), -1.0, 1.0)
            values["error"] = self.band[:, None] * error
        if self.pumps != "own":
            low, high, full = _commands(self.original.loop)
            share = z["command"] if "command" in z else np.ones((SWITCHES, 1))
            values["command"] = low + (high - low) * share if "command" in z else full * share
        return values

    def _start(self, z):
        """Levels (n,) [cm] at t = 0; tanks above a row of second order are lowered until g >= 0."""
        safety_filter = self.case.loop.safety_filter
        x = [top * share for top, share in zip(self.ceiling, z)]
        if not isinstance(safety_filter, SafetyFilter):
            return jnp.stack(x)
        rates = rates_of(safety_filter.least, safety_filter.most, safety_filter.inflow, 0.0)
        root = lambda h: smooth_sqrt(h, rates.knee)
        for i in (i for i in safety_filter.held if safety_filter.slope[i] > 0.0):
            top, slope = safety_filter.limit[i], safety_filter.slope[i]
            sources = [(j, most) for j, sink, _, most in rates.links if sink == i]
            least = SHALLOW * root(top)
            may = rates.out[i] * root(x[i]) + slope * (top - x[i])
            does = sum(most * lower_clip(root(x[j]), least) for j, most in sources)
            share = jnp.where(does > may, may / does, 1.0) * (1.0 - 1e-9)
            for j, _ in sources:
                x[j] = x[j] * share**2
        return jnp.stack(x)

    def loop_of(self, values: Mapping[str, Any]) -> ClosedLoop:
        """Return the loop with these values; coefficients of the plant are faults of it."""
        loop: Any = self.case.loop
        n, clock = self.shapes["varying"][0], self.case.clock
        constant = list(zip(self.coefficients[n:], values["constant"]))
        loop = with_values(loop, {c.name: v for c, v in constant if not of_plant(c)})
        whole = [(c, jnp.broadcast_to(v, (self.windows,))) for c, v in constant if of_plant(c)]
        rows = [*zip(self.coefficients, values["varying"]), *whole]
        changes = {"x0": values["x0"]}
        if rows:
            changes["faults"] = Course(
                value=jnp.stack([row for _, row in rows]),
                names=tuple(c.name.removeprefix("plant.") for c, _ in rows),
                length=(clock.duration + clock.dt) / self.windows,
                then=loop.faults,
            )
        if "error" in values:
            error = jnp.broadcast_to(values["error"], (loop.plant.tanks, clock.samples))
            changes["sensor"] = GivenErrors(error=error, top=_tops(loop))
        if "command" in values:
            signal = dataclasses.replace(loop.controller.signal, values=values["command"].T)
            changes["controller"] = OpenLoop(signal=signal)
        return dataclasses.replace(loop, **changes)

    def levels(self, values: Mapping[str, Any], checkpoint: bool = False) -> Levels:
        """Return the highest levels of a run with these values; -inf where the run diverged."""
        loop, clock = self.loop_of(values), self.case.clock
        state = initial(loop, clock)
        none = tuple(jnp.full_like(x, -jnp.inf) for x in state.x)

        def body(carry, now):
            state, before, highest, time = carry
            after, sample = step(loop, clock, state, now)
            above = [(x > old) & (x > top) for x, old, top in zip(sample.x, before, highest)]
            highest = tuple(jnp.where(a, x, top) for a, x, top in zip(above, sample.x, highest))
            time = tuple(jnp.where(a, sample.t, t) for a, t in zip(above, time))
            return (after, sample.x, highest, time), None

        body = jax.checkpoint(body) if checkpoint else body
        known = inputs(loop, clock, (), None)
        carry = (state, state.x, none, none)
        (state, last, highest, time), _ = scan(body, carry, known, length=clock.samples)
        rose = [jnp.isfinite(top) for top in highest]
        end = (clock.samples - 1) * clock.dt
        highest = jnp.stack([jnp.where(r, top, x) for r, top, x in zip(rose, highest, last)])
        time = jnp.stack([jnp.where(r, t, end) for r, t in zip(rose, time)])
        return Levels(jnp.where(is_broken(state), -jnp.inf, highest), time)

    def objective(self, z: Mapping[str, Any], tank: Any) -> tuple[Any, Levels]:
        """Return (highest level of one tank [cm], Levels) of a run with variables z."""
        levels = self.levels(self.values(z), checkpoint=True)
        return levels.highest[tank], levels


def of_plant(coefficient: Coefficient) -> bool:
    return coefficient.name.startswith("plant.") and len(split_index(coefficient.name)[1]) == 1


def reading_band(loop: ClosedLoop) -> np.ndarray:
    """Largest errors (n,) of readings [cm]: noise (6 sd), ADC and offset, or the filter's band."""
    sensor, safety_filter = loop.sensor, loop.safety_filter
    band = band_of(sensor) if isinstance(sensor, LevelSensor) else 6.0 * np.asarray(sensor.noise)
    band = np.broadcast_to(band, (loop.plant.tanks,))
    return band if safety_filter is None else np.maximum(band, np.asarray(safety_filter.band))


def _tops(loop):
    """(n) highest level that each sensor can read [cm], None without an ADC."""
    if not isinstance(loop.sensor, LevelSensor) or not loop.sensor.bits:
        return (None,) * loop.plant.tanks
    return tuple(float(v) for v in top_of(loop.sensor, loop.plant.tanks))


def _commands(loop):
    """(lowest, highest, full) commands (m,) in place of a controller's; inputs by hand stay."""
    low, high = (np.array(v, dtype=float) for v in (loop.actuator.low, loop.actuator.high))
    plant, controller = loop.plant, getattr(loop.controller, "law", loop.controller)
    for j in getattr(controller, "by_hand", ()):
        low[j] = high[j] = np.clip(np.asarray(controller.held)[j], low[j], high[j])
    sinks = [first for first, _ in getattr(plant, "feeds", ((0, None),) * len(low))]
    sinks += [sink for _, sink in getattr(plant, "valves", ())]
    empties = np.array([sink is None for sink in sinks])  # full of what only takes out of a tank
    return low, high, np.where(empties, low, high)


def _without_controller(loop, clock):
    """A loop with commands that are constant over windows, limited by its filter and pumps."""
    low, high = (np.asarray(v, dtype=float) for v in (loop.actuator.low, loop.actuator.high))
    if not np.all(np.isfinite([low, high])):
        raise InputError("attack: pumps other than the case's own need finite limits of the pumps")
    length = (clock.duration + clock.dt) / SWITCHES
    full = _commands(loop)[2]
    plan = OpenLoop(signal=Table(values=np.repeat(full[:, None], SWITCHES, 1), period=length))
    actuator = loop.actuator
    if actuator.allocates:  # by a controller's cost, which a plan has not
        actuator = dataclasses.replace(actuator, saturation="clip")
    return dataclasses.replace(loop, controller=plan, actuator=actuator)


def programs(attacked: Attacked) -> tuple[Any, Any]:
    """Compiled batches: (values) -> Levels; (variables, tanks) -> ((levels, Levels), slopes)."""
    slopes = jax.value_and_grad(attacked.objective, has_aux=True)
    return jax.jit(jax.vmap(attacked.levels)), jax.jit(jax.vmap(slopes))


def batch_size(attacked: Attacked, runs: int) -> int:
    """Return the number of runs of a batch: at most `runs`, and no more than MEMORY allows."""
    case = attacked.case
    state = jax.eval_shape(lambda: initial(case.loop, case.clock))
    numbers = sum(v.size for v in jax.tree.leaves(state)) + 9 * case.loop.plant.tanks
    return max(1, min(runs, MEMORY // (8 * numbers * case.clock.samples)))
