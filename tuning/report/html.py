"""One HTML page of a result: self-contained, to be read on a phone, printed and kept.

Pictures are inside as SVG; nothing is asked of the network, and there is no script. Whatever came
from a user is escaped.
"""

import html
import io
import re
from typing import Any

from tuning.report.figures import failed

LARGEST = 500_000
"""Characters of one picture as lines, above which its dense lines become dots of a fixed number."""

DENSE = 800
"""Points of a line that may be drawn as dots where a picture is too large."""

LONG = 60
"""Characters of a cell above which it is text that is wrapped."""

WIDE = 480.0
"""Width of a picture [pt] above which it is not squeezed into a narrower window than it can be read
in.
"""

STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { max-width: 62rem; margin: 0 auto; padding: 1rem; background: #fff; color: #1a1a1a;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; overflow-wrap: anywhere; }
h1 { font-size: 1.5rem; line-height: 1.2; margin: 0.5rem 0; }
h2 { font-size: 1.15rem; margin: 2rem 0 0.5rem; padding-top: 0.5rem; border-top: 1px solid #ccc; }
.status { display: inline-block; margin: 0.25rem 0; padding: 0.2rem 0.7rem;
  border-left: 0.4rem solid #0072b2; background: #eef5fa; font-weight: 600; }
.status.warn { border-color: #d55e00; background: #fdf1e8; }
.facts { display: grid; grid-template-columns: repeat(auto-fill, minmax(10.5rem, 1fr)); gap: 0.6rem; margin: 1rem 0; padding: 0; }
.facts div { border: 1px solid #ccc; border-radius: 4px; padding: 0.5rem 0.7rem; }
.facts dt { font-size: 0.8rem; color: #444; }
.facts dd { margin: 0; font-size: 1.15rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.scroll { overflow-x: auto; margin: 0.75rem 0; }
table { border-collapse: collapse; font-size: 0.88rem; overflow-wrap: normal; }
th, td { padding: 0.25rem 0.7rem 0.25rem 0; text-align: left; vertical-align: top; border-bottom: 1px solid #ddd; }
th { border-bottom: 2px solid #888; }
td.number { font-variant-numeric: tabular-nums; white-space: nowrap; }
td.long { min-width: 10rem; }
@media screen and (max-width: 60rem) { /* a table of texts has no room for its columns: one below the other, each with its heading */
  .texts table, .texts tbody, .texts tr, .texts td { display: block; }
  .texts thead { display: none; }
  .texts tr { border-bottom: 1px solid #888; padding: 0.4rem 0; }
  .texts td { border: 0; padding: 0.1rem 0; white-space: normal; overflow-wrap: anywhere; }
  .texts td::before { content: attr(data-head) ": "; color: #444; }
  .texts td:first-child { font-weight: 600; }
  .texts td:first-child::before, .texts td:empty::before { content: none; }
}
figure { margin: 1.2rem 0; }
figure svg, figure img { display: block; max-width: 100%; height: auto; margin: 0 auto; }
figure svg * { stroke-linejoin: round; stroke-linecap: butt; }
@media screen { figure.wide { overflow-x: auto; } figure.wide svg { min-width: 40rem; } }
figcaption { font-size: 0.88rem; color: #333; margin-top: 0.4rem; }
pre, code { font: 0.85rem/1.4 ui-monospace, "DejaVu Sans Mono", monospace; }
pre { background: #f5f5f5; padding: 0.6rem 0.8rem; overflow-x: auto; overflow-wrap: normal; }
pre.command { white-space: pre-wrap; }
@media print {
  body { max-width: none; padding: 0; font-size: 10pt; }
  h2 { break-after: avoid; }
  figure, .facts div, tr { break-inside: avoid; }
  figure svg { max-height: 20cm; }
  .scroll, pre { overflow: visible; white-space: pre-wrap; }
  table { font-size: 7.5pt; }
}
"""


def escape(text):
    """`text` as it may stand in HTML, in an attribute as well."""
    return html.escape(str(text), quote=True)


def document(
    title,
    subtitle,
    status,
    good,
    facts,
    said,
    pictures,
    parts,
    command=None,
    provenance=None,
    files=None,
):
    """The whole page as text; the same arguments give the same bytes.

    title, subtitle: of the page; status: how it ended, good: True, or False for a warning; facts:
    [(what, value)] to be read first; said: a list of sentences; pictures: [(name, SVG of `svg`,
    caption)], names unique; parts: texts and tables (`report.Table`) as the command prints them;
    command: the line that made it, None where none did; provenance: {name: value}; files: {name:
    text} to be looked at on request.
    """
    body = [f"<h1>{escape(title)}</h1>", f"<p>{escape(subtitle)}</p>" if subtitle else ""]
    body.append(f'<p class="status{"" if good else " warn"}">{escape(status)}</p>')
    if facts:
        cells = "".join(
            f"<div><dt>{escape(what)}</dt><dd>{escape(value)}</dd></div>" for what, value in facts
        )
        body.append(f'<dl class="facts">{cells}</dl>')
    if said:
        body += ["<h2>In words</h2>", _list(said)]
    if pictures:
        body.append("<h2>Pictures</h2>")
        body += [_figure(*picture) for picture in pictures]
    if parts:
        body += ["<h2>Numbers</h2>", *(_part(p) for p in _grouped(parts))]
    for name, text in (files or {}).items():
        body.append(
            f"<details><summary>{escape(name)}</summary><pre>{escape(text)}</pre></details>"
        )
    body.append("<h2>How it was made</h2>")
    if command:
        body.append(f'<pre class="command">{escape(command)}</pre>')
    if provenance:
        body.append(_table(["", ""], [[k, "-" if v is None else v] for k, v in provenance.items()]))
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>",
            *filter(None, body),
            "</main>\n</body>\n</html>\n",
        ]
    )


def _list(sentences):
    return "<ul>" + "".join(f"<li>{escape(s)}</li>" for s in sentences) + "</ul>"


def _figure(name, drawing, caption):
    width = re.search(r'viewBox="0 0 ([\d.]+)', drawing)
    wide = (
        ' class="wide"' if width and float(width[1]) > WIDE else ""
    )  # on a phone it is pushed aside rather than made too small to read
    return (
        "<figure"
        f' id="{identifier(name)}"{wide}>{drawing}<figcaption>{escape(caption)}</figcaption></figure>'
    )


def _grouped(parts):
    """Tables as they are, lines that follow each other as one text."""
    group = []
    for part in [*parts, ""]:
        if group and (hasattr(part, "rows") or not part.strip()):
            yield "\n".join(group)
            group = []
        if hasattr(part, "rows"):
            yield part
        elif part.strip():
            group.append(part)


def _part(part):
    """A table as a table, lines that begin with a dash as a list, lines set in columns as they are,
    others as paragraphs.
    """
    if hasattr(part, "rows"):
        return _table(part.head, part.rows)
    lines = str(part).splitlines()
    if any(line and not line.strip("-") for line in lines) or any(
        "   " in line.strip() for line in lines
    ):
        return f"<pre>{escape(part)}</pre>"
    out, items = [], []
    for line in [*lines, ""]:
        if line.startswith("- "):
            items.append(line[2:])
            continue
        if items:
            out.append(_list(items))
            items = []
        if line.strip():
            out.append(f"<p>{escape(line)}</p>")
    return "\n".join(out)


NUMBER = re.compile(r"[-+<>=≤≥ ]*[-+]?\d[\d.,e+\-: %]*( ?(s|cm|m|V))?|-")


def _table(head, rows):
    texts = any(
        len(str(value)) > LONG and not NUMBER.fullmatch(str(value)) for row in rows for value in row
    )

    def cell(value, heading):
        text = str(value)
        kind = (
            "number"
            if NUMBER.fullmatch(text) and len(text) <= LONG // 2
            else "long"
            if len(text) > LONG
            else ""
        )
        attributes = (f' class="{kind}"' if kind else "") + (
            f' data-head="{escape(heading)}"' if texts and heading else ""
        )
        return f"<td{attributes}>{escape(text)}</td>"

    top = (
        "<thead><tr>" + "".join(f"<th>{escape(h)}</th>" for h in head) + "</tr></thead>"
        if any(head or ())
        else ""
    )
    heads = list(head or ()) or [""] * max(map(len, rows), default=0)
    body = "".join("<tr>" + "".join(map(cell, row, heads)) + "</tr>" for row in rows)
    return (
        "<div"
        f' class="scroll{" texts" if texts and top else ""}"><table>{top}<tbody>{body}</tbody></table></div>'
    )


def identifier(name):
    """`name` as an id of HTML and SVG."""
    return re.sub(r"[^a-z0-9]+", "-", str(name).lower()).strip("-") or "picture"


def drawings(drawn, captions):
    """[(name, SVG, caption)] of {name: figure}; a figure that cannot be drawn is taken out of it,
    with a note on stderr.
    """
    found = []
    for name, figure in list(drawn.items()):
        try:
            found.append((name, svg(figure, name, captions[name]), captions[name]))
        except Exception as error:
            failed(name, error, figure)
            del drawn[name]
    return found


def svg(figure, name, caption=""):
    """A matplotlib figure as an <svg> element: no dates, no names of fonts to fetch, ids that begin
    with `name` and so clash with no other's.

    A picture of more than LARGEST characters has its dense lines made of dots. The figure is left
    open, its layout as it is now: what is drawn of it later need not be laid out again.
    """
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    text = _saved(figure, name)
    if len(text) > LARGEST:
        for ax in figure.axes:
            for line in (*ax.lines, *ax.collections):
                points = line.get_xydata() if hasattr(line, "get_xydata") else None
                if points is None or len(points) > DENSE:
                    line.set_rasterized(True)
        text = _saved(figure, name)
    prefix = identifier(name)
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<style[^>]*>.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL)
    text = text.replace("xlink:href=", "href=")
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)  # HTML knows what an svg is
    used = set(re.findall(r'url\(#([^)]+)\)|href="#([^"]+)"', text))
    used = {a or b for a, b in used}
    text = re.sub(
        r' id="([^"]*)"', lambda m: f' id="{prefix}-{m[1]}"' if m[1] in used else "", text
    )
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{prefix}-\1)", text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{prefix}-\1"', text)
    text = re.sub(r"<g>\s*</g>|<defs>\s*</defs>", "", text)
    return text.replace(
        "<svg", f'<svg role="img" aria-label="{escape(caption or name)}"', 1
    ).strip()


def _saved(figure, name):
    import matplotlib

    out = io.StringIO()
    settings: dict[Any, Any] = {
        "svg.hashsalt": str(name),
        "svg.fonttype": "none",
        "path.simplify": True,
        "path.simplify_threshold": 0.3,
    }
    with matplotlib.rc_context(settings):
        figure.savefig(
            out,
            format="svg",
            dpi=130,
            metadata={"Date": None, "Creator": None, "Format": None, "Type": None},
        )
    return out.getvalue()


def alone(figure, name):
    """A matplotlib figure as the text of an SVG file, for a document of one's own."""
    return svg(figure, name).replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg"', 1) + "\n"
