"""A closed loop as JavaScript text, which needs no page, with facts on it as data."""

import dataclasses
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import resources
from itertools import chain
from typing import Any, NamedTuple, cast

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.bounds import bounds
from jaxtank.case import Case, Free
from jaxtank.controllers import OnOff, OpenLoop, ReferenceGovernor
from jaxtank.core.labels import input_unit, label_of, place_of, symbol
from jaxtank.core.tree import describe, get_value, parameters
from jaxtank.export import statements as ir, whole
from jaxtank.export.statements import every, names
from jaxtank.export.tables import packed, tables_of
from jaxtank.export.whole import Text, WholeLoop, whole_loop
from jaxtank.limits import limit_scale, resolve_limits
from jaxtank.loop.closed_loop import draws_bursts
from jaxtank.loop.step_size import pump_draws
from jaxtank.signals.setpoints import Ramps
from jaxtank.task import default_cost, has_own_objective, input_range, sensor_noise, with_noise
from jaxtank.xla.normal import DENOMINATOR, NUMERATOR
from jaxtank.xla.texts import kept

NOISE = 0.02  # upper end of the sliders of noise, as a share of the height of the tanks [-]
ROWS = 3000  # approximate number of rows of a plotted run, as in `jaxtank simulate --out`
ALONE, TIMED, MOVING = 0, 1, 2  # a value follows from the numbers of the loop, time, the state
ALWAYS = ("rms_error_total", "max_level")  # measures of every search
SHARED = ("unit", "doc", "group")  # fields that all entries of one array share

# {first part of a dotted name: group of its slider}, where they are not the same
GROUPS = {"actuator": "pumps", "faults": "disturbance", "x0": "initial"}

NOUNS = {  # what a person reads for a field; of the others its name
    "actuator.high": "upper limit",
    "actuator.initial": "input before the run",
    "actuator.low": "lower limit",
    "actuator.stop": "stopping input",
    "controller.du_limit": "largest change",
    "controller.held": "constant input",
    "controller.high": "upper limit",
    "controller.low": "lower limit",
    "controller.signal.initial": "input",
    "controller.signal.level": "input",
    "controller.u_high": "upper limit",
    "controller.u_low": "lower limit",
    "plant.drain": "outlet",
    "plant.orifice": "outlet",
    "plant.pump_gain": "gain",
    "plant.valve": "area",
    "reference.initial": "setpoint",
    "sensor.gain": "sensor gain",
    "sensor.noise": "noise",
    "x0": "starting level",
}

INPUTS = ("controller.held", "controller.signal.initial", "controller.signal.level")
"""Fields with an entry for each input: their sliders have its range."""

WIDE = {"controller": (0.2, 5.0), "observer": (0.2, 5.0), "plant": (0.5, 1.5), "pumps": (0.5, 1.5)}
"""{group: ends of a slider as multiples of a value that has no bounds}; (0, 2) of the others."""

ABOVE = 1e-3  # distance of a slider from a lower bound that is excluded, of the range [-]
INFINITE = {math.inf: "Infinity", -math.inf: "-Infinity"}  # as JavaScript reads them


