"""Text for a terminal: one printable line of limited length for any name, value or error.

Imports nothing of ours; may be imported by every folder.
"""

import base64
import html
from collections.abc import Callable, Iterable
from typing import Any

MOST = 600
"""Characters of a line. A longer one is cut in its middle: it begins with the name of the thing and
ends with what is wrong.
"""


def shortened(value: object) -> str:
    """Return `value` for a message, cut where it would fill the screen.

    Examples
    --------
    >>> shortened([1, 2])
    '[1, 2]'
    >>> len(shortened("x" * 1000))
    80
    """
    try:
        text = repr(value)
    # an int of thousands of digits, or a list in a list in a list ...
    except (ValueError, RecursionError):
        return f"a {type(value).__name__} too large to print"
    text = text.replace("\n", " ")  # of an array
    return text if len(text) <= 80 else f"{text[:77]}..."


def printable(text: object) -> str:
    r"""Return `text` with control characters, and those a terminal cannot print, as their escapes.

    Examples
    --------
    >>> print(printable("a\x1b[31m.csv"))
    a\x1b[31m.csv
    """
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in str(text)
    )


def one_line(text: object, most: int = MOST) -> str:
    """Return `text` as one printable line of at most `most` characters.

    Examples
    --------
    >>> one_line("two  lines\\nof text")
    'two lines of text'
    """
    line = printable(" ".join(str(text).split()))
    if len(line) <= most:
        return line
    gap = f" ... ({len(line) - most} characters and more are left out) ... "
    head = (most - len(gap)) * 2 // 3
    return line[:head] + gap + line[len(line) - (most - len(gap) - head) :]


def html_table(rows: Iterable[Iterable[Any]], head: Iterable[Any] = (), caption: str = "") -> str:
    """Return a small HTML table for a notebook, every text of it escaped.

    Parameters
    ----------
    rows : sequence of rows
        Each a sequence of texts or numbers.
    head : sequence, optional
        Headings of the columns.
    caption : str, optional
        A line above the table.

    Returns
    -------
    str

    Examples
    --------
    >>> print(html_table([["h1 < 5", 2.0]], ["level", "cm"], "run"))
    <table><caption>run</caption>
    <tr><th>level</th><th>cm</th></tr>
    <tr><td>h1 &lt; 5</td><td>2.0</td></tr>
    </table>
    """

    def row(cells: Iterable[Any], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(str(c))}</{tag}>" for c in cells) + "</tr>\n"

    above = f"<caption>{html.escape(caption)}</caption>" if caption else ""
    headings = row(head, "th") if head else ""
    return f"<table>{above}\n{headings}{''.join(row(cells, 'td') for cells in rows)}</table>"


PICTURES = [False]
"""Whether results show a small picture in a notebook: `jaxtank.notebook()` switches it on."""


def with_picture(table: str, draw: Callable[[], bytes | None]) -> str:
    """Return the HTML of a result, with a small picture below it once `jaxtank.notebook()` has been
    called.

    Parameters
    ----------
    table : str
        HTML.
    draw : function that returns a PNG file as bytes, None where there is nothing to draw

    Returns
    -------
    str

    Examples
    --------
    >>> with_picture("<p>", lambda: b"PNG")
    '<p>'
    """
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
