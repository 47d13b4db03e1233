"""The live page as text: one HTML file that needs no network, made of the files beside this one."""

import base64
import contextlib
import dataclasses
import hashlib
import html
import json
import re
import shlex
import string
import zlib
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxtank import measures as ms, presets, rig
from jaxtank.bounds import bounds, free_of
from jaxtank.case import uncertain_shares
from jaxtank.controllers import OpenLoop
from jaxtank.core import VERSION
from jaxtank.core.checks import check_whole
from jaxtank.core.clock import CLOCK_UNITS
from jaxtank.core.errors import InputError
from jaxtank.core.files import write_folder
from jaxtank.core.labels import label_of
from jaxtank.core.tree import get_value, parameters, walk
from jaxtank.export.whole import check_pointwise
from jaxtank.live.engine import engine, program_of
from jaxtank.loop.closed_loop import takes_arrays
from jaxtank.loop.trajectory import stride
from jaxtank.plants.vessels import shape_name
from jaxtank.plots.layout import jets, overflows, pipes, place, valves

HEIGHT = 900  # height of the page inside another one [px]
ENGINES = 8  # engines that stay in memory
GUARD = "safety_filter."  # prefix of the names of a safety filter
HERE = Path(__file__).parent
SCRIPTS = ("charts", "rig", "runner", "page")
LARGEST = 120_000  # characters of a page above which a filter that the case has not is left out

DIGITS = str.maketrans("&<>`", ",.:[")
"""Digits of base 85 that HTML reads as something else, and what stands for them (inflate.js)."""

END = "\0"  # separator between the packed parts of a page; JSON escapes it
PLANTS, MOST_PLANTS = 64, 2000  # number of plants in the band of a page: by default, and at most
LEAK = 1.5  # factor of an outlet that leaks [-]
_KEPT = {}


class Origin(NamedTuple):
    """Words and options of `jaxtank simulate` that make a case."""

    words: str
    values: dict[str, float | str]
    filtered: bool
    guard: str
    copied: bool = False  # the words name the rig file that the page copies


def origin_of(case, source=None):
    source = source or (case.name if presets.has(case.name) else None)
    original, words = None, None
    if source is not None:
        with contextlib.suppress(InputError):  # the file has gone
            original = rig.open_case(source)
            words = _static(case, original)
    if source is None or original is None or words is None:
        gone = source if original is None else None
        return Origin(shlex.quote(gone or "rig.toml"), {}, case.safety is not None, "", not gone)
    current = entries(case.loop, parameters(case.loop))
    origin = entries(original.loop, parameters(original.loop)).items()
    changed = {n: v for n, v in origin if current[n] != v}
    # an infinite number has no slider, and none in JSON
    differing = {n: v if np.isfinite(v) else str(v) for n, v in changed.items()}
    words += _options({n: current[n] for n in changed if not np.isfinite(current[n])})
    words = " ".join([shlex.quote(source), *words])
    return Origin(words, differing, original.safety is not None, " ".join(_guard(case, original)))


def _guard(case, original):
    """--set of settings of the safety filter that the origin does not have."""
    before, items = dict(original.safety or {}), (case.safety or {}).items()
    changes = {k: v for k, v in items if not np.array_equal(before.get(k, ()), v)}
    changes = {k: [*v] if np.ndim(v) else v for k, v in changes.items()}
    return _options({f"safety_filter.{key}": value for key, value in changes.items()})


def _static(case, original):
    """--set of optional leaves, static fields and the clock that differ; None where the structure
    does.
    """
    fields = lambda c: {n: v for n, v, _ in walk(c.loop, kind="static") if not n.startswith(GUARD)}
    mine, theirs = fields(case), fields(original)
    shapes, of_original = _shapes(case.loop), _shapes(original.loop)
    shared = {name: shape for name, shape in shapes.items() if name in of_original}
    if shared != of_original or mine.keys() != theirs.keys():
        return None
    changes = {name: value for name, value in mine.items() if value != theirs[name]}
    if any(value is None or isinstance(value, tuple) for value in changes.values()):
        return None
    added = sorted(shapes.keys() - shared.keys())
    if any(len(shapes[name]) > 1 for name in added):
        return None
    changes |= {name: np.asarray(get_value(case.loop, name)).tolist() for name in added}
    return _options(changes | _clock_of(case, original))