class Printed:
    """The printed functions of a WholeLoop."""

    def __init__(self, loop: WholeLoop):
        self.loop, self.statements = loop, ir.hoisted(loop.statements)
        lines = dict.fromkeys(loop.lines.values(), MOVING)
        ranks = {"p": ALONE, "k": TIMED, "t": TIMED, "c": MOVING, "n": MOVING, **lines}
        self.rank = ir.ranks(self.statements, ranks)
        both = every(loop.statements)
        truths = (s for s in self.statements if isinstance(s, ir.Define) and s.kind == ir.TRUTH)
        self.truths = {s.name for s in truths}
        self.arrays = {s.name for s in both if isinstance(s, ir.Array | ir.Matrix)}
        self.saved, self.measures = (
            list(chain.from_iterable(entries.values())) for entries in (loop.saved, loop.measures)
        )
        self.state = self._live()
        self.outputs = [loop.after[i] for i in (*self.state, *loop.lines)] + self.saved
        self.moving = ir.used(self._ranked(MOVING), names(self.outputs))
        self.measured = ir.used(self._ranked(MOVING), names(self.measures))
        needed = ir.refs(self.moving, self.outputs)
        needed = {e for e in needed if self.rank[e.name] == TIMED and e.name != "k"}
        # data that is stored for every sample, and data that is computed again from it
        self.kept, self.again = whole.kept_in_time(self._ranked(TIMED), needed, self.rank)
        self.streams = sorted(self.kept)  # in the order of S
        self.timed = ir.used(self._ranked(TIMED), names(self.kept))
        self.crossing = {
            "signals": self._alone(self.timed, self.kept),
            "run": self._alone([*self.again, *self.moving], self.outputs),
            "read": self._alone(self.measured, self.measures),
        }

    def text(self) -> str:
        """Return the four functions as an object, without the helpers that they call."""
        crossing = list(self.crossing.values())
        state = [self.loop.first[i] for i in self.state]
        outputs = [*state, *(self.loop.first[i] for i in self.loop.lines), *chain(*crossing)]
        alone = ir.used(self._ranked(ALONE), names(outputs))
        text = Text({"p": "p"})
        lines = text.write(alone, outputs, hold=outputs)
        parts, delays = [self._numbers(text, group) for group in (*crossing, state)], []
        for i in sorted(self.loop.lines):
            root = self.loop.after[i].name
            size = sum(isinstance(e, ir.Ref) and e.name == root for e in self.loop.after)
            delays.append(f"new Float64Array({size}).fill({text.of(self.loop.first[i])})")
        lines.append(f"return[{','.join(parts)},[{','.join(delays)}]];")
        return "\n".join([function("lead", "p", lines), self._signals(), self._run(), self._read()])

    def _live(self):
        """The entries of c, without delay lines, that what is saved or measured depends on."""
        # a run has diverged where the sum of its levels, the first entries, is not finite
        levels = [self.loop.after[i] for i in range(self.loop.case.loop.plant.tanks)]
        results = [*self.saved, *self.measures, *levels]
        lines = [self.loop.after[i] for i in self.loop.lines]
        every, live = self._ranked(MOVING), []
        while True:
            after = [*results, *lines, *(self.loop.after[i] for i in live)]
            read = ir.refs(ir.used(every, names(after)), after)
            new = sorted(cast(int, e.index) for e in read if e.name == "c")
            if new == live:
                return live
            live = new

    def _ranked(self, rank):
        return ir.of_rank(self.statements, self.rank, rank)

    def _alone(self, statements: list[ir.Statement], outputs: Iterable[Any]) -> list[ir.Ref]:
        """Values of rank ALONE that are read: numbers, then whole arrays as Refs without index."""
        numbers = {e for e in ir.refs(statements, outputs) if self.rank[e.name] == ALONE}
        read = {o for s in every(statements) if isinstance(s, ir.Matrix) for o in s.operands}
        arrays = {ir.Ref(name) for name in read if self.rank.get(name) == ALONE}
        return [*sorted(numbers, key=place), *sorted(arrays)]

    def _is_array(self, e):
        return e.index is None and e.name in self.arrays

    def _numbers(self, text, group):
        """Numbers as one array, with whole arrays, if any, as its property A."""
        numbers = [e for e in group if not (isinstance(e, ir.Ref) and self._is_array(e))]
        arrays = [text.given[e.name] for e in group if isinstance(e, ir.Ref) and self._is_array(e)]
        out = f"Float64Array.of({','.join(map(text.of, numbers))})"
        return f"Object.assign({out},{{A:[{','.join(arrays)}]}})" if arrays else out

    def _unpack(self, text, lines, entries, array, word="const"):
        """Names for `entries` of an array, after a line that takes it apart."""
        variables = [next(text.names) for _ in entries]
        lines += [f"{word}[{','.join(variables)}]={array};"] if variables else []
        return variables

    def _begin(self, name, extra):
        """The Text of a function, and its first lines: names of the numbers of `_numbers`."""
        text, lines = Text(extra), []
        for arrays, where in ((False, "q"), (True, "q.A")):
            entries = [e for e in self.crossing[name] if self._is_array(e) == arrays]
            variables = self._unpack(text, lines, entries, where)
            text.given.update(zip([e.name if arrays else e for e in entries], variables))
        return text, lines

    def _signals(self):
        text, lines = self._begin("signals", {ir.Ref("k"): "k"})
        tables = [ir.Ref("t", i) for i in range(self.loop.tables)]
        of_tables = self._unpack(text, lines, tables, "T")
        text.given |= {e: f"{variable}[k]" for e, variable in zip(tables, of_tables)}
        variables = self._unpack(text, lines, self.streams, "S")
        body = text.write(self.timed, self.streams)
        values = (text.of(e) for e in self.streams)
        body += [f"{a}[k]={v if v[0] == '+' else f'+{v}'};" for a, v in zip(variables, values)]
        lines += ["for(;k<K;++k){", *body, "}"] if variables else []
        return function("signals", "q,k,K,S,T", lines)

    def _run(self):
        text, lines = self._begin("run", {ir.Ref("k"): "k"})
        streams = self._unpack(text, lines, self.streams, "S")
        noise = self._unpack(text, lines, range(self.loop.case.loop.plant.tanks), "N")
        state = self._unpack(text, lines, self.state, "c", "let")
        text.given |= {ir.Ref("c", i): variable for i, variable in zip(self.state, state)}
        delays = self._unpack(text, lines, self.loop.lines, "L")
        text.given |= dict(zip(self.loop.lines.values(), delays))
        body, deviates = [], (ir.Ref("n", i) for i in range(len(noise)))
        for e, array in zip([*self.streams, *deviates], [*streams, *noise]):
            text.given[e] = next(text.names)
            body.append(f"const {text.given[e]}={array}[k];")
        body += text.write([*self.again, *self.moving], self.outputs, hold=self.outputs)
        rows = [f"R[o++]={self._real(e)}{text.of(e)};" for e in self.saved]
        body += ["if(k%every===0){", *rows, "}", *self._next(text)]
        lines += ["let o=0;", "for(;k<K;++k){", *body, "}"]
        lines += [f"c[{j}]={variable};" for j, variable in enumerate(state)]
        return function("run", "q,c,L,S,N,k,K,every,R", [*lines, "return o;"])

    def _next(self, text):
        """Lines that replace the last state by the next one."""
        updates = []
        for i in self.state:
            e, name = self.loop.after[i], text.given[ir.Ref("c", i)]
            if e != ir.Ref("c", i):
                updates.append((name, text.of(e), self._real(e)))
        old = {name for name, *_ in updates}
        temporary = {value: next(text.names) for _, value, _ in updates if value in old}
        first = [f"const {new}={value};" for value, new in temporary.items()]
        return first + [f"{n}={sign}{temporary.get(v, v)};" for n, v, sign in updates]

    def _real(self, e):
        """Prefix that converts a truth value to a number; "" for a number."""
        return "+" if isinstance(e, ir.Ref) and e.name in self.truths else ""

    def _read(self):
        text, lines = self._begin("read", {})
        state = self._unpack(text, lines, self.state, "c")
        text.given |= {ir.Ref("c", i): variable for i, variable in zip(self.state, state)}
        lines += text.write(self.measured, self.measures, hold=self.measures)
        values = ",".join(map(text.of, self.measures))
        return function("read", "q,c", [*lines, f"return[{values}];"])


