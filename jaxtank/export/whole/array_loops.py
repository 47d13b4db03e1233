"""Loops and choices of array operations. RULES holds the primitives of jax."""

import re

import numpy as np

from jaxtank.export.whole.array_dependence import needed
from jaxtank.export.whole.array_values import is_literal


def _block_lines(text, jaxpr, consts, arguments):
    """(lines, results) of a jaxpr in a block of its own."""
    inner = text.inner()
    results = inner.run(jaxpr, consts, arguments)
    return inner, results


def _state(text, starts, sizes):
    """Variables of a loop, and lines that give them their first values."""
    own = [text.array(size) for size in sizes]
    return own, [_set(n, size, start) for n, size, start in zip(own, sizes, starts)]


def _set(name, size, value):
    """The line that puts a value into a variable of a loop."""
    if is_literal(value):
        return f"{name}.fill({value});"
    return f"{name}.set(flat({size},{value}));"


def _moved(text, inner, own, new, sizes):
    """Lines that give the variables of a loop their next values, all at once."""
    first, last = [], []
    for name, value, size in zip(own, new, sizes):
        if value == name:
            continue
        if not is_literal(value) and value not in inner.made:  # perhaps another variable
            copy = next(text.names)
            first.append(f"const {copy}=flat({size},{value}).slice();")
            value = copy
        last.append(_set(name, size, value))
    return first + last


def _loop(text, own, lines):
    """Add a loop whose variables are `own` as one line."""
    whole = "\n".join(lines)
    reads = frozenset(re.findall(r"\w+", whole))
    for i, name in enumerate(own):
        # the loop stands once, where its first variable is defined
        text.lines.append((name, whole if i == 0 else "", reads | set(own)))


def scan(text, eqn, operands, wanted=None):
    p = eqn.params
    consts, carry = p["num_consts"], p["num_carry"]
    closed, count = p["jaxpr"], p["length"]
    wanted = list(range(len(eqn.outvars))) if wanted is None else wanted
    state = needed(closed.jaxpr, consts, carry, wanted)
    sequences = [i for i in wanted if i >= carry]
    sizes = [int(np.prod(eqn.outvars[i].aval.shape)) for i in state]
    own, lines = _state(text, [operands[consts + i] for i in state], sizes)
    totals = [int(np.prod(eqn.outvars[i].aval.shape)) for i in sequences]
    counter, outs = next(text.names), [text.array(size) for size in totals]
    first, up = (count - 1, "--") if p["reverse"] else (0, "++")
    end = f"{counter}>=0" if p["reverse"] else f"{counter}<{count}"
    lines.append(f"for(let {counter}={first};{end};{up}{counter}){{")
    slices, reading = [], []
    for v, x in zip(eqn.invars[consts + carry :], operands[consts + carry :]):
        each, name = int(np.prod(v.aval.shape)) // count, next(text.names)
        part = f"flat({each * count},{x}).slice({counter}*{each},{counter}*{each}+{each})"
        reading.append((name, f"const {name}={part};"))
        slices.append(name)
    inside = ["0"] * carry
    for i, name in zip(state, own):
        inside[i] = name
    inner, results = _block_lines(
        text, closed.jaxpr, closed.consts, [*operands[:consts], *inside, *slices]
    )
    results = [results[i] for i in (*state, *sequences)]
    body = inner.live(results)
    read = set(re.findall(r"\w+", " ".join([*body, *results])))
    lines += [line for name, line in reading if name in read] + body
    for name, total, e in zip(outs, totals, results[len(state) :]):
        each = total // count
        lines.append(f"{name}.set(flat({each},{e}),{counter}*{each});")
    lines += [*_moved(text, inner, own, results[: len(state)], sizes), "}"]
    _loop(text, [*own, *outs], lines)
    found = dict(zip([*state, *sequences], [*own, *outs]))
    return [found[i] for i in wanted]


def while_(text, eqn, operands):
    p = eqn.params
    first, last = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
    sizes = [int(np.prod(v.aval.shape)) for v in eqn.outvars]
    own, lines = _state(text, operands[last:], sizes)
    test, body = p["cond_jaxpr"], p["body_jaxpr"]
    inner, (on,) = _block_lines(text, test.jaxpr, test.consts, [*operands[:first], *own])
    lines += ["for(;;){", *inner.live([on]), f"if(!flat(1,{on})[0])break;"]
    inner, results = _block_lines(text, body.jaxpr, body.consts, [*operands[first:last], *own])
    lines += [*inner.live(results), *_moved(text, inner, own, results, sizes), "}"]
    _loop(text, own, lines)
    return own


def cond(text, eqn, operands, wanted=None):
    wanted = list(range(len(eqn.outvars))) if wanted is None else wanted
    sizes = [int(np.prod(eqn.outvars[i].aval.shape)) for i in wanted]
    own = [next(text.names) for _ in wanted]
    lines = [f"let {','.join(own)};"]
    branches = eqn.params["branches"]
    for i, branch in enumerate(branches):
        inner, results = _block_lines(text, branch.jaxpr, branch.consts, operands[1:])
        results = [results[i] for i in wanted]
        last = i == len(branches) - 1
        at = f"flat(1,{operands[0]})[0]"
        head = ("" if i == 0 else "else") + ("{" if last else f" if({at}<={i}){{")
        sets = [f"{n}=flat({s},{e});" for n, s, e in zip(own, sizes, results)]
        lines += [head, *inner.live(results), *sets, "}"]
    _loop(text, own, lines)
    return own


RULES = {"scan": scan, "while": while_, "cond": cond}