def _clock_of(case, original):
    """{name: value} of the fields of the clock that differ."""
    times = {name: getattr(case.clock, name) for name in CLOCK_UNITS}
    return {f"clock.{n}": v for n, v in times.items() if v != getattr(original.clock, n)}


def _options(values):
    """--set of {name: value}."""
    words = []
    for name, value in values.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        text = f"[{','.join(map(str, value))}]" if isinstance(value, list) else text
        words += ["--set", shlex.quote(f"{name}={text}")]
    return words


def _shapes(loop):
    return {n: np.shape(v) for n, v in parameters(loop).items() if not n.startswith(GUARD)}


def entries(loop, values):
    """Return {name of one entry: number} of {dotted name: number or array}."""
    numbers, leaves = {}, parameters(loop)
    for name, value in values.items():
        if name.startswith(GUARD):
            continue
        shape = np.shape(leaves[name]) if name in leaves else ()
        if not shape:
            numbers[name] = float(np.ravel(value)[0])
            continue
        for index, entry in np.ndenumerate(np.broadcast_to(np.asarray(value, float), shape)):
            numbers[f"{name}[{','.join(map(str, index))}]"] = float(entry)
    return numbers


def both(case):
    """Return (case without a safety filter, the same with one or None, whether it has one now)."""
    has = case.loop.safety_filter is not None
    try:
        return case.without_safety_filter(), case if has else rig.filtered(case, on=True), has
    except InputError:  # nothing to keep, or no way to
        return case, None, has


def page(case, presets=(), source=None, plants=None):
    """Return the live page of a case as the text of an HTML file; `plants` plants shown at once."""
    check_pointwise(case)
    # no run has limits and objectives of the linearised loop
    of_runs = lambda terms: {name: v for name, v in terms.items() if name not in ms.linear()}
    objective = of_runs(case.objective) or {"rms_error_total": 1.0}
    case = case.replace(free=dict(free_of(case)), limits=of_runs(case.limits), objective=objective)
    if case.free:  # a loop without feedback has nothing to tune
        bounds(case.loop, case.free)
    off, on, filtered = both(case)
    data = data_of(case, presets, source, plants)
    try:
        assembled = lambda text: assemble(text, case.name, data)
        texts = {}

        def printed(variant):
            if id(variant) not in texts:
                texts[id(variant)] = program_of(variant)
            return texts[id(variant)]

        if filtered or on is None:
            return assembled(_engine(off, on, printed))
        # a large loop whose filter is off gets no switch for it
        text = assembled(_engine(off, None, printed))
        return text if len(text) > LARGEST else assembled(_engine(off, on, printed))
    except InputError as error:
        if not takes_arrays(case.loop):
            raise
        tanks = case.loop.plant.tanks
        words = f"{case.name}: no live page of its {tanks} tanks, which run as arrays ({error})"
        raise InputError(words) from None


def _engine(off, on, printed):
    """The engine of a case and of the same with a safety filter or None."""
    try:
        texts = [rig.dump(variant) for variant in (off, on) if variant is not None]
    except InputError:  # a custom class
        return engine(off, on, printed)
    key = repr((texts, off.title, off.names))
    if key not in _KEPT:
        if len(_KEPT) >= ENGINES:
            _KEPT.pop(next(iter(_KEPT)))
        _KEPT[key] = engine(off, on, printed)
    return _KEPT[key]


def data_of(case, presets=(), source=None, plants=None):
    """Return the data of a case for the page, without the engine: a JSON object."""
    if plants is not None:
        check_whole("plants", plants, 1, MOST_PLANTS)
    try:
        toml = rig.dump(case)
    except InputError as error:  # a custom class without a name
        toml = f"# no rig file describes this case ({error})\n"
    return {
        "version": VERSION,
        "origin": origin_of(case, source)._asdict(),
        "filter": case.loop.safety_filter is not None,
        "every": stride(case.clock.samples),
        "drawn": stride(case.clock.samples, 6000),
        "toml": toml,
        "rig": drawing(case.loop),
        "scenarios": len(case.scenarios or ()),
        "presets": [
            {"name": name, "values": entries(case.loop, values), "filter": on, "text": name}
            for name, values, on in presets
        ],
        "breaks": [
            {"name": name, "leaf": leaf, "factor": factor, "value": None, "text": text}
            for name, leaf, factor, text in _breaks(case)
        ],
        "uncertain": _uncertain(case),
        "plants": plants or PLANTS,
        "band": plants is not None,
    }


