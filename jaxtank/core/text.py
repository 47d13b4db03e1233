"""What is said of a name or an error on a terminal: one line that nobody has to scroll for, of
characters that a terminal prints.
"""

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