def place(e: ir.Ref) -> tuple[str, Any]:
    return e.name, -1 if e.index is None else e.index


def function(name: str, arguments: str, lines: Iterable[str]) -> str:
    """Return a function as text, with constants that follow each other in one statement."""
    short: list[str] = []
    constant = False
    for line in lines:
        now = line.startswith(("const ", "const[")) and line.endswith(";")
        if now and constant:
            short[-1] = short[-1][:-1] + ","
            line = line.removeprefix("const").lstrip()
        short.append(line)
        constant = now
    return f"function {name}({arguments}){{" + "\n".join(short) + "}"


class Program(NamedTuple):
    """A loop as JavaScript, with the facts that the page shows."""

    case: Case
    leaves: Sequence[tuple[str, tuple[int, ...]]]  # (dotted name, index in it) of each number
    measures: Mapping[str, int]  # {measure: number of its entries}
    text: str


def program_of(case: Case) -> Program:
    """Return the Program of a case, with functions for a search; known ones are not traced."""
    with jax.enable_x64(True):
        leaves, structure = jax.tree.flatten(case.loop)
        traced, shapes = whole.numbers_of(case), [np.shape(v) for v in leaves]
        rest = {n: np.asarray(v) for n, v in parameters(case.loop).items() if n not in traced}
        searched, squares = _searched(case)
        parts = [structure, shapes, rest, case.clock, whole.served(case), (searched, squares)]

        def written() -> Any:
            loop = whole_loop(case)
            # with the measures of a search alone, and residuals of weight 1
            lean = whole_loop(case, searched, tuple((m, 1.0) for m in squares))
            text = _program(loop, f"search:{_program(lean)}")
            return [loop.leaves, {m: len(entries) for m, entries in loop.measures.items()}, text]

        names, sizes, text = kept("page", parts, written)
    return Program(case, [(name, tuple(index)) for name, index in names], sizes, text)