def _breaks(case):
    """(name, leaf, factor, text) of faults of the plant that last the whole run."""
    plant = case.loop.plant
    values = {n: np.ravel(v) for n, v in parameters(case.loop).items()}
    used = lambda leaf: np.flatnonzero(values.get(leaf, ())).tolist()
    tank = lambda i: label_of(plant, "tank", i)
    for j in range(np.size(values.get("plant.pump_gain", ()))):
        pump = label_of(plant, "pump", j)
        yield f"{pump} at 70 %", f"plant.pump_gain[{j}]", 0.7, f"{pump} delivers 70 %"
    for i in used("plant.drain"):
        text = f"the outlet of {tank(i)} is {100 * (LEAK - 1):.0f} % wider"
        yield f"leak in {tank(i)}", f"plant.drain[{i}]", LEAK, text
    for kind, ends in (("orifice", "links"), ("pipe", "pipes")):
        for k in used(f"plant.{kind}"):
            name = f"{kind} between {' and '.join(map(tank, getattr(plant, ends)[k]))}"
            text = f"the {name} passes 40 % of its flow"
            yield f"blocked {name}", f"plant.{kind}[{k}]", 0.4, text
    for k in range(np.size(values.get("plant.valve", ()))):
        valve = label_of(plant, "pump", len(plant.feeds) + k)
        text = f"{valve} passes 40 % of the flow of its opening"
        yield f"clogged {valve}", f"plant.valve[{k}]", 0.4, text
    for k in used("disturbance.volume"):
        text = "three times the volume of this inflow disturbance"
        yield f"inflow pulse {k + 1} times 3", f"disturbance.volume[{k}]", 3.0, text


def _uncertain(case):
    """{dotted name: half-width as a share} of the uncertain parameters."""
    shares = {name: float(share) for name, share in uncertain_shares(case).items()}
    names, covariance = case.covariance or ((), np.empty((0, 0)))
    for name, variance in zip(names, np.diagonal(np.asarray(covariance))):
        value = float(np.ravel(get_value(case.loop, name))[0])
        if value:
            shares[name] = float(np.sqrt(3.0 * variance) / abs(value))
    return shares


def _worker():
    """The script of a worker, which follows the engine and core.js."""
    names = "{tune,runOfTask}"
    return f"const {names}=(()=>{{\n{_script('tune')}\nreturn {names};\n}})();\n{_script('worker')}"


def assemble(engine_text, name, data):
    uplot, core = _read("vendor/uPlot.iife.min.js"), _script("core")
    scripts = "\n".join(map(_script, SCRIPTS))
    # the scripts of the page are one function, as loader.js joins them
    run = [engine_text, uplot, f'(() => {{"use strict";\n{core}\n{scripts}\n}})();', _loader()]
    scripts_allowed = " ".join(map(source_of, run))
    policy = (
        f"default-src 'none'; script-src {scripts_allowed}; style-src {source_of(_style())};"
        " worker-src blob:; img-src data:; base-uri 'none'; form-action 'none'"
    )
    facts = json.dumps(data, allow_nan=False, separators=(",", ":"))
    packed = _packed(END.join([uplot, scripts, core, _worker(), facts, engine_text]))
    words = {"policy": policy, "name": html.escape(name), "style": _style(), "packed": packed}
    return string.Template(f"{_read('page.html')}\n").substitute(words, loader=_loader())


def _packed(text):
    """A text, deflated, in base 85: half as long, and nothing in it can end a script element."""
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15)
    digits = base64.b85encode(deflate.compress(text.encode()) + deflate.flush()).decode()
    return digits.translate(DIGITS)


def source_of(text):
    """Return the source of a content-security policy that allows exactly this script or style."""
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return f"'sha256-{digest}'"


@cache
def _read(name):
    return (HERE / name).read_text(encoding="utf-8").strip()


