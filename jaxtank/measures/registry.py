"""The measures by name, and their properties; custom measures are registered here."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxtank.core.errors import InputError, unknown
from jaxtank.core.installed import imported, installed
from jaxtank.core.kahan import totals
from jaxtank.core.labels import input_unit
from jaxtank.core.records import Sample
from jaxtank.core.tree import shortened
from jaxtank.core.units import DEFAULT, local
from jaxtank.core.vectors import scalars
from jaxtank.measures.accumulators import ACCUMULATORS, Accumulator, Context, Run
from jaxtank.measures.catalogue import MEASURES, Measure
from jaxtank.measures.functions import from_function, functions
from jaxtank.xla.signatures import CUSTOM_MEASURES

BUILT_IN = frozenset(MEASURES)
GROUP = "jaxtank.measures"
"""Entry points by which an installed package names its measures: name = "package.module:object", a
Measure, or a function as in `from_function`.
"""
_COMPILED: dict[str, Measure] = {}
"""The last Measure registered under each name, also if the measure was deleted later."""

_NAME = re.compile(r"[A-Za-z]\w*")
_SIZES: dict[str, Callable[[Any], int]] = {
    "run": lambda plant: 1,
    "output": lambda plant: len(plant.outputs),
    "tank": lambda plant: plant.tanks,
    "pump": lambda plant: plant.pumps,
}


def register(
    name: str, measure: Measure, accumulators: Mapping[str, Accumulator] | None = None
) -> Measure:
    """Add a custom measure, known by `name` wherever measures are named from then on.

    `evaluate`, objectives, limits, ensembles, rig files, reports and the command (called from the
    same process) take it like any other.

    Parameters
    ----------
    name : str
        Letters, digits and "_"; a name that no built-in measure has.
    measure : Measure
    accumulators : {name: Accumulator}, optional
        What it needs in addition to `jaxtank.measures.ACCUMULATORS`. What is registered under a
        name again replaces what was there.

    Returns
    -------
    Measure
        The same.

    Raises
    ------
    InputError
        For a name that is taken, and a measure that no run could compute.

    Examples
    --------
    The mean absolute error of all outputs, whose sums the loop keeps already:

    >>> import jaxtank
    >>> from jaxtank import presets
    >>> from jaxtank.measures import Measure, register
    >>> mean = Measure(
    ...     "cm",
    ...     "run",
    ...     ("abs_e",),
    ...     lambda run, sums: sum(sums["abs_e"]) / ((run.samples - 1) * run.outputs),
    ...     "mean absolute tracking error",
    ... )
    >>> mean is register("mean_absolute_error", mean)
    True
    >>> loop = jaxtank.with_values(presets.load("cascaded/pi").loop, {"x0": 1.0})
    >>> clock = jaxtank.Clock(dt=4.0, duration=40.0)
    >>> values = jaxtank.evaluate(loop, clock, ["mean_absolute_error", "iae"])
    >>> print(round(float(values["iae"][0] / values["mean_absolute_error"]), 3))
    40.0
    >>> del jaxtank.measures.MEASURES["mean_absolute_error"]  # as it was before this example
    """
    added = dict(accumulators or {})
    _check_name("measure", name, BUILT_IN)
    for a, accumulator in added.items():
        _check_name("accumulator", a, _BUILT_IN_ACCUMULATORS)
        _check_accumulator(a, accumulator)
    _check_measure(name, measure, {**ACCUMULATORS, **added})
    replaced = _COMPILED.get(name, measure) != measure or any(
        ACCUMULATORS.get(a, accumulator) is not accumulator for a, accumulator in added.items()
    )
    if replaced:
        jax.clear_caches()  # compiled runs know a measure by its name
    ACCUMULATORS.update(added)
    MEASURES[name] = _COMPILED[name] = measure
    CUSTOM_MEASURES.add(name)
    return measure


_BUILT_IN_ACCUMULATORS = frozenset(ACCUMULATORS)


def _check_name(kind, name, taken):
    if not (isinstance(name, str) and _NAME.fullmatch(name)):
        raise InputError(
            f"{kind} {shortened(name)}: a name must be a text of letters, digits and _"
        )
    if name in taken:
        raise InputError(f"{kind} {name!r} is built in: choose another name")


def _check_accumulator(name, accumulator):
    if not isinstance(accumulator, Accumulator):
        raise InputError(
            f"accumulator {name!r} is a {type(accumulator).__name__}: must be a"
            " jaxtank.measures.Accumulator"
        )
    if accumulator.refers_to not in ("", *Context._fields):
        raise InputError(
            f"accumulator {name!r}: refers_to = {accumulator.refers_to!r}: must be one of"
            f" {', '.join(Context._fields)}, or empty"
        )


def _check_measure(name, measure, accumulators):
    """Raise InputError unless `measure` fits the accumulators and the places where it is used."""
    if not isinstance(measure, Measure):
        raise InputError(
            f"measure {name!r} is a {type(measure).__name__}: must be a jaxtank.measures.Measure"
        )
    if measure.per not in _SIZES:
        raise InputError(
            f"measure {name!r}: per = {measure.per!r}: must be one of {', '.join(_SIZES)}"
        )
    for a in (*measure.needs, *filter(None, [measure.residual])):
        if a not in accumulators:
            raise unknown("accumulator", a, accumulators)
    if measure.residual and (
        accumulators[measure.residual].residual is None or measure.scale is None
    ):
        raise InputError(
            f"measure {name!r}: residual = {measure.residual!r}: needs an accumulator with a"
            " residual, and a scale"
        )
    if measure.reached and measure.reached not in MEASURES:
        raise unknown("measure", measure.reached, MEASURES)


def check_names(names: Iterable[str]) -> None:
    """Raise InputError for a name that is no measure; one of an installed package is registered."""
    for name in names:
        if not isinstance(name, str):
            raise InputError(
                f"measure {shortened(name)}: must be a name; a function gets one by"
                " jaxtank.measures.register(NAME, jaxtank.measures.from_function(function))"
            )
        if name in MEASURES:
            continue
        points = installed(GROUP)
        if name not in points:
            raise unknown("measure", name, [*MEASURES, *points])
        measure = imported(points[name])
        register(name, measure if isinstance(measure, Measure) else from_function(measure))


def unreadable(names: Iterable[str]) -> tuple[str, ...]:
    """Return the `names` of functions that no installed package has: no rig file can name them."""
    named = functions(names)
    return tuple(named.keys() - installed(GROUP).keys()) if named else ()


def squares() -> tuple[str, ...]:
    """Return the names of the measures that are sums of squares over the run."""
    return tuple(m for m, spec in MEASURES.items() if spec.residual)


def times() -> tuple[str, ...]:
    """Return the names of the measures that are the time at which another one was reached: they are
    not reported by themselves.
    """
    return tuple(dict.fromkeys(spec.reached for spec in MEASURES.values() if spec.reached))


def reported() -> tuple[str, ...]:
    """Return the names of the measures in every result: all but `times()`, functions of a whole
    run and measures of the linearised loop, which are computed only on request.
    """
    left_out = {*times(), *functions(MEASURES), *linear()}
    return tuple(m for m in MEASURES if m not in left_out)


def linear() -> tuple[str, ...]:
    """Return the names of the measures of the linearised loop: computed where they are named."""
    return tuple(m for m, spec in MEASURES.items() if spec.linear)


def placed(field: str) -> tuple[str, ...]:
    """Return the names of the measures with a place in `field`, "shown" or "summary", in order."""
    places = {m: getattr(spec, field) for m, spec in MEASURES.items()}
    return tuple(sorted((m for m in places if places[m]), key=lambda m: places[m]))


def unit(name: str, units: tuple[str, str] = DEFAULT) -> str:
    """Return the unit of measure `name` on a rig with these (length, pump input) units.

    Examples
    --------
    >>> from jaxtank import measures
    >>> measures.unit("ise"), measures.unit("ise", ("m", "m^3/s"))
    ('cm^2 s', 'm^2 s')
    """
    return local(MEASURES[name].unit, units)


def entry_units(name: str, plant: Any) -> str | list[str]:
    """Return the unit of a measure of a plant; where its entries differ, as those of a pump and of
    a valve, whose input is an opening, the unit of each.

    Parameters
    ----------
    name : of a measure
    plant : Plant

    Returns
    -------
    Unit, or a list of units, one per entry.

    Examples
    --------
    >>> from jaxtank import measures, presets
    >>> measures.entry_units("rms_input", presets.find("cascaded/pi").loop.plant)
    'V'
    """
    length, drive = plant.units
    if MEASURES[name].per != "pump" or not getattr(plant, "valves", ()):
        return unit(name, (length, drive))
    drives = [input_unit(plant, j, drive) for j in range(plant.pumps)]
    bare = re.compile(r"-(\^-?\d+)?").fullmatch  # of what has no unit: "-^2 s" is "s"
    texts = (unit(name, (length, each)).split(" ") for each in drives)
    units = [" ".join(v for v in factors if not bare(v)) or "-" for factors in texts]
    return units[0] if len(set(units)) == 1 else units


def entries(name: str, plant: Any) -> int:
    """Return the number of entries of measure `name` for a plant: 1, or one per output, tank or
    pump.
    """
    return _SIZES[MEASURES[name].per](plant)


def refers_to(names: Iterable[str]) -> frozenset[str]:
    """Return the fields of `Context` that measures refer to: "window" (the changes of the
    setpoint), "since" (inflow pulses), "steady" (inputs that hold the setpoint), "jump" (samples
    at which a constant setpoint jumps).
    """
    accumulators = {a for name in names for a in MEASURES[name].needs}
    return frozenset(ACCUMULATORS[a].refers_to for a in accumulators) - {""}


def of_loop(loop: Any) -> tuple[str, ...]:
    """Return the names of the reported measures whose setpoint changes and inflow pulses `loop`
    has: those that a file of it may name. `serves` asks for more.
    """
    missing = _missing(loop)
    of_run = (m for m in reported() if not missing & refers_to([m]))
    return (*of_run, *(m for m in linear() if serves(m, loop)))


def serves(name: str, loop: Any) -> bool:
    """Return whether the measure `name` means something for this loop: its reference changes, its
    holds setpoints, its tanks have inflow pulses, its steady inputs are known in closed form, its
    levels have a lower clip, it has a safety filter, its controller has limits of levels.
    """
    fields, plant = refers_to([name]), loop.plant
    if MEASURES[name].linear and loop.reference.held() is None:
        return False
    if "steady" in fields and (
        getattr(plant, "pipes", None) != ()
        or not plant.plain
        or not plant.pumps == len(plant.outputs) == len(set(plant.outputs))
    ):
        return False
    if "shortfall" in MEASURES[name].needs and not plant.bottom:
        return False
    if "filtered" in MEASURES[name].needs and loop.safety_filter is None:
        return False
    if "slack" in MEASURES[name].needs and not loop.controller.limits_levels:
        return False
    return not fields & _missing(loop)


def _missing(loop: Any) -> frozenset[str]:
    """Fields of `Context` that a run of `loop` cannot have: setpoint changes, inflow pulses."""
    has = {
        "window": loop.reference.changes is not None,
        "since": loop.disturbance is not None and loop.disturbance.onset is not None,
    }
    return frozenset(field for field in has if not has[field])


States = dict[str, Any]  # {accumulator: its state}
Weights = Sequence[tuple[str, float]]  # (measure, weight) of sums of squares


def needs(names: Sequence[str]) -> tuple[str, ...]:
    """Return the accumulators that `names` need, in a fixed order."""
    needed = {a for name in names for a in MEASURES[name].needs}
    return tuple(a for a in ACCUMULATORS if a in needed)


def start(run: Run, names: Sequence[str]) -> States:
    """Return {accumulator: state} before the first sample."""
    tuples = _in_tuples(run) if run.arrays else run
    specs = {a: ACCUMULATORS[a] for a in needs(names)}
    return {a: spec.start(run if spec.arrays else tuples) for a, spec in specs.items()}


def update(run: Run, states: States, sample: Sample, context: Context) -> States:
    """Return {accumulator: state} after `sample`."""
    updated: States = {}
    for name, state in states.items():
        known, *signals = _in_form(ACCUMULATORS[name], run, sample, context)
        updated[name] = ACCUMULATORS[name].update(known, state, *signals)
    return updated


def residuals(
    run: Run, states: States, sample: Sample, context: Context, squares: Weights
) -> tuple[Any, ...]:
    """Return a sample's residuals of `squares`: a flat tuple, or one array for each of them."""
    values: list[Any] = []
    for measure, _ in squares:
        name = MEASURES[measure].residual
        accumulator: Any = ACCUMULATORS[name]
        known, *signals = _in_form(accumulator, run, sample, context)
        entries = accumulator.residual(known, states[name], *signals)
        if run.arrays:
            values.append(entries if accumulator.arrays else jnp.stack(list(entries)))
        else:
            values.extend(entries)
    return tuple(values)


