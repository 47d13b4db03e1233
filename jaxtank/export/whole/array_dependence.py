"""Which results of a loop or a choice depend on which arguments: they are computed apart."""

from jax.extend.core import Literal

from jaxtank.export.whole.array_values import called_by

CONTROL = ("scan", "while", "cond")


def groups_of(eqn):
    """Return the results of a loop in groups that depend on the same arguments: lists of numbers.

    The tangents of a loop and the loop itself are one equation; the loop does not depend on them.
    """
    groups: dict[frozenset, list[int]] = {}
    alone = [{i} for i in range(len(eqn.invars))]
    of = _scan_dependence if eqn.primitive.name == "scan" else _cond_dependence
    for i, found in enumerate(of(eqn, alone)):
        groups.setdefault(frozenset(found), []).append(i)
    return list(groups.values())


def _scan_dependence(eqn, given):
    """What each result of a loop depends on, for what its operands depend on."""
    p = eqn.params
    consts, carry = p["num_consts"], p["num_carry"]
    starts = [set(v) for v in given[consts : consts + carry]]
    while True:
        out = dependence(p["jaxpr"].jaxpr, [*given[:consts], *starts, *given[consts + carry :]])
        new = [a | b for a, b in zip(starts, out)]
        if new == starts:
            return [*new, *out[carry:]]
        starts = new


def _cond_dependence(eqn, given):
    """What each result of a choice depends on."""
    found = [dependence(b.jaxpr, given[1:]) for b in eqn.params["branches"]]
    return [given[0].union(*own) for own in zip(*found)]


def dependence(jaxpr, given):
    """What each result of a jaxpr depends on."""
    known = {v: set() for v in jaxpr.constvars} | dict(zip(jaxpr.invars, given))

    def read(v):
        return set() if isinstance(v, Literal) else known[v]

    for eqn in jaxpr.eqns:
        operands = [read(v) for v in eqn.invars]
        inner = called_by(eqn) if eqn.primitive.name not in CONTROL else None
        if eqn.primitive.name == "scan":
            out = _scan_dependence(eqn, operands)
        elif eqn.primitive.name == "cond":
            out = _cond_dependence(eqn, operands)
        elif inner is not None:
            out = dependence(getattr(inner, "jaxpr", inner), operands)
        else:
            out = [set().union(*operands)] * len(eqn.outvars)
        known.update(zip(eqn.outvars, out))
    return [read(v) for v in jaxpr.outvars]


def needed(jaxpr, consts, carry, wanted):
    """The carried variables that some results of a loop need, themselves among them."""
    alone = [set() for _ in range(consts)] + [{i} for i in range(carry)]
    alone += [set() for _ in jaxpr.invars[consts + carry :]]
    out = dependence(jaxpr, alone)
    need = {i for i in wanted if i < carry}
    while True:
        new = need.union(*(out[i] for i in [*need, *wanted]))
        if new == need:
            return sorted(need)
        need = new