def engine(
    case: Case, filtered: Case | None = None, printed: Callable[[Case], Program] = program_of
) -> str:
    """Return JavaScript that defines makeEngine(), which runs a case and the same `filtered`."""
    with jax.enable_x64(True):
        parts = [printed(variant) for variant in (case, filtered) if variant is not None]
        facts = facts_of(case, parts)
        programs = ",\n".join(program.text for program in parts)
        functions = "\n".join(map(bare, whole.library(programs)))
    named = ",".join(m for m in whole.MATHS if f"{m}(" in functions + programs)
    programs = f"(()=>{{const{{{named}}}=Math;\n{functions}\nreturn[{programs}];}})()"
    driver = resources.files("jaxtank.live").joinpath("engine.js").read_text(encoding="utf-8")
    rows = ["const makeEngine=(()=>{", '"use strict";', f"const info={data(_packed(facts))};"]
    rows += [f"const programs={programs};", f"const inverseErf={data([NUMERATOR, DENOMINATOR])};"]
    return "\n".join([*rows, bare(driver), "return makeEngine;", "})();"])


def _packed(facts: dict[str, Any]) -> dict[str, Any]:
    """Return `facts` with grouped leaves: common fields once, then [name, value, range, label]."""
    groups: dict[tuple[Any, ...], list[Any]] = {}
    for leaf in facts["leaves"]:
        shared = tuple(leaf[key] for key in SHARED)
        number = leaf["infinite"] if leaf["value"] is None else leaf["value"]
        entry = [leaf["name"], number, leaf["lower"], leaf["upper"], leaf["label"]]
        groups.setdefault((leaf["name"].split("[")[0], *shared), []).append(entry)
    return {**facts, "leaves": [[*shared, entries] for (_, *shared), entries in groups.items()]}


def bare(script: str) -> str:
    """Return a script of this package without block comments, indentation and empty lines."""
    lines = (line.strip() for line in re.sub(r"/\*.*?\*/", "", script, flags=re.S).splitlines())
    return "\n".join(filter(None, lines))