def residual_weights(run: Run, squares: Weights) -> tuple[Any, ...]:
    """Return the weight of the square of each of `residuals` in the sum of the measures."""
    counts = {"output": run.outputs, "tank": run.tanks, "pump": run.pumps}
    if run.arrays:
        counts = dict.fromkeys(counts, 1)  # one array each
    weights: list[Any] = []
    for measure, weight in squares:
        spec: Any = MEASURES[measure]
        weights.extend(weight * spec.scale(run) for _ in range(counts[spec.per]))
    return tuple(weights)


def read(run: Run, states: States, names: Sequence[str]) -> dict[str, Any]:
    """Return {measure: value} at the end of a run."""
    states = totals(states)
    values: dict[str, Any] = {}
    for name in names:
        spec = MEASURES[name]
        if run.arrays and not spec.arrays:
            of = lambda a: _rows_of(states[a]) if ACCUMULATORS[a].rows else states[a]
            values[name] = spec.read(_in_tuples(run), {a: of(a) for a in spec.needs})
        else:
            values[name] = spec.read(run, states)
    return values


def _rows_of(state: Any) -> tuple[Any, ...]:
    """A tuple of numbers for each entry, of a tuple of arrays."""
    return tuple(zip(*(scalars(column) for column in state)))


def _in_form(accumulator: Accumulator, run: Run, sample: Sample, context: Context) -> Any:
    """(run, sample, context) with vectors in the form that an accumulator takes."""
    if accumulator.arrays or not run.arrays:
        return run, sample, context
    window = None if context.window is None else _rows_of(context.window)
    jump = None if context.jump is None else scalars(context.jump)
    context = context._replace(window=window, steady=scalars(context.steady), jump=jump)
    alone = {"t": sample.t, "filtered": sample.filtered, "slack": sample.slack}
    vectors = {f: scalars(v) for f, v in sample._asdict().items() if f not in alone}
    return _in_tuples(run), Sample(**alone, **vectors), context


def _in_tuples(run: Run) -> Run:
    """`run` with tuples of scalars as vectors."""
    low, high, rim = (scalars(v) for v in (run.low, run.high, run.rim))
    return run._replace(low=low, high=high, rim=rim, arrays=False)
