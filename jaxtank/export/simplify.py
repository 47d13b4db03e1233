"""Operations on numbers and variables, evaluated or shortened where the arguments allow it."""

import math
import operator

import numpy as np

from jaxtank.export.statements import Ref

FUNCTIONS = {
    "logistic": lambda a: 1.0 / (1.0 + np.exp(-a)),
    "erf": math.erf,
    "erfc": math.erfc,
    "log1p": np.log1p,
    "expm1": np.expm1,
    "exp2": np.exp2,
    "cbrt": np.cbrt,
    "ceil": np.ceil,
    "rem": np.fmod,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
    "div": np.divide,
    "sqrt": np.sqrt,
    "rsqrt": lambda a: 1 / np.sqrt(a),
    "exp": np.exp,
    "log": np.log,
    "tanh": np.tanh,
    "sin": np.sin,
    "cos": np.cos,
    "floor": np.floor,
    "round": np.round,
    "sign": np.sign,
}
"""Functions of real numbers; the result is made a float."""

OPERATORS = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "neg": operator.neg,
    "abs": abs,
    "max": max,
    "min": min,
    "pow": operator.pow,
    "square": lambda a: a * a,
    "lt": operator.lt,
    "le": operator.le,
    "gt": operator.gt,
    "ge": operator.ge,
    "eq": operator.eq,
    "ne": operator.ne,
    "and": lambda a, b: a and b,
    "or": lambda a, b: a or b,
    "not": operator.not_,
    "is_finite": np.isfinite,
    "quotient": lambda a, b: int(a / b),  # of whole numbers, rounded towards zero
    "remainder": math.fmod,
    "real": float,
    "whole": int,
    "truth": bool,
}
"""Operations whose result keeps its own type."""


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


def _add(a, b):
    return b if _is(a, 0) else a if _is(b, 0) else None


def _sub(a, b):
    return a if _is(b, 0) else 0.0 if a == b else None


def _mul(a, b):
    if _is(a, 1) or _is(b, 1):
        return b if _is(a, 1) else a
    return 0.0 if _is(a, 0) or _is(b, 0) else None


def _div(a, b):
    return a if _is(b, 1) else 0.0 if _is(a, 0) else None


def _and(a, b):
    if not (is_number(a) or is_number(b)):
        return None
    number, other = (a, b) if is_number(a) else (b, a)
    return other if number else False


RULES = {"select": _select, "add": _add, "sub": _sub, "mul": _mul, "div": _div, "and": _and}
"""{operation: function of its arguments that returns a shorter form, or None}."""