@cache
def _style():
    text = re.sub(r"/\*.*?\*/", "", _read("vendor/uPlot.min.css") + _read("page.css"), flags=re.S)
    return re.sub(r"\s*([{};])\s*", r"\1", re.sub(r"\s+", " ", text)).replace(": ", ":")


@cache
def _script(name):
    """Return a script of this package without indentation, blank lines and comment lines."""
    lines = (line.strip() for line in _read(f"{name}.js").splitlines())
    return "\n".join(line for line in lines if line and not line.startswith("//"))


@cache
def _loader():
    """The script that unpacks the others, with the licence of third-party code."""
    licence = "/* Packed in this page: uPlot 1.6.32, copyright (c) 2022 Leon Sorokin, MIT licence:"
    terms = _read("vendor/uPlot-LICENSE.txt").partition("\n\n")[2]
    parts = [licence, terms, '*/\n(() => {"use strict";', _script("inflate"), _script("loader")]
    return "\n".join([*parts, "})();"])


def _by_hand(loop):
    """{input: name of the number that alone sets it}, of those that no controller moves."""
    if isinstance(loop.controller, OpenLoop):
        signal = loop.controller.signal
        name = f"controller.signal.{'level' if hasattr(signal, 'level') else 'initial'}"
        scheduled = {channel for _, channel in getattr(signal, "changes", ())}
        return {j: f"{name}[{j}]" for j in range(loop.plant.pumps) if j not in scheduled}
    return {j: f"controller.held[{j}]" for j in getattr(loop.controller, "by_hand", ())}


def drawing(loop):
    """Return the positions of all parts of a rig, in heights of its tallest tank."""
    plant, hand = loop.plant, _by_hand(loop)
    if not hasattr(plant, "links"):
        return None
    where = place(plant)
    return {
        "boxes": [_rounded(box) for box in where.boxes],
        "pumps": [_rounded(p) for p in where.pumps],
        "risers": [[pump, tank, _path(path)] for pump, tank, path in where.risers],
        "pipes": [[*_rounded(ends), name] for *ends, name in pipes(plant, where)],
        "suctions": [[pump, tank, _path(path)] for pump, tank, path in where.suctions],
        "valves": [
            [_path(path), _rounded(at), hand.get(len(plant.feeds) + k)]
            for k, (_, path, at) in enumerate(valves(plant, where))
        ],
        "shapes": [shape_name(plant, i) for i in range(plant.tanks)],
        "jets": [[tank, _path(path), name] for tank, path, name in jets(plant, where)],
        "overflows": [[tank, _path(path)] for tank, path in overflows(plant, where)],
        **{end: round(float(getattr(where, end)), 4) for end in ("left", "right", "bottom", "top")},
    }


def _rounded(values):
    return [round(float(v), 4) for v in values]


def _path(path):
    return [_rounded(point) for point in path]


@dataclasses.dataclass(frozen=True)
class LivePage:
    """The live page of a case, which a notebook shows."""

    name: str
    text: str

    def save(self, path: str | Path) -> Path:
        """Write the page to a file, whole or not at all; return its path."""
        path = Path(path)
        if path.is_dir():
            raise InputError(f"--out {str(path)!r} is a folder: give a file, as {path}/page.html")
        return write_folder(path.parent, {path.name: self.text})[0]

    def _repr_html_(self) -> str:
        return frame(self)

    def __repr__(self) -> str:
        return f"LivePage({self.name!r}, {len(self.text)} characters): .save(path) writes it"


def frame(live: LivePage) -> str:
    """Return an element that shows a live page inside another page, without access to that one."""
    title = html.escape(f"{live.name}, live")
    # in an attribute between double quotes; "<" also, for readers that look for elements
    inside = live.text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
    return (
        f'<iframe class="live" title="{title}" style="width: 100%" height="{HEIGHT}"'
        ' sandbox="allow-scripts allow-downloads" allow="clipboard-write" loading="lazy"'
        f' srcdoc="{inside}"></iframe>'
    )


def live_page(
    case: Any, presets: Any = (), source: str | None = None, plants: int | None = None
) -> LivePage:
    """Return the LivePage of a case; arguments as in `jaxtank.live.page.page`."""
    # Raises InputError for a case that cannot be run in a browser.
    return LivePage(case.name, page(case, presets, source, plants))
