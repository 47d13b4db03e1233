"""A look at the text of a rig file before it is parsed: tomllib takes a time that grows with the square of the parts of a dotted key."""

import re

from jaxtank.core.errors import InputError

MOST = 100
"""Parts of a dotted key; the names of a rig have four."""

MOST_WORDS = 100_000
"""Keys (each part of one), numbers (those with a point twice), texts, lists and tables of a file: it is parsed and checked in seconds."""

_PART = r"""(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\[^\n])*+"|'[^'\n]*+')"""
# Every alternative is possessive: nothing is read twice, whatever is left open. A value has two such parts at most, those of a float.
_TOKEN = re.compile(
    r'''(?P<text>"""(?:[^"\\]|\\.|"{1,2}(?!"))*+"{3,5}|\'\'\'(?:[^']|'{1,2}(?!'))*+'{3,5})'''
    rf"""|(?P<open>\"\"\"|''')|(?P<key>{_PART}(?:[ \t]*+\.[ \t]*+{_PART})*+)|(?P<quote>["'])|[\[{{]|(?:\#[^\n]*+\s*+)++""",
    re.DOTALL,
)
_ONE = re.compile(_PART)


def check_keys(text):
    """Raise InputError for a key of more than `MOST` dotted parts, and for a file of more than `MOST_WORDS` words. Dots of numbers, texts
    and comments are none of a key's."""
    words = 0
    for token in _TOKEN.finditer(text):
        if token.lastgroup in ("open", "quote"):
            return  # a text without an end: the parser gets no further either
        parts = sum(1 for _ in _ONE.finditer(token.group())) if token.lastgroup == "key" and "." in token.group() else 1
        if parts > MOST:
            line = text.count("\n", 0, token.start()) + 1
            raise InputError(f"line {line}: a key of {parts} parts joined by dots: must be at most {MOST}")
        words += parts
        if words > MOST_WORDS:
            raise InputError(f"has more than {MOST_WORDS} keys and values")
