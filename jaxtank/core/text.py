"""Text for a terminal: one printable line of limited length for any name, value or error."""

import base64
import csv
import html
import io
from collections.abc import Callable, Iterable
from typing import Any

MOST = 600
"""Characters of a line. A longer one is cut in its middle: it begins with the name of the thing and
ends with what is wrong.
"""


def shortened(value: object) -> str:
    """Return `value` for a message, cut where it would fill the screen."""
    try:
        text = repr(value)
    # an int of thousands of digits, or a list in a list in a list ...
    except (ValueError, RecursionError):
        return f"a {type(value).__name__} too large to print"
    text = text.replace("\n", " ")  # of an array
    return text if len(text) <= 80 else f"{text[:77]}..."


def printable(text: object) -> str:
    """Return `text` with control and unprintable characters as escapes."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in str(text)
    )


def count(number: int, thing: str) -> str:
    """Return a number with its noun in the singular or the plural."""
    plural = f"{thing}es" if thing.endswith(("s", "ch", "sh", "x")) else f"{thing}s"
    return f"{number} {thing if number == 1 else plural}"


def one_line(text: object, most: int = MOST) -> str:
    """Return `text` as one printable line of at most `most` characters."""
    line = printable(" ".join(str(text).split()))
    if len(line) <= most:
        return line
    gap = f" ... ({len(line) - most} characters and more are left out) ... "
    head = (most - len(gap)) * 2 // 3
    return line[:head] + gap + line[len(line) - (most - len(gap) - head) :]


def csv_line(cells: Iterable[Any]) -> str:
    """Return cells as a line of CSV: a comma or a quotation mark in one is quoted."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerow(cells)
    return out.getvalue()


def html_table(rows: Iterable[Iterable[Any]], head: Iterable[Any] = (), caption: str = "") -> str:
    """Return a small HTML table for a notebook, every text of it escaped."""

    def row(cells: Iterable[Any], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(str(c))}</{tag}>" for c in cells) + "</tr>\n"

    above = f"<caption>{html.escape(caption)}</caption>" if caption else ""
    headings = row(head, "th") if head else ""
    return f"<table>{above}\n{headings}{''.join(row(cells, 'td') for cells in rows)}</table>"


PICTURES = [False]
"""Whether results show a small picture in a notebook: `jaxtank.notebook()` switches it on."""


def with_picture(table: str, draw: Callable[[], bytes | None]) -> str:
    """Return the HTML of a result, with a picture after `jaxtank.notebook()`."""
    if not PICTURES[0]:
        return table
    try:
        png = draw()
    except Exception as error:  # numbers are shown whatever their picture does
        return table + f"<p>no picture: {html.escape(one_line(str(error)))}</p>"
    if png is None:
        return table
    data = base64.b64encode(png).decode("ascii")
    return f'{table}<img alt="" style="max-width:100%" src="data:image/png;base64,{data}">'
