"""Differences between a stored notebook and a new run of it: text, numbers, and what its figures
show. Imported by run.py of this folder and by the tests.

Numbers agree within one per cent or one unit of their last digit: another processor rounds
otherwise, and a search ends a little elsewhere. The time of a command and the number of simulations
of identify are not compared, nor is any number in a cell with the tag "times".
"""

import re
from html.parser import HTMLParser

NUMBER = re.compile(r"(?<![\w.])[-+\u2212]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
ROUNDING = 1e-9
"""Numbers below it are zero but for rounding, which differs from one processor to another."""

HIDDEN = (
    (re.compile(r"0x[0-9a-f]{6,}"), "0x"),  # addresses
    (re.compile(r"/tmp/[\w./-]+"), "/tmp"),
    (re.compile(r"(Run time: about )\d+ s"), r"\1# s"),
    (re.compile(r"\(\d+(\.\d+)? s\)"), "(# s)"),
    (re.compile(r"(\bMs [\d.]+(?:, Mt [\d.]+)?)\s+\d+\.\d s\b"), r"\1 # s"),
    # below the verdict of tune; of identify too, whose number of simulations follows from rounding
    (re.compile(r"\b\d+\.\d s, \d+( simulations with)"), r"# s, #\1"),
)


class Words(HTMLParser):
    """Text of an HTML fragment, without scripts and style sheets."""

    def __init__(self, source):
        super().__init__()
        self.words, self.depth = [], 0
        self.feed(source)

    def handle_starttag(self, tag, attrs):
        self.depth += tag in ("script", "style")

    def handle_endtag(self, tag):
        self.depth -= tag in ("script", "style")

    def handle_data(self, data):
        if not self.depth:
            self.words.append(data)


def numbers_agree(a, b):
    """Return whether two numbers, as printed, are equal within one per cent or their last digit."""
    a, b = a.replace("\u2212", "-"), b.replace("\u2212", "-")
    digits = [n.lower().partition("e")[0].partition(".")[2] for n in (a, b)]
    powers = [int(n.lower().partition("e")[2] or 0) for n in (a, b)]
    last = max(10.0 ** (power - len(d)) for power, d in zip(powers, digits, strict=True))
    x, y = float(a), float(b)
    if max(abs(x), abs(y)) < ROUNDING:
        return True
    return abs(x - y) <= 1.001 * last + 0.01 * max(abs(x), abs(y))


def text_differs(stored, fresh, numbers=True):
    """Return None, or how two texts differ: the first words or numbers that do."""
    for pattern, instead in HIDDEN:
        stored, fresh = pattern.sub(instead, stored), pattern.sub(instead, fresh)
    stored, fresh = " ".join(stored.split()), " ".join(fresh.split())
    if stored == fresh:
        return None
    old, new = NUMBER.split(stored), NUMBER.split(fresh)
    # Spaces and signs that line up columns move with the width of a number
    plain = lambda part: re.sub(r"[\s+-]+", " ", part).strip()
    for a, b in zip(old, new, strict=False):
        if plain(a) != plain(b):
            return f"stored {a.strip()[:80]!r}, now {b.strip()[:80]!r}"
    old, new = NUMBER.findall(stored), NUMBER.findall(fresh)
    if len(old) != len(new):
        return f"stored {len(old)} numbers, now {len(new)}"
    for a, b in zip(old, new, strict=True) if numbers else ():
        if not numbers_agree(a, b):
            return f"stored {a}, now {b}"
    return None


def joined(outputs):
    """Return the outputs of a cell, what it printed in one piece where a slow kernel sent several.

    nbclient's own coalesce_streams would also join what stands before and after a picture.
    """
    found = []
    for output in outputs:
        before = found[-1] if found else {}
        if output["output_type"] == "stream" and output["name"] == before.get("name"):
            text = "".join(before["text"]) + "".join(output["text"])
            found[-1] = type(output)(output, text=text)
        else:
            found.append(output)
    return found


def described(output):
    """Return {what: text} of one output of a cell: what a reader sees of it."""
    kind = output["output_type"]
    joined = lambda text: "".join(text)
    if kind == "stream":
        return {output["name"]: joined(output["text"])}
    if kind == "error":
        return {"error": f"{output['ename']}: {output['evalue']}"}
    data, found = output["data"], {}
    if "text/html" in data:
        found["table"] = " ".join(Words(joined(data["text/html"])).words)
    elif not joined(data.get("text/plain", "<")).startswith("<"):
        found["value"] = joined(data["text/plain"])
    if "text/latex" in data:
        found["formula"] = joined(data["text/latex"])
    for kind in data:
        if kind.startswith("image/"):
            found["figure"] = "\n".join(output["metadata"].get(kind, {}).get("drawn", ()))
    return found


def differences(stored, fresh):
    """Return one line for each difference between two notebooks {"cells": ...}, first to last."""
    old, new = stored["cells"], fresh["cells"]
    if len(old) != len(new):
        return [f"stored {len(old)} cells, now {len(new)}"]
    found = []
    for index, (a, b) in enumerate(zip(old, new, strict=True)):
        place = f"cell {index + 1}"
        numbers = "times" not in b["metadata"].get("tags", ())
        source = ["".join(cell["source"]) for cell in (a, b)]
        if a["cell_type"] != b["cell_type"]:
            found.append(f"{place}: stored {a['cell_type']}, now {b['cell_type']}")
            continue
        if a["cell_type"] == "code":
            if source[0] != source[1]:
                found.append(f"{place}: the code differs")
            outputs = [[described(o) for o in joined(cell["outputs"])] for cell in (a, b)]
            kinds = [[list(o) for o in one] for one in outputs]
            if kinds[0] != kinds[1]:
                found.append(f"{place}: stored outputs {kinds[0]}, now {kinds[1]}")
                continue
            for was, now in zip(*outputs, strict=True):
                for kind in was:
                    if how := text_differs(was[kind], now[kind], numbers):
                        found.append(f"{place}, {kind}: {how}")
        elif how := text_differs(*source, numbers):
            found.append(f"{place}, text: {how}")
    return found