def data(value: Any) -> str:
    """Return a JSON object as JavaScript that may stand in a page: no text of it ends a script."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def squares_of(objective: Mapping[str, float]) -> tuple[tuple[str, float], ...]:
    """Return ((measure, weight), ...) of the Gauss-Newton matrix of an objective."""
    squares = tuple((m, w) for m, w in objective.items() if m in ms.squares())
    errors_alone = "rms_error_total" in objective or not squares
    return (("mean_square_error", 1.0),) if errors_alone else squares


def _searched(case: Case) -> tuple[list[str], list[str]]:
    """The measures of a search, and the sums of squares among them."""
    objectives = (case.objective, _objective(case))
    names = [
        *chain(*objectives),
        *(x.measure for x in resolve_limits(case, governed=False)),
        *ALWAYS,
    ]
    measures = [m for m in dict.fromkeys(names) if ms.serves(m, case.loop)]
    return measures, list(dict.fromkeys(m for o in objectives for m, _ in squares_of(o)))


def _objective(case: Case) -> Mapping[str, float]:
    """The objective of a search on plants, as of `jaxtank tune`."""
    return case.objective if has_own_objective(case) else default_cost(case, input_range(case))


def _task(loops: list[Program]) -> dict[str, Any]:
    """What a search on plants changes: the objective, noise, and the safety filter for it."""
    case, numbers = loops[-1].case, {_name(*leaf) for loop in loops for leaf in loop.leaves}
    noisy = with_noise(case.without_safety_filter(), sensor_noise(case)[0])
    values, proved = {"sensor.noise": noisy.loop.sensor.noise}, False
    if case.loop.safety_filter is not None:
        safety_filter, rows = noisy.safety_design(**dict(case.safety or {}))
        loop = dataclasses.replace(case.loop, safety_filter=safety_filter)
        guard = {n: v for n, v in parameters(loop).items() if n.startswith("safety_filter.")}
        values, proved = values | guard, all(row.certified for row in rows)
    objective, entries = {m: float(w) for m, w in _objective(loops[0].case).items()}, {}
    for name, array in values.items():
        for index, v in np.ndenumerate(np.asarray(array, dtype=float)):
            if np.isfinite(v) and _name(name, index) in numbers:
                entries[_name(name, index)] = float(v)
    return {"objective": objective, "values": entries, "proved": proved}


def _program(loop: WholeLoop, search: str = "") -> str:
    """One loop as an object of its functions and the meaning of their numbers."""
    printed = Printed(loop)
    facts = {
        "streams": len(printed.streams),
        "columns": [[field, len(entries)] for field, entries in loop.saved.items()],
        "measures": [[m, _size(m, len(entries))] for m, entries in loop.measures.items()],
        "leaves": [_name(*leaf) for leaf in loop.leaves],
        "weights": loop.weights,
    }
    result = f"{{lead,signals,run,read,...{data(facts)},{search}}}"
    return f"(()=>{{{printed.text()}\nreturn{result};}})()"


def _name(name, index):
    return f"{name}[{','.join(map(str, index))}]" if index else name


def _size(measure, count):
    """Number of entries of a measure, None for one number of the run."""
    return None if ms.MEASURES[measure].per == "run" else count


def facts_of(case: Case, loops: list[Program]) -> dict[str, Any]:
    """Return the data of the loops of a case without their code, as a JSON object."""
    loop, clock, plant = case.loop, case.clock, case.loop.plant
    free = bounds(loop, case.free) if case.free else []
    length, drive = loop.units
    counts = {"tank": plant.tanks, "output": len(plant.outputs), "pump": plant.pumps}
    low, high = loop.actuator.low, loop.actuator.high
    return {
        "case": case.name,
        "title": case.title,
        "units": {"length": length, "drive": drive},
        "dt": clock.dt,
        "duration": clock.duration,
        "samples": clock.samples,
        "save_every_default": max(1, clock.samples // ROWS),
        "tanks": _tanks(plant),
        "columns": {k: [symbol(plant, "", k, i) for i in range(n)] for k, n in counts.items()},
        "outputs": [int(i) for i in plant.outputs],
        "predicts": isinstance(case.loop.controller, ReferenceGovernor),
        "pumps": [
            {
                "name": label_of(plant, "pump", j),
                "unit": input_unit(plant, j, drive),
                "lower": float(low[j]),
                "upper": float(high[j]),
            }
            for j in range(plant.pumps)
        ],
        "leaves": _leaves(loops),
        "setpoints": _setpoints(loop),
        "tables": packed(case),
        "draws": pump_draws(case.loop, case.clock),
        "measures": [_measure(case, *measure) for measure in loops[-1].measures.items()],
        "limits": _limits(case),
        "free": [b.name for b in free],
        "logarithmic": [b.name for b in free if b.scale == "log"],
        "bounds": {b.name: [b.low, b.high] for b in free},
        "objective": {
            "text": " + ".join(f"{w:g} {m}" for m, w in case.objective.items()),
            "measures": {m: float(w) for m, w in case.objective.items()},
        },
        "squares": list(ms.squares()),
        "task": _task(loops),
        "filter": {
            "present": len(loops) > 1 or loop.safety_filter is not None,
            "default_on": loop.safety_filter is not None,
        },
        "noise": draws_bursts(loop) or bool(np.any(np.asarray(loop.sensor.noise) > 0)),
        "tracks": not isinstance(loop.controller, OpenLoop | OnOff),
    }


def _tanks(plant):
    rims = enumerate(map(float, np.broadcast_to(plant.rim, (plant.tanks,))))
    rim = lambda value: value if np.isfinite(value) else None
    return [{"name": label_of(plant, "tank", i), "rim": rim(value)} for i, value in rims]


def _leaves(loops):
    """The sliders of all loops; where several have the same one, the first loop's."""
    homes = {leaf: variant.case for variant in reversed(loops) for leaf in variant.leaves}
    return [leaf_of(homes[leaf], *leaf) for leaf in sorted(homes, key=lambda leaf: leaf[0])]


