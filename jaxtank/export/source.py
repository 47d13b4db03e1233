"""A law and its observer as one file without dependencies: C99, or a MATLAB function, made from the
same step function that is simulated.
"""

import re

from jaxtank.controllers import OpenLoop
from jaxtank.core.errors import InputError
from jaxtank.export.c import C_CALLS, print_c
from jaxtank.export.matlab import TAKEN_M, print_matlab
from jaxtank.export.printer import SAME_NAME, Code, function_name

LANGUAGES = ("c", "m")
PRECISIONS = ("double", "float")


def export(case, language="c", precision="double", name=None):
    """The law of a Case as source code.

    language: "c" (C99) or "m" (MATLAB); precision: "double" or "float" (of C); name: of the
    functions, made from the case's where None. Returns the text of one file. Raises InputError for
    a law that plays a signal back, and one that uses an operation without a counterpart.
    """
    if language not in LANGUAGES:
        raise InputError(f"--lang {language!r}: must be one of {', '.join(LANGUAGES)}")
    if precision not in PRECISIONS:
        raise InputError(f"--precision {precision!r}: must be one of {', '.join(PRECISIONS)}")
    if language == "m" and precision == "float":
        raise InputError("--precision float: is for C; MATLAB computes in double")
    if isinstance(case.loop.controller, OpenLoop):
        raise InputError(
            f"{case.name}: its law plays a signal back and feeds nothing back: there is nothing to"
            " export"
        )
    if case.loop.controller.inputs(case.clock) != ():
        raise InputError(
            f"{case.name}: its law plays a signal of its own back, which code without a run cannot"
            " have"
        )
    given, name = name, name or function_name(case)
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,50}", name):
        whose = (
            f"--name {given!r}"
            if given
            else f"{case.name!r} gives no name for the function; --name NAME"
        )
        raise InputError(
            f"{whose}: must be a name in the language: letters, digits and _, beginning with a"
            " letter, at most 51"
        )
    if language == "m" and name in TAKEN_M.split():
        raise InputError(
            f"--name {name!r}: MATLAB, or the file itself, has this name already; give another"
        )
    law = Code(case)
    return (print_c if language == "c" else print_matlab)(law, case, name, precision)


C_CALLS |= {name: name.upper() for name in (*SAME_NAME, "cbrt", "exp2")}
C_CALLS |= {"max": "MAX", "min": "MIN", "round": "RINT", "rem": "FMOD", "is_finite": "isfinite"}
