"""One HTML page of a result, and the HTML that a notebook shows; imported by the reports.

A page is self-contained: pictures are inside as SVG, nothing is fetched from the network, there is
no script but that of the live page in its frame, and every text of the user is escaped.
"""

import html
import io
import itertools
import re
from functools import cache
from pathlib import Path
from typing import Any

from tuning.report.figures import failed
from tuning.report.tables import table

LARGEST = 500_000
"""Characters of one SVG picture, above which its dense lines are rasterised."""

DENSE = 800
"""Points of a line that is rasterised where a picture is too large."""

LONG = 60
"""Characters of a cell above which its text is wrapped."""

COLUMNS = 80
"""Of the lines that commands print."""

WIDE = 480.0
"""Width of a picture [pt] above which it can be enlarged in a narrow window."""


@cache
def style():
    """Return the style sheet of a page."""
    return Path(__file__).with_name("page.css").read_text(encoding="utf-8")


def escape(text):
    """Return `text` as it may stand in HTML, in an attribute as well."""
    return html.escape(str(text), quote=True)


def fragment(lines):
    """Return lines and Tables as HTML for a notebook: tables, lists and paragraphs, all escaped."""
    if not any(hasattr(line, "rows") for line in lines):
        cells = [line.partition(": ") for text in lines for line in str(text).splitlines()]
        lines = [table([[name, value] for name, _, value in cells], ["", ""])]
    return "<div>" + "\n".join(map(_part, _grouped(lines))) + "</div>"


def document(
    title,
    subtitle,
    status,
    good,
    facts,
    sentences,
    pictures,
    parts,
    command=None,
    provenance=None,
    files=None,
    live="",
    live_last=False,
):
    """Return the whole page as text; the same arguments give the same bytes."""
    body = [f"<h1>{escape(title)}</h1>", f"<p>{escape(subtitle)}</p>" if subtitle else ""]
    body.append(f'<p class="status{"" if good else " warn"}">{escape(status)}</p>')
    if facts:
        cells = (f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in facts)
        body.append(f'<dl class="facts">{"".join(cells)}</dl>')
    moved = _chapter("Move its parameters", [live] if live else [])
    if moved and not live_last:  # wider than the text
        body += ["</header>", *moved, "<main>"]
    body += _chapter("In words", [_list(sentences)] if sentences else [])
    body += _chapter("Pictures", [_figure(*picture) for picture in pictures])
    body += _chapter("Numbers", [_part(p) for p in _grouped(parts)])
    after = bool(moved) and live_last
    body += ["</main>", *moved, "<footer>"] if after else []
    for name, text in (files or {}).items():
        folded = f"<summary>{escape(name)}</summary><pre>{escape(text)}</pre>"
        body.append(f"<details>{folded}</details>")
    made = [f'<pre class="command">{escape(command)}</pre>'] if command else []
    if provenance:
        made.append(_table(["", ""], [[k, "-" if v is None else v] for k, v in provenance.items()]))
    body += ["<h2>How it was made</h2>", *made]
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title>\n<style>{style()}</style>\n</head>\n<body>",
            "<header>" if live and not live_last else "<main>",
            *filter(None, body),
            f"</{'footer' if after else 'main'}>\n</body>\n</html>\n",
        ]
    )


def _chapter(title, elements):
    """A heading with its elements; nothing where there are none."""
    return [f"<h2>{title}</h2>", *elements] if elements else []


def _list(sentences):
    return "<ul>" + "".join(f"<li>{escape(s)}</li>" for s in sentences) + "</ul>"


def _figure(name, drawing, caption):
    """A picture with its caption; a wide one is enlarged in a narrow window by a tap (page.css)."""
    width = re.search(r'viewBox="0 0 ([\d.]+)', drawing)
    wide = bool(width) and float(width[1]) > WIDE
    kind, focus = (' class="wide"', ' tabindex="0"') if wide else ("", "")
    caption = f"<figcaption>{escape(caption)}</figcaption>"
    return f'<figure id="{identifier(name)}"{kind}><div{focus}>{drawing}</div>{caption}</figure>'


def _grouped(parts):
    """Yield tables as they are, lines that follow each other as one text."""
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
    """A table as a table, lines in columns as they are, others as lists and paragraphs."""
    if hasattr(part, "rows"):
        return _table(part.head, part.rows)
    lines = str(part).splitlines()
    ruled = any(line and not line.strip("-") for line in lines)
    if ruled or any("   " in line.strip() for line in lines):
        return f"<pre>{escape(part)}</pre>"
    found = []
    dashed_lines = itertools.groupby(_unwrapped(lines), lambda line: line.startswith("- "))
    for dashed, group in dashed_lines:
        if dashed:
            found.append(_list(line[2:] for line in group))
        else:
            found += [f"<p>{escape(line)}</p>" for line in group if line.strip()]
    return "\n".join(found)


