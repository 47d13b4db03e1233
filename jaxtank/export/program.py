"""A controller and its observer, or a plant and its instruments, as statements of one sample."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.analysis.elimination import rolled
from jaxtank.case import Case
from jaxtank.core.clock import Chunk
from jaxtank.core.errors import InputError
from jaxtank.core.records import Tick
from jaxtank.core.tree import describe, parameters, walk, with_values
from jaxtank.core.vectors import scalars
from jaxtank.export import statements as ir
from jaxtank.export.lowering import WholeWriter, Writer, lower_all
from jaxtank.loop.closed_loop import Inputs, control_state, initial
from jaxtank.loop.step import decide, move, readings
from jaxtank.signals.base import sampled

CONTROL = ("controller", "observer", "actuator", "safety_filter")
PLANT = ("plant", "sensor", "actuator", "faults", "disturbance", "x0")
"""Parts of a loop whose numbers are parameters of the code of a controller, and of a plant."""

TABLE = 64  # entries above which numbers are a table, which is compiled in
INLINE = 100  # statements up to which values of the parameters alone are computed in every sample


def control(loop: Any, dt: float) -> tuple[Any, Any]:
    """Return (step, begin), the functions of one sample and of the first state, of arrays."""
    # step(state, t, y, r, dr, ddr) -> (u within the limits, state); begin(y, u) -> state. In manual
    # operation `on` the inputs are those of `w`. `loop.step.decide` has the order of one sample.

    def begin(y, u):
        return loop.observer.init(scalars(y)), control_state(loop, scalars(y), scalars(u))

    def step(state, t, y, r, dr, ddr, on=None, w=None):
        observer, controller = state
        r, dr, ddr = map(scalars, (r, dr, ddr))
        samples = [tuple(v[None] for v in signal) for signal in (r, dr, ddr)]
        plan = jax.tree.map(lambda a: a[0], loop.controller.prepare(*samples))
        tick = Tick(t=t, r=r, dr=dr, ddr=ddr, dt=dt, plan=plan, own=())
        manual = None if on is None else (on, scalars(w))
        decision = decide(loop, observer, controller, tick, scalars(y), manual)
        return jnp.stack(list(decision.applied)), (decision.observer, decision.controller)

    return step, begin


def physics(case: Case, loop: Any) -> tuple[Any, Any]:
    """(step(state, u, d), begin()) of the plant with pumps and gauges, both -> (results, state)."""
    clock, n = case.clock, loop.plant.tanks

    def now(k):
        moment: Any = Chunk(first=k, samples=1, dt=clock.dt)
        first = lambda signal: jax.tree.map(lambda a: a[0], signal)
        d = (0.0,) * n if loop.disturbance is None else first(sampled(loop.disturbance, moment)[0])
        fault = None if loop.faults is None else first(loop.faults.sample(moment))
        keys: dict[str, Any] = dict.fromkeys(Inputs._fields, ())
        return Inputs(**keys | {"d": d, "xi": None, "fault": fault})

    def read(state, inputs, spilled):
        y, state = readings(loop, state, inputs, clock)
        state = state._replace(observer=(), controller=())
        return tuple(jnp.stack([jnp.asarray(e) for e in v]) for v in (y, state.x, spilled)), state

    def begin():
        return read(initial(loop, clock), now(0), (0.0,) * n)

    def step(state, u, d):
        inputs = now(state.k)
        inflow: Any = inputs.d
        inputs = inputs._replace(d=tuple(a + b for a, b in zip(inflow, scalars(d))))
        moved, _, spilled, _ = move(loop, clock, state, scalars(u), inputs)
        return read(moved, now(moved.k), spilled)

    return step, begin


class Parameter(NamedTuple):
    """A number or an array of numbers that the code has as a variable."""

    name: str
    value: np.ndarray
    meta: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Program:
    """The statements of the two functions of a case, and the sizes of their arguments."""

    case: Case
    inputs: dict[str, int]  # {name: size} of the arguments of a step, without state and time
    outputs_of: dict[str, list[Any]]  # {name: entries} of the results of a step
    state: int  # number of entries of the state
    begin: list[ir.Statement]
    first: list[Any]  # entries of the first state
    start: dict[str, list[Any]]  # {name: entries} of the results before the first sample
    step: list[ir.Statement]
    after: list[Any]  # entries of the state after the step
    parameters: tuple[Parameter, ...] = ()
    entries: tuple[tuple[str, tuple[int, ...]], ...] = ()
    """(name of a parameter, index in it) of each entry of p."""
    prepare: list[ir.Statement] = dataclasses.field(default_factory=list)
    """Statements on the parameters alone, where they are many."""
    constants: dict[ir.Ref, tuple[str, int]] = dataclasses.field(default_factory=dict)
    """{number of `prepare` that the step reads: (kind, place among the constants)}."""
    arrays: dict[str, tuple[int, int]] = dataclasses.field(default_factory=dict)
    """{array of `prepare` that the step reads: (first place among the constants, size)}."""
    lines: dict[str, int] = dataclasses.field(default_factory=dict)
    """{array that is a part of the state: its first entry}."""

    @property
    def plant(self) -> bool:
        """Whether it is the plant and not the controller."""
        return "y" not in self.inputs

    @property
    def u(self) -> list[Any]:
        """Inputs of the pumps, of a controller."""
        return self.outputs_of["u"]

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

    @property
    def kept(self) -> int:
        """Number of constants."""
        return len(self.constants) + sum(size for _, size in self.arrays.values())


def traced_leaves(case: Case) -> dict[str, np.ndarray]:
    """Return {dotted name: value} of the numbers of a loop that are inputs of its statements."""
    values = {n: np.asarray(v, dtype=float) for n, v in parameters(case.loop).items()}
    return {n: v for n, v in values.items() if 0 < v.size <= TABLE}


def entries_of(shapes: dict[str, Any]) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """Return (dotted name, index in it) of each entry of arrays, in the order of an argument."""
    return tuple((name, i) for name in sorted(shapes) for i in np.ndindex(shapes[name].shape))


def flat(tree: Any) -> list[Any]:
    """Return the entries of all arrays of a tree."""
    return [e for array in jax.tree.leaves(tree) for e in np.ravel(array)]


def program(case: Case, plant: bool = False, adjustable: bool = True) -> Program:
    """Return the Program of a case; `adjustable`: its numbers are parameters of the code."""
    begun, done, sizes, leaves = _lowered(case, plant, adjustable)
    results, after = done.outputs
    start, first = begun.outputs if plant else ((), begun.outputs)
    of = ("y", "h", "spilled") if plant else ("u",)
    named = lambda arrays: {n: flat(a) for n, a in zip(of, arrays)}
    state = flat(after)
    if len(flat(first)) != len(state):
        raise InputError(
            f"{case.name}: the first state of its controller has {len(flat(first))} numbers, the"
            f" next one {len(state)}; a controller to export keeps its size"
        )
    result = Program(
        case=case,
        inputs=sizes,
        outputs_of=named(results if plant else (results,)),
        state=len(state),
        begin=begun.statements,
        first=flat(first),
        start=named(start),
        step=done.statements,
        after=state,
        lines={name: ref.index for ref, name in done.lines.items()},
    )
    return _divided(_with_parameters(result, leaves)) if adjustable else result


def _lowered(case, plant, adjustable):
    """(begin, step) lowered, {input: size}, {name: value} of the traced leaves."""
    roots = PLANT if plant else CONTROL
    leaves = {n: v for n, v in traced_leaves(case).items() if n.split(".")[0] in roots}
    real = lambda *shape: jax.ShapeDtypeStruct(shape, jnp.result_type(float))
    tanks, pumps = case.loop.plant.tanks, case.loop.plant.pumps
    r = dict.fromkeys(("r", "dr", "ddr"), len(case.loop.plant.outputs))
    sizes = {"u": pumps, "d": tanks} if plant else {"y": tanks, **r}
    arguments: dict[str, Any] = {} if plant else {"t": real()}
    arguments |= {name: real(size) for name, size in sizes.items()}
    gains = {"p": {n: real(*v.shape) for n, v in leaves.items()}} if adjustable else {}
    if adjustable and not plant:
        arguments |= {"on": jax.ShapeDtypeStruct((), jnp.bool_), "w": real(pumps)}
        sizes |= {"w": pumps}

    def functions(p):
        loop = with_values(case.loop, p)
        return physics(case, loop) if plant else control(loop, case.clock.dt)

    # the first state may have another type than the next ones: a number of the controller, an array
    # of the run
    ran = initial(case.loop, case.clock)
    ran = jax.eval_shape(functions({})[1])[1] if plant else (ran.observer, ran.controller)
    state = jax.tree.map(lambda a: jax.ShapeDtypeStruct(np.shape(a), jnp.result_type(a)), ran)
    before = {} if plant else {"y": real(tanks), "u": real(pumps)}
    # other controllers have arrays of a few entries
    loops = not plant and case.loop.sequential
    if not adjustable:
        step, begin = functions({})
        begun = lower_all(begin, before, Writer(loops))
        done = lower_all(step, {"s": state, **arguments}, Writer(loops))
        return begun, done, sizes, {}
    with rolled():
        first, writer = WholeWriter(loops), WholeWriter(loops)
        begun = lower_all(lambda p, *v: functions(p)[1](*v), gains | before, first)
        writer.counter = first.counter  # no name twice
        step = lambda p, *v: functions(p)[0](*v)
        done = lower_all(step, {**gains, "s": state, **arguments}, writer)
    return begun, done, sizes, leaves


def _with_parameters(result, leaves):
    """The Program with the parameters that its statements read."""
    entries = entries_of(leaves)
    read = ir.refs(result.step, [*result.after, *flat(result.outputs_of)])
    read |= ir.refs(result.begin, [*result.first, *flat(result.start)])
    used_ = {entries[e.index][0] for e in read if e.name == "p" and isinstance(e.index, int)}
    loop = result.case.loop
    order = [name for name, value, _ in walk(loop) if value is not None and name in used_]
    parts = tuple(Parameter(name, leaves[name], describe(loop, name)) for name in order)
    return dataclasses.replace(result, parameters=parts, entries=entries)


def _divided(result):
    """The Program with its statements on parameters alone apart, where they are many."""
    statements = ir.hoisted(result.step)
    inputs = {"p": 0, "s": 1, "t": 1, "on": 1, **dict.fromkeys(result.inputs, 1)}
    rank = ir.ranks(statements, inputs | dict.fromkeys(result.lines, 1))
    alone = ir.of_rank(statements, rank, 0)
    loops = any(isinstance(s, ir.Each | ir.Loop | ir.Matrix) for s in alone)
    if len(alone) <= INLINE and not loops:
        return result
    moving = ir.of_rank(statements, rank, 1)
    sizes = {name: vector.size for name, vector in ir.array_kinds(alone).items()}
    crossing = _crossing(moving, [*result.after, *flat(result.outputs_of)], rank)
    whole = [e.name for e in crossing if e.index is None and e.name in sizes]
    numbers, kinds = [e for e in crossing if e.name not in whole], _kinds(alone)
    starts = len(numbers) + np.cumsum([0, *(sizes[name] for name in whole)])
    return dataclasses.replace(
        result,
        step=moving,
        prepare=ir.used(alone, ir.names(numbers) | set(whole)),
        constants={e: (kinds.get(e.name, ir.REAL), i) for i, e in enumerate(numbers)},
        arrays={name: (int(at), sizes[name]) for name, at in zip(whole, starts)},
    )


def _crossing(moving, results, rank):
    """The Refs to values of the parameters alone that the other statements read."""
    operands = {o for s in ir.every(moving) if isinstance(s, ir.Matrix) for o in s.operands}
    read = ir.refs(moving, results) | {ir.Ref(o) for o in operands}
    return [e for e in sorted(read, key=str) if rank.get(e.name) == 0 and e.name != "p"]


def _kinds(statements):
    """{variable: its kind} of the numbers that statements define."""
    loops = (s for s in ir.every(statements) if isinstance(s, ir.Loop))
    of_entries = lambda kind: kind.kind if isinstance(kind, ir.Vector) else kind
    carried = {name: of_entries(kind) for s in loops for kind, name, _ in s.carried}
    single = (s for s in ir.every(statements) if isinstance(s, ir.Define | ir.Each))
    return carried | {s.name: s.kind for s in single}
