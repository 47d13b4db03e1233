"""The engine of a live page: a closed loop as JavaScript text, and what is known of it as data.

The text needs no page: node runs it too.
"""

import json
import re
from collections.abc import Mapping
from importlib import resources
from typing import Any

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case
from jaxtank.controllers import OpenLoop
from jaxtank.export.whole.array_values import called
from jaxtank.export.whole.loop import WholeLoop, traced_leaves, whole_loop
from jaxtank.export.whole.tangents import TangentLoop, tangent_loop
from tuning.live.printed import Printed, maths
from tuning.live.printed_tangents import PrintedTangents
from tuning.live.sliders import leaf_of
from tuning.problem.bounds import bounds
from tuning.problem.limits import limit_scale, resolve_limits
from tuning.problem.problem import ROOT

ROWS = 3000
"""Rows of a run for people, about: those of `jaxtank simulate --out`."""
SHARED = ("unit", "doc", "group")
"""What the entries of one array have in common."""
ALWAYS = ("rms_error_total", "max_level")
"""Measures that have derivatives whatever a case minimises and limits."""


def engine(case: Case, filtered: Case | None = None) -> str:
    """Return a text of JavaScript that defines makeEngine(), which runs the loop of a case.

    Parameters
    ----------
    case : Case
    filtered : Case, optional
        The same with its safety filter, to be switched on and off.

    Raises
    ------
    InputError
        For a loop that has no code of single samples (`jaxtank.export.whole.loop`).

    Examples
    --------
    >>> from jaxtank import presets
    >>> "function makeEngine()" in engine(presets.find("cascaded/pi"))
    True
    """
    with jax.enable_x64(True):
        cases = [one for one in (case, filtered) if one is not None]
        loops = [whole_loop(one) for one in cases]
        facts = _facts(case, loops)
        shared: dict[str, str] = {}
        own = ",\n".join(_program(loop, _tangents(loop.case), shared) for loop in loops)
        programs = _with_functions(own, shared)
    driver = resources.files("tuning.live").joinpath("engine.js").read_text(encoding="utf-8")
    return "\n".join(
        [
            "const makeEngine=(()=>{",
            '"use strict";',
            f"const info={data(_packed(facts))};",
            f"const programs={programs};",
            bare(driver),
            "return makeEngine;",
            "})();",
        ]
    )


def describe(case: Case, filtered: Case | None = None) -> dict[str, Any]:
    """Return what is known of the loop of a case beside its code, as a JSON object.

    Examples
    --------
    >>> from jaxtank import presets
    >>> describe(presets.find("cascaded/pi"))["pumps"][0]["upper"]
    10.0
    """
    with jax.enable_x64(True):
        return _facts(case, [whole_loop(one) for one in (case, filtered) if one is not None])


def _packed(facts: dict[str, Any]) -> dict[str, Any]:
    """The same with the leaves of an array together: what they share, and [name, what differs]."""
    groups: dict[tuple[Any, ...], list[Any]] = {}
    for leaf in facts["leaves"]:
        shared = tuple(leaf[key] for key in SHARED)
        own = [leaf["name"], *(leaf[key] for key in ("value", "lower", "upper"))]
        groups.setdefault((leaf["name"].split("[")[0], *shared), []).append(own)
    packed = [[*shared, entries] for (_, *shared), entries in groups.items()]
    return {**facts, "leaves": packed}


def bare(script: str) -> str:
    """Return a script of ours without comments in blocks, indentation and empty lines."""
    lines = (line.strip() for line in re.sub(r"/\*.*?\*/", "", script, flags=re.S).splitlines())
    return "\n".join(filter(None, lines))