def _unwrapped(lines):
    """Yield lines as they were before they were wrapped for a terminal: an indented line goes on
    with the item of a list, and any other one with a line that had no room for its first word.
    """
    whole, last = "", ""
    for line in lines:
        full = len(last) <= COLUMNS < len(last) + 1 + len(line.split(" ")[0])
        goes_on = line.startswith("  ") if whole.startswith("- ") else full
        if whole and goes_on and not line.startswith("- "):
            whole += f" {line.strip()}"
        else:
            if whole:
                yield whole
            whole = line
        last = line
    yield whole


NUMBER = re.compile(r"[-+<>=≤≥ ]*[-+]?\d[\d.,e+\-: %]*( ?(s|cm|m|V))?|-")


def _is_long(value):
    return len(str(value)) > LONG and not NUMBER.fullmatch(str(value))


def _table(head, rows):
    """A table; one that holds long texts becomes a list of cells on a narrow window."""
    head = list(head or ())
    texts = any(_is_long(value) for row in rows for value in row)
    top = "".join(f"<th>{escape(h)}</th>" for h in head) if any(head) else ""
    heads = head if texts and head else [""] * max(map(len, rows), default=0)
    cells = ("".join(map(_cell, row, heads)) for row in rows)
    body = "".join(f"<tr>{row}</tr>" for row in cells)
    top = top and f"<thead><tr>{top}</tr></thead>"
    kind = "scroll texts" if texts and top else "scroll"
    return f'<div class="{kind}"><table>{top}<tbody>{body}</tbody></table></div>'


def _cell(value, heading):
    """A cell, which carries its heading where a narrow window shows it without its column."""
    text, kind = str(value), ""
    if NUMBER.fullmatch(text) and len(text) <= LONG // 2:
        kind = "number"
    elif len(text) > LONG:
        kind = "long"
    attributes = f' class="{kind}"' if kind else ""
    attributes += f' data-head="{escape(heading)}"' if heading else ""
    return f"<td{attributes}>{escape(text)}</td>"


def identifier(name):
    """Return `name` as an id of HTML and SVG."""
    return re.sub(r"[^a-z0-9]+", "-", str(name).lower()).strip("-") or "picture"


def drawings(drawn, captions):
    """Return [(name, SVG, caption)] of {name: figure}."""
    # A figure that cannot be drawn is removed from `drawn`, with a note on stderr.
    found = []
    for name, figure in list(drawn.items()):
        try:
            found.append((name, svg(figure, name, captions[name]), captions[name]))
        except Exception as error:
            failed(name, error, figure)
            del drawn[name]
    return found


def svg(figure, name, caption=""):
    """Return a matplotlib figure as an <svg> element without dates; its ids begin with `name`."""
    # A picture of more than LARGEST characters has its dense lines rasterised. The figure is left
    # open, its layout as it is now: what is drawn of it later need not be laid out again.
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
    text = _own_ids(_stripped(text[text.index("<svg") :]), identifier(name))
    label = f'<svg role="img" aria-label="{escape(caption or name)}"'
    return text.replace("<svg", label, 1).strip()


def _stripped(text):
    """An <svg> element without metadata, styles, comments and names of XML that HTML knows."""
    for pattern in (r"<metadata>.*?</metadata>", r"<style[^>]*>.*?</style>", r"<!--.*?-->\s*"):
        text = re.sub(pattern, "", text, flags=re.DOTALL)
    return re.sub(r' xmlns(:\w+)?="[^"]*"', "", text.replace("xlink:href=", "href="))


def _own_ids(text, prefix):
    """An <svg> element whose ids begin with `prefix`; those that nothing refers to are removed."""
    used = {a or b for a, b in re.findall(r'url\(#([^)]+)\)|href="#([^"]+)"', text)}
    text = re.sub(
        r' id="([^"]*)"', lambda m: f' id="{prefix}-{m[1]}"' if m[1] in used else "", text
    )
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{prefix}-\1)", text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{prefix}-\1"', text)
    return re.sub(r"<g>\s*</g>|<defs>\s*</defs>", "", text)


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
    """Return a matplotlib figure as the text of an SVG file."""
    return svg(figure, name).replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg"', 1) + "\n"
