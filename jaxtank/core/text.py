"""What is said of a name or an error on a terminal: one line that nobody has to scroll for, of
characters that a terminal prints.
"""

import html
from collections.abc import Iterable
from typing import Any

MOST = 600
"""Characters of a line; what is longer is cut in its middle, for it begins with the name of the
thing and ends with what is wrong.
"""


def printable(text):
    """`text` with characters that a terminal would obey, or cannot show, as their escapes: the file
    a\\x1b[31m.csv.
    """
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in str(text)
    )


def one_line(text, most=MOST):
    """`text` as one printable line of at most `most` characters."""
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