def _setpoints(loop):
    """[[parameter, output, the time from which it is the setpoint]], where the setpoints step."""
    reference = loop.reference
    if not isinstance(reference, Ramps) or "reference" in tables_of(loop):
        return []
    first = [[f"reference.initial[{i}]", i, 0.0] for i in range(reference.channels)]
    later = enumerate(reference.changes)
    return first + [[f"reference.targets[{k}]", i, float(time)] for k, (time, i) in later]


def _measure(case, name, count):
    spec, unit = ms.MEASURES[name], ms.unit(name, case.loop.units)
    row = {"name": name, "unit": unit, "size": _size(name, count)}
    return row | {"doc": spec.doc, "sense": spec.sense}


def _limits(case):
    rows, rims = [], isinstance(case.limits.get("max_level"), str)
    rim = "plant.rim[{}]" if np.ndim(case.loop.plant.rim) else "plant.rim"
    for limit in resolve_limits(case, governed=False):
        spec, value = ms.MEASURES[limit.measure], float(limit.value)
        follows = rims and limit.measure == "max_level"  # a parameter, which is not a number
        rows.append(
            {
                "measure": limit.measure,
                "words": limit.words,
                "reached": spec.reached or None,
                "entry": None if spec.per == "run" else limit.index,
                "upper": value if limit.sign > 0 else None,
                "lower": None if limit.sign > 0 else value,
                "unit": ms.unit(limit.measure, case.loop.units),
                "scale": float(limit_scale(limit, case.loop)),
                "nan_holds": bool(spec.nan_holds),
                "follows": rim.format(limit.index) if follows else None,
            }
        )
    return rows


def leaf_of(case: Case, name: str, index: tuple[int, ...]) -> dict[str, Any]:
    """Return the slider of one number of a loop, as a JSON object."""
    full = _name(name, index)
    meta = describe(case.loop, full)
    unit, drive = meta["unit"], case.loop.units[1]
    if index and meta.get("shape") == ("pump",) and unit == drive:  # or that of a valve's opening
        unit = input_unit(case.loop.plant, index[0], drive)
    value = float(np.asarray(get_value(case.loop, full)))
    part = name.split(".")[0]
    group = "model" if ".model." in name else GROUPS.get(part, part.replace("_", " "))
    finite = math.isfinite(value)
    lower, upper = _ends(case, name, full, value, meta, group) if finite else (None, None)
    return {
        "name": full,
        "label": words_of(case.loop, name, index),
        "unit": unit,
        "doc": meta["doc"],
        "value": value if finite else None,
        "infinite": INFINITE.get(value),
        "lower": lower,
        "upper": upper,
        "group": group,
    }


