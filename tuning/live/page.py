"""The live page as text: one HTML file that asks nothing of any network, everything in it escaped.

Beside it lie the parts of the page:
page.html, page.css, core.js, charts.js, rig.js, runner.js, page.js, worker.js, tune.js, and uPlot
in vendor/.
"""

import base64
import hashlib
import html
import json
import re
import zlib
from functools import cache
from pathlib import Path

import numpy as np

import jaxtank
from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.tree import get_value, parameters
from jaxtank.export.whole import check_pointwise
from jaxtank.loop.closed_loop import takes_arrays
from jaxtank.loop.trajectory import stride
from tuning.live.drawing import drawing
from tuning.live.engine import engine, program_of
from tuning.live.origin import both, entries, origin_of
from tuning.problem.bounds import bounds
from tuning.search.setting import plants_of
from tuning.uncertainty.sampling import check_whole

HERE = Path(__file__).parent
SCRIPTS = ("charts", "rig", "runner", "page")
LARGEST = 110_000
"""Characters of a page above which the safety filter that a case has not is left out."""

DIGITS = str.maketrans("&<>`", ",.:[")
"""Digits of base 85 that HTML reads as something else, and what stands for them (inflate.js)."""

END = "\0"
"""What stands between the parts of a page that are packed; JSON escapes it."""

KEPT = 8
"""Engines that are kept in memory."""

PLANTS, MOST_PLANTS = 64, 2000
"""Plants of the band of a page: where it is not said how many, and at most."""

LEAK = 1.5
"""Factor of an outlet that leaks [-]."""

_KEPT = {}


def page(case, presets=(), source=None, plants=None):
    """Return the live page of a case as the text of an HTML file; `plants` plants shown at once."""
    check_pointwise(case)
    bounds(case.loop, case.free)
    off, on, filtered = both(case)
    data = data_of(case, presets, source, plants)
    try:
        return _smallest(off, on, filtered, lambda text: assemble(text, case.name, data))
    except InputError as error:
        if not takes_arrays(case.loop):
            raise
        tanks = case.loop.plant.tanks
        words = f"{case.name}: no live page of its {tanks} tanks, which run as arrays ({error})"
        raise InputError(words) from None


def _smallest(off, on, filtered, assembled):
    """The page; without a safety filter to switch on where that of a large loop is not on."""
    texts = {}

    def printed(one):
        if id(one) not in texts:
            texts[id(one)] = program_of(one)
        return texts[id(one)]

    if filtered or on is None:
        return assembled(_engine(off, on, printed))
    text = assembled(_engine(off, None, printed))
    return text if len(text) > LARGEST else assembled(_engine(off, on, printed))


def _engine(off, on, printed):
    """The engine of a case and of the same with a safety filter or None."""
    try:
        texts = [rig.dump(one) for one in (off, on) if one is not None]
    except InputError:  # a class of the user's own
        return engine(off, on, printed)
    key = repr((texts, off.title, off.names))
    if key not in _KEPT:
        if len(_KEPT) >= KEPT:
            _KEPT.pop(next(iter(_KEPT)))
        _KEPT[key] = engine(off, on, printed)
    return _KEPT[key]


def data_of(case, presets=(), source=None, plants=None):
    """Return what the page knows of a case besides the engine, a JSON object."""
    if plants is not None:
        check_whole("plants", plants, 1, MOST_PLANTS)
    try:
        toml = rig.dump(case)
    except InputError as error:  # a class of the user's own without a name
        toml = f"# no rig file describes this case ({error})\n"
    origin = origin_of(case, source)
    return {
        "version": jaxtank.__version__,
        "origin": origin._asdict(),
        "filter": case.loop.safety_filter is not None,
        "every": stride(case.clock.samples),
        "drawn": stride(case.clock.samples, 6000),
        "toml": toml,
        "rig": drawing(case.loop.plant),
        "scenarios": len(case.scenarios or ()),
        "presets": [
            {"name": name, "values": entries(case.loop, values), "filter": on, "text": name}
            for name, values, on in presets
        ],
        "breaks": _breaks(case),
        "uncertain": _uncertain(case),
        "plants": plants or PLANTS,
        "band": plants is not None,
    }


