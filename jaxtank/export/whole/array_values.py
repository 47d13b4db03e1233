"""Arrays of numbers as JavaScript, and the functions on arrays that a text calls."""

import functools
import re
from importlib import resources

import numpy as np

from jaxtank.export.javascript import MATRICES, ROUND
from jaxtank.export.whole.compact import literal

CALLED = ("jaxpr", "call_jaxpr", "fun_jaxpr")
PART = "function part(a, b, m) {\n  return m.subarray(a, b);\n}"


def constant(array: np.ndarray) -> str:
    """Return an array of numbers as text."""
    flat = np.asarray(array, dtype=float).ravel()
    if flat.size and np.all(flat == flat[0]):
        return literal(float(flat[0]))
    if flat.size == 0:
        return "F()"
    if flat.size > 8 and np.array_equal(flat, np.arange(flat.size)):
        return f"F(...Array({flat.size}).keys())"
    places = np.flatnonzero(flat)
    if flat.size > 8 and places.size * 2 < flat.size:
        values = [literal(float(v)) for v in flat[places]]
        return f"sparse({flat.size},{listed(places)},[{','.join(values)}])"
    return f"F({','.join(literal(float(v)) for v in flat)})"


def listed(numbers):
    return f"[{','.join(str(int(v)) for v in numbers)}]"


def strides_of(shape):
    return [int(np.prod(shape[i + 1 :])) for i in range(len(shape))]


def is_literal(operand):
    return re.fullmatch(r"-?[\d.][\w.+-]*|-?Infinity|NaN", operand) is not None


def called_by(eqn):
    return next((eqn.params[k] for k in CALLED if eqn.params.get(k) is not None), None)


@functools.cache
def library() -> dict[str, str]:
    """Return {name: text} of the functions that calls of arrays call."""
    source = resources.files("jaxtank.export.whole").joinpath("arrays.js").read_text("utf-8")
    parts = re.split(r"\n(?=function )", source)[1:]
    found = {re.findall(r"function (\w+)", part)[0]: part.strip() for part in parts}
    own = {name: text.strip() for name, text in MATRICES.items()}
    return {
        **found,
        **own,
        "rint": ROUND.strip(),
        "part": PART,
        "arrays": "const arrays=(...sizes)=>sizes.map((n)=>new Float64Array(n));",
        "F": "const F=(...v)=>new Float64Array(v);",
    }


def called(text: str) -> list[str]:
    """Return the functions of `library` that a text calls, and those that they call."""
    found: dict[str, str] = {}
    rest = [text]
    while rest:
        now = rest.pop()
        for name, source in library().items():
            if name not in found and re.search(rf"(?<![\w.]){name}\(", now):
                found[name] = source
                rest.append(source)
    return list(found.values())
