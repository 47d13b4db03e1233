"""Lines of a rig file at which its tables and keys stand, for messages."""

import re
from typing import Any

_HEADER = re.compile(r"\s*\[(\[?)\s*\"?([\w.-]+)\"?\s*\]")
_KEY = re.compile(r"\s*\"?([\w.\[\]-]+)\"?\s*=")
_TEXT = re.compile(r"\"(?:\\.|[^\"\\])*\"|'[^']*'")

Place = tuple[str, int | None, str | None]
"""(section, index of its table from 0, key); None where there is none."""


def lines_of(text: str) -> dict[Place, int]:
    """Return {place: number of its line, from 1} of a rig file; places that a scan by lines misses
    are left out.
    """
    lines: dict[Place, int] = {}
    counts: dict[str, int] = {}
    section, index, depth = "", None, 0
    for number, line in enumerate(text.splitlines(), 1):
        bare = _TEXT.sub('""', line).partition("#")[0]
        header, key = _HEADER.match(line), _KEY.match(line)
        if header and depth == 0:
            section, index = header[2], None
            if header[1]:
                index = counts[section] = counts.get(section, -1) + 1
            lines.setdefault((section, index, None), number)
        elif key and depth == 0:
            lines.setdefault((section, index, key[1]), number)
        if depth == 0 and key and not section:
            inline = key[1]
        if not section and (key or depth):  # tank = [{ ... }, { ... }]
            for _ in range(bare.count("{")):
                counts[inline] = counts.get(inline, -1) + 1
                lines.setdefault((inline, counts[inline], None), number)
            lines.setdefault((inline, None, None), number)
        depth = max(depth + bare.count("[") - bare.count("]") if not header else 0, 0)
    return lines


def line_of(lines: dict[Place, int], place: Any) -> int | None:
    """Return the line of a place, else of its table; None where that is not known."""
    section, index, key = place
    names = [section, "sensor"] if section == "sensors" else [section]
    names += {"controller": ["law"], "inflow": ["pour"]}.get(section, [])
    tries = [(n, i, k) for k in (key, None) for n in names for i in (index, None)]
    tries += [("", None, section), ("", None, key)]
    return next((lines[t] for t in tries if t in lines), None)