def _breaks(case):
    """Faults of the plant that last the whole run: [{name, text, leaf, factor or value}]."""
    plant, found = case.loop.plant, []

    def add(name, leaf, factor, text):
        found.append({"name": name, "leaf": leaf, "factor": factor, "value": None, "text": text})

    values = {n: np.ravel(v) for n, v in parameters(case.loop).items()}
    for j in range(np.size(values.get("plant.pump_gain", ()))):
        add(f"pump {j + 1} at 70 %", f"plant.pump_gain[{j}]", 0.7, "the pump delivers 70 %")
    for i, area in enumerate(values.get("plant.drain", ())):
        if area > 0:
            text = f"the outlet of tank {i + 1} is {100 * (LEAK - 1):.0f} % wider"
            add(f"leak in tank {i + 1}", f"plant.drain[{i}]", LEAK, text)
    for k, area in enumerate(values.get("plant.orifice", ())):
        if area > 0:
            source, sink = (tank + 1 for tank in plant.links[k])
            text = f"the valve from tank {source} to tank {sink} is stuck, 40 % open"
            add(f"stuck valve {source} to {sink}", f"plant.orifice[{k}]", 0.4, text)
    for k, area in enumerate(values.get("plant.pipe", ())):
        if area > 0:
            one, other = (tank + 1 for tank in plant.pipes[k])
            text = f"the pipe between tanks {one} and {other} is blocked, 40 % open"
            add(f"blocked pipe {one} to {other}", f"plant.pipe[{k}]", 0.4, text)
    for k, volume in enumerate(values.get("disturbance.volume", ())):
        if volume:
            text = "three times the volume of this inflow disturbance"
            add(f"inflow pulse {k + 1} times 3", f"disturbance.volume[{k}]", 3.0, text)
    return found


def _uncertain(case):
    """{dotted name: half-width as a share} of what varies from plant to plant."""
    found = {}
    for name, one in plants_of(case).items():
        if getattr(one, "relative", None) is not None:
            found[name] = float(one.relative)
        elif hasattr(one, "covariance"):
            for own, variance in zip(one.names, np.diagonal(np.asarray(one.covariance))):
                value = float(np.ravel(get_value(case.loop, own))[0])
                if value:
                    found[own] = float(np.sqrt(3.0 * variance) / abs(value))
    return found


def assemble(engine_text, name, data):
    """Return the page as text."""
    uplot, core, own = _read("vendor/uPlot.iife.min.js"), _script("core"), _own()
    # the scripts of the page are one function, as loader.js joins them
    run = [engine_text, uplot, f'(() => {{"use strict";\n{core}\n{own}\n}})();', _loader()]
    policy = "; ".join(
        [
            "default-src 'none'",
            f"script-src {' '.join(map(source_of, run))}",
            f"style-src {source_of(_style())}",
            "worker-src blob:",
            "img-src data:",
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )
    search = f"const tune=(()=>{{\n{_script('tune')}\nreturn tune;\n}})();"
    facts = json.dumps(data, allow_nan=False, separators=(",", ":"))
    parts = [uplot, own, core, f"{search}\n{_script('worker')}", facts, engine_text]
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{html.escape(name)}: live</title>",
            f'<link rel="icon" href="data:,">\n<style>{_style()}</style>\n</head>\n<body>',
            _read("page.html"),
            f'<script type="text/plain" id="packed">{_packed(END.join(parts))}</script>',
            f"<script>{_loader()}</script>",
            "</body>\n</html>\n",
        ]
    )


def _packed(text):
    """A text, deflated, in base 85: half as long, and nothing in it can end a script element."""
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15)
    found = base64.b85encode(deflate.compress(text.encode()) + deflate.flush()).decode()
    return found.translate(DIGITS)


def source_of(text):
    """Return the source of a content-security policy that allows exactly this script or style."""
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return f"'sha256-{digest}'"


@cache
def _read(name):
    return (HERE / name).read_text(encoding="utf-8").strip()


@cache
def _style():
    """The style sheets, without comments and indentation."""
    text = re.sub(r"/\*.*?\*/", "", _read("vendor/uPlot.min.css") + _read("page.css"), flags=re.S)
    return re.sub(r"\s*([{};])\s*", r"\1", re.sub(r"\s+", " ", text)).replace(": ", ":")


@cache
def _script(name):
    """One script of ours without indentation, blank lines and lines of comments."""
    lines = (line.strip() for line in _read(f"{name}.js").splitlines())
    return "\n".join(line for line in lines if line and not line.startswith("//"))


@cache
def _own():
    """The scripts of the page but core.js."""
    return "\n".join(map(_script, SCRIPTS))


@cache
def _loader():
    """The script that unpacks the others, with the licence of what is not ours."""
    licence = "/* Packed in this page: uPlot 1.6.32, copyright (c) 2022 Leon Sorokin, MIT licence:"
    terms = _read("vendor/uPlot-LICENSE.txt").partition("\n\n")[2]
    parts = [licence, terms, '*/\n(() => {"use strict";', _script("inflate"), _script("loader")]
    return "\n".join([*parts, "})();"])
