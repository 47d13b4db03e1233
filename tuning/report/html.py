"""A Report as one self-contained HTML page, or as a fragment for a notebook; jinja2 escapes all."""

import io
import re
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from jaxtank.core.errors import InputError
from tuning.report.document import Figure, Live, Report, Text, failed
from tuning.report.tables import Table

DENSE = 800  # points of a line that is rasterised where a picture is too large
LARGEST = 500_000  # characters of one SVG picture, above which its dense lines are rasterised
LONG = 60  # characters of a text in a cell above which it is wrapped
WIDE = 480.0  # width of a picture [pt] above which it can be enlarged in a narrow window


@cache
def _templates():
    templates = Environment(
        loader=PackageLoader("tuning.report", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    long = lambda cell: len(str(cell)) > LONG
    templates.filters |= {"identifier": identifier, "unbroken": unbroken}
    templates.tests |= {
        "table": lambda section: isinstance(section, Table),
        "long": long,
        "number": lambda cell: not isinstance(cell, str) and len(str(cell)) <= LONG // 2,
        "texts": lambda t: any(isinstance(c, str) and long(c) for c in chain(*t.rows)),
    }
    return templates


def document(report: Report, command: str | None = None, provenance: Any = ()) -> str:
    """Return the whole page of a Report; the same report gives the same bytes."""
    # command, provenance: the line that made the result, and versions, machine and seed
    sections = [s for s in report.sections if getattr(s, "on", "") != "terminal"]
    top, texts = (_texts(sections, top) for top in (True, False))
    words = [s for s in texts if isinstance(s, Text) and s.items and s.sentences]
    pictures = [_picture(s) for s in sections if isinstance(s, Figure)]
    frames = [_frame(s.result) for s in sections if isinstance(s, Live)]
    first = pictures[:1] if report.advice else []
    template = _templates().get_template("page.html")
    return template.render(
        report=report,
        command=command,
        provenance=dict(provenance),
        style=Markup(Path(__file__).with_name("page.css").read_text(encoding="utf-8")),
        frames=list(filter(None, frames)),
        words=words,
        first=first,
        top=top,
        pictures=pictures[len(first) :],
        numbers=[s for s in texts if s not in words],
    )


def _texts(sections, top):
    return [s for s in sections if isinstance(s, (Text, Table)) and s.top == top]


def fragment(sections) -> str:
    """Return Texts and Tables as HTML for a notebook."""
    part = _templates().get_template("parts.html").module.__dict__["part"]
    texts = [s for s in sections if isinstance(s, (Text, Table)) and s.on != "page"]
    return f"<div>{''.join(map(part, texts))}</div>"


def rendered(template, counts, **parts) -> str:
    """Return a template of this folder with a finished table `counts` and parts to be escaped."""
    return _templates().get_template(template).render(counts=Markup(counts), **parts)


def _frame(result):
    """The live page of a result or a Case in a frame; "" where it cannot be run in a browser."""
    from jaxtank.live.page import frame, live_page
    from tuning.report.live import live_page_of

    try:
        make = live_page_of if hasattr(result, "case") else live_page
        return Markup(frame(make(result)))
    except InputError:
        return ""
    except Exception as error:
        failed("the live page", error)
        return ""


def _picture(section):
    """(Figure, its <svg> element, whether a tap enlarges it in a narrow window)."""
    wide = 72 * section.drawing.get_size_inches()[0] > WIDE
    return section, Markup(svg(section.drawing, section.name, section.caption)), wide


def unbroken(sentence):
    """Return a sentence as HTML in which no line breaks within an option."""
    option = r'<span class="option">\g<0></span>'
    return Markup(re.sub(r"--[a-z][a-z-]*", option, str(escape(sentence))))


def identifier(name):
    return re.sub(r"[^a-z0-9]+", "-", str(name).lower()).strip("-") or "picture"


def svg(figure, name, caption=""):
    """Return a matplotlib figure as an <svg> element without dates; its ids begin with `name`."""
    # A picture of more than LARGEST characters has its dense lines rasterised.
    text = _saved(figure, name)
    if len(text) > LARGEST:
        for line in (part for ax in figure.axes for part in (*ax.lines, *ax.collections)):
            points = line.get_xydata() if hasattr(line, "get_xydata") else None
            if points is None or len(points) > DENSE:
                line.set_rasterized(True)
        text = _saved(figure, name)
    # without metadata, styles, comments and names of XML that HTML knows
    text = text[text.index("<svg") :].replace("xlink:href=", "href=")
    for pattern in (r"<metadata>.*?</metadata>", r"<style[^>]*>.*?</style>", r"<!--.*?-->\s*"):
        text = re.sub(pattern, "", text, flags=re.DOTALL)
    text, prefix = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text), identifier(name)
    # its ids begin with `prefix`; those that nothing refers to are removed
    used = {a or b for a, b in re.findall(r'url\(#([^)]+)\)|href="#([^"]+)"', text)}
    renamed = lambda m: f' id="{prefix}-{m[1]}"' if m[1] in used else ""
    text = re.sub(r' id="([^"]*)"', renamed, text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{prefix}-\1)", text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{prefix}-\1"', text)
    text = re.sub(r"<g>\s*</g>|<defs>\s*</defs>", "", text)
    label = f'<svg role="img" aria-label="{escape(caption or name)}"'
    return text.replace("<svg", label, 1).strip()


def _saved(figure, name):
    import matplotlib

    settings: dict[Any, Any] = {"svg.hashsalt": str(name), "svg.fonttype": "none"}
    settings |= {"path.simplify": True, "path.simplify_threshold": 0.3}
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    out = io.StringIO()
    with matplotlib.rc_context(settings):
        figure.savefig(out, format="svg", dpi=130, metadata=nothing)
    return out.getvalue()


def alone(figure, name):
    return svg(figure, name).replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg"', 1) + "\n"
