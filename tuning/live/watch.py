"""The page of a search that is running, and the script by which an open page follows it.
Nothing here reads a clock or writes a file.
"""

import dataclasses
import html
import json
import math
from functools import cache
from pathlib import Path
from typing import Any

from jaxtank.core.text import printable
from tuning.live.page import source_of

PAGE, SCRIPT = "watch.html", "watch.js"
"""Files of a search in its folder: the page, and what an open page reads again every second."""

WIDE, HIGH, LEFT, BOTTOM, TOP = 900, 300, 76, 34, 12
"""Sizes of the picture of the best cost [px]."""
DECADES = 30.0
"""Ratio of the largest to the least cost from which on the axis is logarithmic."""
SIGNIFICANT = 5


@dataclasses.dataclass
class Watched:
    """What is known of a search."""

    # case, title : of the case. began, now : times [s since 1970]. state : "running", "ended",
    # "interrupted" or "failed". stage : what is done, in words; "" before the first evaluation.
    # unit : of the cost. costs : [(number of the evaluation, cost, whether every limit holds)].
    # bests : [[(number, best cost so far)] of each search]. parameters, limits : as
    # `tuning.search.driver.details_of`. violation : of the best point, as a share of a limit; None
    # without one. answer : sentences about the result. values : {name: value} of the result, which
    # may be another point than the best of the search. report : name of the page of the result,
    # None while there is none.

    case: str
    title: str
    began: float
    now: float = 0.0
    state: str = "running"
    stage: str = ""
    unit: str = ""
    evaluations: int = 0
    best: float | None = None
    violation: float | None = None
    costs: list[tuple[int, float, bool]] = dataclasses.field(default_factory=list)
    bests: list[list[tuple[int, float]]] = dataclasses.field(default_factory=list)
    parameters: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    limits: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    answer: tuple[str, ...] = ()
    values: dict[str, float] = dataclasses.field(default_factory=dict)
    report: str | None = None


def files(watched: Watched) -> dict[str, str]:
    """Return {name: text} of the page and of the script that brings an open page up to date."""
    text = json.dumps({"title": _title(watched), "body": body(watched)})
    return {PAGE: page(watched), SCRIPT: f"jaxtankWatch({text});\n"}


def page(watched: Watched) -> str:
    """Return the page as text: whole as it stands, without scripts too."""
    again = '<noscript><meta http-equiv="refresh" content="5"></noscript>'
    policy = "; ".join(
        [
            "default-src 'none'",
            f"script-src {source_of(_read('watch.js'))} 'self' file:",
            f"style-src {source_of(_read('watch.css'))}",
            "img-src data:",
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            again if watched.state == "running" else "",
            f'<title>{html.escape(_title(watched))}</title>\n<link rel="icon" href="data:,">',
            f"<style>{_read('watch.css')}</style>\n</head>\n<body>",
            f"<main>{body(watched)}</main>",
            f"<script>{_read('watch.js')}</script>\n</body>\n</html>\n",
        ]
    )


def body(watched: Watched) -> str:
    """Return what the page shows, as HTML in which every text is escaped."""
    w = watched
    running = w.state == "running"
    stage = w.stage or "compiling the simulation and its derivatives"
    status = {
        "running": f"Running: {stage}",
        "ended": "Ended",
        "interrupted": "Interrupted: the best point so far is kept",
        "failed": "Stopped without a result",
    }[w.state]
    seconds = w.now - w.began
    times = f'data-began="{w.began:.3f}" data-now="{w.now:.3f}"'
    facts = [
        ("best cost so far", f"{_number(w.best)} {w.unit}" if w.best is not None else "none yet"),
        ("limits at that point", _held(w)),
        ("evaluations", str(w.evaluations)),
    ]
    cells = "".join(f"<div><dt>{k}</dt><dd>{html.escape(v)}</dd></div>" for k, v in facts)
    link = f'<p><a href="{html.escape(w.report)}">Report of the result</a></p>' if w.report else ""
    return "\n".join(
        [
            f"<h1>tune {html.escape(w.case)}</h1><p class='title'>{html.escape(w.title)}</p>",
            f'<p id="status" class="{w.state}" {times}>{html.escape(status)}</p>',
            *(f"<p>{html.escape(line)}</p>" for line in w.answer),
            link,
            f'<dl>{cells}<div><dt>time</dt><dd id="time">{_duration(seconds)}</dd></div></dl>',
            '<p id="age" hidden></p>' if running else "",
            f"<h2>Best cost{html.escape(f' [{w.unit}]') if w.unit else ''} over evaluations</h2>",
            picture(w),
            _parameters(w),
            _limits(w),
        ]
    )


