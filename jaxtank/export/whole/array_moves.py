"""Array operations that only move elements. RULES holds the primitives of jax."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.export.primitives import no_code
from jaxtank.export.whole.array_values import is_literal, listed, strides_of


def view(text, operand, shape, strides, start: Any = 0):
    """A view of an array as a new one, entry by entry."""
    size = int(np.prod(shape))
    axes = merged(shape, strides)
    if is_literal(operand):
        return text.constant(np.full(size, float(operand)))
    if len(axes) <= 1:
        step = axes[0][1] if axes else 0
        return text.filled(size, "", f"{operand}[{place(start, [('x', step)])}]")
    name, counters = text.array(size), [next(text.names) for _ in axes]
    loops = "".join(f"for(let {i}=0;{i}<{n};++{i})" for i, (n, _) in zip(counters, axes))
    at = place(start, [(i, step) for i, (_, step) in zip(counters, axes)])
    text.line(name, f"{{let x=0;{loops}{name}[x++]={operand}[{at}];}}")
    return name


def merged(shape, strides):
    """Return [(length, stride)] of the axes, without those of length 1, runs of them as one."""
    axes: list[tuple[int, int]] = []
    for length, stride in zip(shape, strides):
        if length == 1:
            continue
        if axes and axes[-1][1] == stride * length:
            axes[-1] = axes[-1][0] * length, stride
        else:
            axes.append((length, stride))
    return axes


def place(start, terms):
    """Return the text of an index: start + counter stride + ..."""
    parts = [] if start == 0 or start == "0" else [str(start)]
    parts += [i if step == 1 else f"{i}*{step}" for i, step in terms if step]
    return "+".join(parts) or "0"


def spread(text, v, out, operand):
    """An operand in the shape of the result, where its axes of length 1 stand for longer ones."""
    own, shape = v.aval.shape, out.aval.shape
    if own == shape or int(np.prod(own)) == 1:
        return operand
    strides = [0 if n == 1 else s for n, s in zip(own, strides_of(own))]
    return view(text, operand, shape, strides)


def _broadcast(text, eqn, operands):
    shape, dimensions = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    source = eqn.invars[0].aval.shape
    own, strides = strides_of(source), [0] * len(shape)
    for i, d in enumerate(dimensions):
        strides[d] = own[i] if source[i] != 1 else 0
    if int(np.prod(source)) == int(np.prod(shape)):
        return operands[0]
    return view(text, operands[0], shape, strides)


def _transpose(text, eqn, operands):
    order = eqn.params["permutation"]
    source = eqn.invars[0].aval.shape
    own = strides_of(source)
    return view(text, operands[0], [source[i] for i in order], [own[i] for i in order])


def _slice(text, eqn, operands):
    p, own = eqn.params, strides_of(eqn.invars[0].aval.shape)
    steps = p["strides"] or [1] * len(own)
    start = sum(a * b for a, b in zip(p["start_indices"], own))
    return view(
        text, operands[0], eqn.outvars[0].aval.shape, [a * b for a, b in zip(own, steps)], start
    )


def _rev(text, eqn, operands):
    shape = eqn.invars[0].aval.shape
    own = strides_of(shape)
    back = eqn.params["dimensions"]
    start = sum(own[d] * (shape[d] - 1) for d in back)
    return view(
        text, operands[0], shape, [-s if d in back else s for d, s in enumerate(own)], start
    )


def _concatenate(text, eqn, operands):
    axis = eqn.params.get("dimension", eqn.params.get("axis", 0))
    if eqn.primitive.name == "stack":
        outer = int(np.prod(eqn.invars[0].aval.shape[:axis]))
    else:
        outer = int(np.prod(eqn.outvars[0].aval.shape[:axis]))
    sizes = [int(np.prod(v.aval.shape)) // outer for v in eqn.invars]
    return text.let(f"chain({outer},{listed(sizes)},[{','.join(operands)}])")


def _split(text, eqn, operands):
    axis, shape = eqn.params["axis"], eqn.invars[0].aval.shape
    own, start, out = strides_of(shape), 0, []
    for v in eqn.outvars:
        out.append(view(text, operands[0], v.aval.shape, own, start * own[axis]))
        start += v.aval.shape[axis]
    return out


def _pad(text, eqn, operands):
    shape, out = eqn.invars[0].aval.shape, eqn.outvars[0].aval.shape
    config = eqn.params["padding_config"]
    if any(low < 0 or high < 0 or inner for low, high, inner in config):
        raise no_code("it cuts an array by padding it")
    own = strides_of(out)
    start = sum(low * s for (low, _, _), s in zip(config, own))
    size = int(np.prod(out))
    fill = operands[1] if is_literal(operands[1]) else f"{operands[1]}[0]"
    return text.let(f"put({size},{fill},{operands[0]},{listed(shape)},{listed(own)},{start})")


def _offset(shape, sizes, own, indices):
    places = [f"within({i},{n - m})*{s}" for i, n, m, s in zip(indices, shape, sizes, own) if n > m]
    return "+".join(places) or "0"


def _dynamic_slice(text, eqn, operands):
    shape, sizes = eqn.invars[0].aval.shape, eqn.params["slice_sizes"]
    own = strides_of(shape)
    return view(text, operands[0], sizes, own, _offset(shape, sizes, own, operands[1:]))


def _dynamic_update(text, eqn, operands):
    shape, sizes = eqn.invars[0].aval.shape, eqn.invars[1].aval.shape
    own = strides_of(shape)
    start = _offset(shape, sizes, own, operands[2:])
    size = int(np.prod(shape))
    return text.let(
        f"put({size},{operands[0]},{operands[1]},{listed(sizes)},{listed(own)},{start})"
    )


def _moved_by_number(text, eqn, operands):
    """What moves elements in another way, by the numbers of its elements."""
    table, ids, texts = 0, [], []
    for v, operand in zip(eqn.invars, operands):
        shape, size = v.aval.shape, int(np.prod(v.aval.shape))
        if jnp.issubdtype(v.aval.dtype, jnp.integer) and len(ids):
            if not is_literal(operand) and operand not in text.numbers:
                raise no_code("it reads an array at an index that it computes")
            found = text.numbers.get(operand)
            found = np.full(shape, float(operand)) if found is None else found
            ids.append(np.broadcast_to(found, found.shape).reshape(shape).astype(v.aval.dtype))
            continue
        ids.append(np.arange(table, table + size, dtype=np.int64).reshape(shape))
        table += size
        texts.append(f"flat({size},{operand})")
    params = eqn.primitive.get_bind_params(eqn.params)
    functions, params = params if isinstance(params, tuple) else ((), params)
    with jax.ensure_compile_time_eval():
        out = eqn.primitive.bind(*functions, *map(jnp.asarray, ids), **params)
    return text.let(f"pick({listed(np.ravel(np.asarray(out)))},{','.join(texts)})")


def _iota(text, eqn, operands):
    p = eqn.params
    array = np.arange(p["shape"][p["dimension"]])
    shape = [-1 if d == p["dimension"] else 1 for d in range(len(p["shape"]))]
    return text.constant(np.broadcast_to(array.reshape(shape), p["shape"]))


RULES = {
    "broadcast_in_dim": _broadcast,
    "transpose": _transpose,
    "slice": _slice,
    "rev": _rev,
    "concatenate": _concatenate,
    "stack": _concatenate,
    "split": _split,
    "pad": _pad,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update,
    "gather": _moved_by_number,
    "scatter": _moved_by_number,
    "tile": _moved_by_number,
    "iota": _iota,
}
"""{primitive of jax: function (text, equation, operands) -> text of the result, or a list}."""