def words_of(loop: Any, name: str, index: tuple[int, ...]) -> str:
    """Return the label of one number of a loop, as "outlet of LT102"."""
    plant, shape = loop.plant, describe(loop, name).get("shape")
    noun = NOUNS.get(name, name.rsplit(".", 1)[-1].replace("_", " "))
    if not index:
        return noun
    (i, *others), kind = index, shape[0] if isinstance(shape, tuple) and shape else ""
    if name == "reference.targets" and hasattr(loop.reference, "changes"):
        time, channel = loop.reference.changes[i]
        return f"setpoint of {place_of(plant, 'output', channel)} from {time:.5g} s"
    where = _place(loop, name, kind if not others or kind == "channel" else "", i)
    return f"{noun} {where}" if where else f"{noun} {', '.join(str(k + 1) for k in index)}"


def _place(loop, name, kind, i):
    """Where entry `i` of a field belongs: "of LT102", "between LT101 and LT102"; "" for nowhere."""
    plant = loop.plant
    if name in INPUTS:
        start = " at first" * bool(getattr(getattr(loop.controller, "signal", 0), "changes", ()))
        return f"of {label_of(plant, 'pump', i)}{start}"
    if kind == "channel" and name.startswith("reference."):
        start = " at first" * (name == "reference.initial")
        return f"of {place_of(plant, 'output', i)}{start}"
    if kind in ("tank", "output", "pump", "feed"):
        return f"of {place_of(plant, 'pump' if kind == 'feed' else kind, i)}"
    if kind == "valve":
        return f"of {label_of(plant, 'pump', len(plant.feeds) + i)}"
    ends = {"orifice": ("links", "of {} into {}"), "pipe": ("pipes", "between {} and {}")}
    if kind not in ends:
        return ""
    pairs, place = ends[kind]
    return place.format(*(label_of(plant, "tank", k) for k in getattr(plant, pairs)[i]))


def _largest(values):
    """The largest magnitude of the values that are finite, 1 where all are 0."""
    size = np.abs(np.asarray(values, dtype=float))
    return float(np.max(size[np.isfinite(size)], initial=0.0)) or 1.0


def _ends(case, name, full, value, meta, group):
    """(lower, upper) of a slider: the bounds of a search, else around the value."""
    for key in (full, name):
        if key in case.free:
            low, high, _ = Free(*case.free[key])
            return min(low, value), max(high, value)
    height = _largest(case.loop.plant.rim)
    actuator, entry = case.loop.actuator, full.removeprefix(f"{name}[").removesuffix("]")
    if name in INPUTS and entry.isdigit() and np.isfinite(actuator.high[int(entry)]):
        low, high = float(actuator.low[int(entry)]), float(actuator.high[int(entry)])
    elif name == "sensor.noise":
        low, high = 0.0, max(NOISE * height, 2.0 * value)
    elif group in ("reference", "initial") and meta["unit"] == case.loop.units[0]:
        low, high = 0.0, max(height, value)
    elif value == 0.0:  # of several entries as the others
        low, high = 0.0, _largest(get_value(case.loop, name))
    else:
        least, most = WIDE.get(group, (0.0, 2.0))
        low, high = sorted((least * value, most * value))
    if meta["low"] is not None:
        low = max(low, float(meta["low"]))
        if meta.get("strict") and low <= float(meta["low"]):  # an end that is not allowed itself
            low = float(meta["low"]) + ABOVE * (high - float(meta["low"]))
    if meta["high"] is not None:
        high = min(high, float(meta["high"]))
    return min(low, value), max(high, value)