def picture(watched: Watched) -> str:
    """Return the best cost over the evaluations as an <svg> element; dots are single
    evaluations.
    """
    lines = [[(n, c) for n, c in line if math.isfinite(c)] for line in watched.bests]
    values = [c for line in lines for _, c in line]
    if not values:
        return "<p>No evaluation is finished yet.</p>"
    low, high = min(values), max(values)
    log = low > 0 and high / low > DECADES
    low, high = (math.log10(low), math.log10(high)) if log else (low, high)
    margin = 0.08 * (high - low) or 0.05 * abs(high) or 1.0
    low, high = low - margin, high + margin
    last = max(watched.evaluations, 2)

    def x(n: float) -> float:
        return LEFT + (WIDE - LEFT - 12) * (n - 1) / (last - 1)

    def y(cost: float) -> float:
        value = math.log10(max(cost, 1e-300)) if log else cost
        part = min(max((value - low) / (high - low), 0.0), 1.0)
        return TOP + (HIGH - BOTTOM - TOP) * (1.0 - part)

    parts = [_axes(x, y, low, high, log, last)]
    parts += [
        f'<circle class="{"held" if held else "passed"}" cx="{x(n):.1f}" cy="{y(c):.1f}" r="2.5"/>'
        for n, c, held in watched.costs
        if math.isfinite(c)
    ]
    for line in filter(None, lines):
        steps = [f"M{x(line[0][0]):.1f} {y(line[0][1]):.1f}"]
        steps += [f"H{x(n):.1f}V{y(c):.1f}" for n, c in line[1:]]
        parts.append(f'<path class="best" d="{"".join(steps)}"/>')
    words = f"best cost {_number(watched.best)} {watched.unit} after {watched.evaluations} runs"
    key = (
        "line: best point so far; dots: evaluations; hollow: a limit is violated; a new line begins"
        " where a new search does"
    )
    return (
        f'<figure><svg viewBox="0 0 {WIDE} {HIGH}" role="img" aria-label="{html.escape(words)}">'
        f"{''.join(parts)}</svg><figcaption>{key}</figcaption></figure>"
    )


def _axes(x: Any, y: Any, low: float, high: float, log: bool, last: int) -> str:
    """Lines and numbers of the axes."""
    parts = []
    for value in ticks(low, high, 5):
        cost = 10.0**value if log else value
        at = f"{y(cost):.1f}"
        parts.append(f'<path class="grid" d="M{LEFT} {at}H{WIDE - 12}"/>')
        text = _number(cost, 3 if log else SIGNIFICANT)
        parts.append(f'<text class="end" x="{LEFT - 8}" y="{at}" dy="4">{text}</text>')
    for n in ticks(1, last, 8):
        if n == int(n):
            parts.append(f'<text class="middle" x="{x(n):.1f}" y="{HIGH - 14}">{int(n)}</text>')
    parts.append(f'<text class="end" x="{WIDE - 12}" y="{HIGH - 1}">evaluation</text>')
    return "".join(parts)


def ticks(low: float, high: float, most: int) -> list[float]:
    """Return at most about `most` round numbers between two numbers."""
    span = high - low
    if not span > 0:
        return [low]
    unit = 10.0 ** math.floor(math.log10(span / most))
    step = next(m * unit for m in (1, 2, 5, 10) if m * unit * most >= span * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [float(f"{k * step:.12g}") for k in range(first, last + 1)]


def _held(w: Watched) -> str:
    if w.violation is None:
        return "not known yet"
    if not w.limits:
        return "none in this search"
    return "hold" if w.violation <= 0 else f"violated by {100 * w.violation:.3g} %"


def _parameters(w: Watched) -> str:
    rows, ended = [], bool(w.values)
    for p in w.parameters:
        answer = w.values.get(p["name"], p["now"])
        part = _share(answer, p["low"], p["high"])
        bar = (
            f'<meter min="0" max="1" value="{part:.3f}" aria-label="position in the range"></meter>'
        )
        numbers = (p["before"], *[answer] * ended, p["now"], p["low"], p["high"])
        cells = "".join(f"<td>{_number(v)}</td>" for v in numbers)
        unit = f" [{p['unit']}]" if p["unit"] and p["unit"] != "-" else ""
        name = html.escape(printable(f"{p['name']}{unit}"))
        rows.append(f'<tr><th scope="row">{name}</th>{cells}<td>{bar}</td></tr>')
    now = ("result", "best in search") if ended else ("now",)
    return _table("What is tuned", ("", "was", *now, "from", "to", "in its range"), rows)


def _tightness(limit: dict[str, Any]) -> float:
    """Return the margin of a limit as a share of it; the least where it has none."""
    share = limit["margin"] / (abs(limit["value"]) or 1.0)
    return -math.inf if math.isnan(share) else share


def _limits(w: Watched) -> str:
    rows = []
    for one in sorted(w.limits, key=_tightness):
        sign = "at most" if one["sense"] > 0 else "at least"
        name = html.escape(f"{one['name']} {sign} {_number(one['value'])} {one['unit']}")
        kind = "" if one["margin"] >= 0 else ' class="bad"'
        rows.append(
            f'<tr{kind}><th scope="row">{name}</th><td>{_number(one["margin"], 4)}</td></tr>'
        )
    return _table("Limits of the search", ("", "margin on the worst run"), rows)


def _table(caption: str, heads: tuple[str, ...], rows: list[str]) -> str:
    if not rows:
        return ""
    top = "".join(f'<th scope="col">{h}</th>' if h else "<td></td>" for h in heads)
    return (
        f'<div class="scroll"><table><caption>{caption}</caption><thead><tr>{top}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _share(value: float | None, low: float, high: float) -> float:
    """Where a value lies between two bounds, by logarithms where they are a decade apart."""
    if value is None or not high > low:
        return 0.0
    if low > 0 and high / low >= 10 and value > 0:
        value, low, high = math.log(value), math.log(low), math.log(high)
    return min(max((value - low) / (high - low), 0.0), 1.0)


def _number(value: float | None, digits: int = SIGNIFICANT) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.{digits}g}"


def _duration(seconds: float) -> str:
    whole = max(0, round(seconds))
    return f"{whole // 60} min {whole % 60} s" if whole >= 60 else f"{whole} s"


def _title(w: Watched) -> str:
    best = "" if w.best is None else f" {_number(w.best, 4)}"
    return f"{w.state}{best}: tune {w.case}"


@cache
def _read(name: str) -> str:
    return (Path(__file__).parent / name).read_text(encoding="utf-8").strip()
