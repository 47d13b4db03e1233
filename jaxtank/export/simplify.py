"""Operations on numbers and variables, evaluated or shortened where the arguments allow it."""

import math
import operator

import numpy as np

from jaxtank.export.statements import Ref

_SAME = "log1p expm1 exp2 cbrt ceil tan sinh cosh sqrt exp log tanh sin cos floor round sign"
_ARC, _PLAIN = "sin cos tan sinh cosh tanh tan2", "add sub mul neg pow lt le gt ge eq ne"
FUNCTIONS = {  # functions of real numbers; the result is made a float
    **{name: getattr(np, name) for name in _SAME.split()},
    **{f"a{f}": getattr(np, f"arc{f}") for f in _ARC.split()},
    "logistic": lambda a: 1.0 / (1.0 + np.exp(-a)),
    "erf": math.erf,
    "erfc": math.erfc,
    "rem": np.fmod,
    "div": np.divide,
    "rsqrt": lambda a: 1 / np.sqrt(a),
}

OPERATORS = {  # operations whose result keeps its own type
    **{op: getattr(operator, op) for op in _PLAIN.split()},
    **{"abs": abs, "max": max, "min": min, "real": float, "whole": int, "truth": bool},
    "square": lambda a: a * a,
    "and": lambda a, b: a and b,
    "or": lambda a, b: a or b,
    "not": operator.not_,
    "is_finite": np.isfinite,
    "quotient": lambda a, b: int(a / b),  # of whole numbers, rounded towards zero
    "remainder": math.fmod,
}


def is_number(value) -> bool:
    """Return whether an element is a number rather than a variable."""
    return not isinstance(value, Ref)


def simplified(op, args):
    """Return op(args) where it is a number or one of the arguments, else None."""
    if op != "select" and all(map(is_number, args)):
        return compute(op, args)
    return RULES[op](*args) if op in RULES else None


def compute(op, args):
    """Return op(args) of numbers."""
    return OPERATORS[op](*args) if op in OPERATORS else float(FUNCTIONS[op](*args))


def _is(value, number):
    """Whether an element is this number, and no truth value."""
    return is_number(value) and not isinstance(value, bool) and value == number


def _select(condition, no, yes):
    if is_number(condition):
        return yes if condition else no
    return no if (no is yes or no == yes) and type(no) is type(yes) else None


def _mul(a, b):
    if _is(a, 1) or _is(b, 1):
        return b if _is(a, 1) else a
    return 0.0 if _is(a, 0) or _is(b, 0) else None


def _and(a, b):
    if not (is_number(a) or is_number(b)):
        return None
    number, other = (a, b) if is_number(a) else (b, a)
    return other if number else False


RULES = {  # {operation: function of its arguments that returns a shorter form, or None}
    "select": _select,
    "add": lambda a, b: b if _is(a, 0) else a if _is(b, 0) else None,
    "sub": lambda a, b: a if _is(b, 0) else 0.0 if a == b else None,
    "mul": _mul,
    "div": lambda a, b: a if _is(b, 1) else 0.0 if _is(a, 0) else None,
    "and": _and,
}