def data(value: Any) -> str:
    """Return a JSON object as JavaScript that may stand in a page: no text of it ends a script."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def _tangents(case: Case) -> TangentLoop:
    """The derivatives that a search of the case asks for."""
    wanted = [*case.objective, *(x.measure for x in resolve_limits(case)), *ALWAYS]
    measures = [m for m in dict.fromkeys(wanted) if ms.serves(m, case.loop)]
    names = [n for n in traced_leaves(case) if n.startswith("controller.") and ".model." not in n]
    names += [name.split("[")[0] for name in case.free]
    return tangent_loop(case, measures, list(dict.fromkeys(names)), squares_of(case.objective))


def squares_of(objective: Mapping[str, float]) -> tuple[tuple[str, float], ...]:
    """Return ((measure, weight), ...) of the Gauss-Newton matrix of an objective, as
    `tune` has it.
    """
    own = tuple((m, w) for m, w in objective.items() if m in ms.squares())
    return (("mean_square_error", 1.0),) if ROOT in objective or not own else own


def _program(loop: WholeLoop, tangents: TangentLoop, shared: dict[str, str]) -> str:
    """One loop as an object of its functions; functions on arrays are added to `shared`."""
    columns = [[f, len(found)] for f, found in loop.saved.items()]
    main, slopes = Printed(loop), PrintedTangents(tangents)
    along = [_name(*leaf) for leaf in tangents.leaves]
    own = _block(slopes, "lead,signals,read,aim,push,slope", f"along:{data(along)}", shared)
    return _block(main, "lead,signals,run,read", f"columns:{data(columns)},tangents:{own}", shared)


def _block(printed: Printed, functions: str, facts: str, shared: dict[str, str]) -> str:
    """Functions in a scope of their own; shared: {text of a function on arrays: its name}."""
    own = [
        f"{name}={shared.setdefault(text, f'g{len(shared)}')}"
        for name, text in printed.helpers().items()
    ]
    body = "\n".join([*([f"const {','.join(own)};"] if own else []), printed.text()])
    measures = data([[m, _size(m, found)] for m, found in printed.loop.measures.items()])
    leaves = data([_name(*leaf) for leaf in printed.loop.leaves])
    facts = f"streams:{len(printed.streams())},measures:{measures},leaves:{leaves},{facts}"
    return f"(()=>{{{body}\nreturn{{{functions},{facts}}};}})()"


def _with_functions(programs: str, shared: dict[str, str]) -> str:
    """An array of programs, with the functions that they call."""
    own = "\n".join(f"const {name}={text};" for text, name in shared.items())
    above = "\n".join([*map(bare, called(f"{own}\n{programs}")), own])
    return f"(()=>{{{maths(f'{above} {programs}')}\n{above}\nreturn[{programs}];}})()"


def _name(name, index):
    """The name of an entry of a leaf."""
    return f"{name}[{','.join(map(str, index))}]" if index else name


def _size(measure, entries):
    """Number of entries of a measure, None for one number of the run."""
    return None if ms.MEASURES[measure].per == "run" else len(entries)


def _facts(case: Case, loops: list[WholeLoop]) -> dict[str, Any]:
    loop, clock, plant = case.loop, case.clock, case.loop.plant
    free = bounds(loop, case.free) if case.free else []
    length, drive = loop.units
    own = {leaf: one.case for one in reversed(loops) for leaf in one.leaves}
    leaves = [leaf_of(own[leaf], *leaf) for leaf in sorted(own, key=lambda leaf: leaf[0])]
    tanks = list((case.names or {}).get("tank", ())) or [""] * plant.tanks
    pumps = list((case.names or {}).get("pump", ())) or [""] * plant.pumps
    rims = [float(v) for v in np.broadcast_to(np.asarray(plant.rim), (plant.tanks,))]
    return {
        "case": case.name,
        "title": case.title,
        "units": {"length": length, "drive": drive},
        "dt": clock.dt,
        "duration": clock.duration,
        "samples": clock.samples,
        "save_every_default": max(1, clock.samples // ROWS),
        "tanks": [
            {"name": tanks[i] or f"tank {i + 1}", "rim": v if np.isfinite(v) else None}
            for i, v in enumerate(rims)
        ],
        "outputs": [int(i) for i in plant.outputs],
        "pumps": [
            {
                "name": pumps[j] or f"pump {j + 1}",
                "lower": float(loop.actuator.low[j]),
                "upper": float(loop.actuator.high[j]),
            }
            for j in range(plant.pumps)
        ],
        "leaves": leaves,
        "measures": [_measure(case, m, found) for m, found in loops[-1].measures.items()],
        "limits": _limits(case),
        "free": [b.name for b in free],
        "logarithmic": [b.name for b in free if b.scale == "log"],
        "bounds": {b.name: [b.low, b.high] for b in free},
        "objective": {
            "text": " + ".join(f"{w:g} {m}" for m, w in case.objective.items()),
            "measures": {m: float(w) for m, w in case.objective.items()},
        },
        "filter": {
            "present": len(loops) > 1 or loop.safety_filter is not None,
            "default_on": loop.safety_filter is not None,
        },
        "noise": bool(np.any(np.asarray(loop.sensor.noise) > 0)),
        "tracks": not isinstance(loop.controller, OpenLoop),
    }


def _measure(case, name, entries):
    spec = ms.MEASURES[name]
    return {
        "name": name,
        "unit": ms.unit(name, case.loop.units),
        "size": _size(name, entries),
        "doc": spec.doc,
        "sense": spec.sense,
    }


def _limits(case):
    found, rims = [], isinstance(case.limits.get("max_level"), str)
    rim = "plant.rim[{}]" if np.ndim(case.loop.plant.rim) else "plant.rim"
    for limit in resolve_limits(case):
        one = ms.MEASURES[limit.measure].per == "run"
        side = "upper" if limit.sign > 0 else "lower"
        found.append(
            {
                "measure": limit.measure,
                "entry": None if one else limit.index,
                "upper": None,
                "lower": None,
                "unit": ms.unit(limit.measure, case.loop.units),
                "scale": float(limit_scale(limit, case.loop)),
                "nan_holds": bool(ms.MEASURES[limit.measure].nan_holds),
                # the parameter that this limit is, where it is no number of its own
                "follows": rim.format(limit.index)
                if rims and limit.measure == "max_level"
                else None,
                side: float(limit.value),
            }
        )
    return found
