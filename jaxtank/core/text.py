"""Text for a terminal: one printable line of limited length for any name, value or error.

Imports nothing of ours; may be imported by every folder.
"""

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
