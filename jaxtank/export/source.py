"""A controller and its observer as one source file, made from the step that is simulated."""

import re
from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from jaxtank.case import Case
from jaxtank.controllers import LQI, OpenLoop, StateFeedback
from jaxtank.core.clock import is_pointwise
from jaxtank.core.errors import InputError
from jaxtank.export.c import print_c
from jaxtank.export.fmi import print_fmu, print_fmu2
from jaxtank.export.javascript import RESERVED as JAVASCRIPT_NAMES, print_javascript
from jaxtank.export.matlab import RESERVED, print_matlab
from jaxtank.export.printer import function_name
from jaxtank.export.program import Program, program
from jaxtank.export.structured_text import RESERVED as ST_NAMES, print_structured_text
from jaxtank.plants.elements import check_plain

PRECISIONS = ("double", "float")


class Language(NamedTuple):
    """A language to export to."""

    # (program, name, precision) -> text of one file, or {file: text or bytes}
    write: Callable[[Program, str, str], Any]
    precisions: tuple = ("double",)  # "double", "float" or both
    reserved: Collection[str] = ()  # names that the function may not have
    adjustable: bool = False  # whether the numbers of the controller are parameters of the code
    plants: bool = False  # whether a plant can be exported too
    # {version: its function in place of `write`}
    versions: Mapping[str, Callable[[Program, str, str], Any]] = MappingProxyType({})


LANGUAGES = {  # {name, which is also the suffix of the file: Language}
    "c": Language(print_c, PRECISIONS, adjustable=True, plants=True),
    "m": Language(print_matlab, reserved=RESERVED),
    "js": Language(print_javascript, reserved=JAVASCRIPT_NAMES),
    "st": Language(print_structured_text, PRECISIONS, ST_NAMES, adjustable=True),
    "fmu": Language(
        print_fmu,
        reserved=["fmi"],
        adjustable=True,
        plants=True,
        versions={"3": print_fmu, "2": print_fmu2},
    ),
}


def register(name: str, language: Language) -> Language:
    """Add a language to `export` and to `jaxtank export --lang`.

    Parameters
    ----------
    name : letters and digits; it is also the suffix of the file
    language : Language

    Returns
    -------
    The language.

    Raises
    ------
    InputError
        For a name that is taken by another language, or is not letters and digits.

    Examples
    --------
    >>> from jaxtank import presets
    >>> _ = register("txt", Language(lambda program, name, precision: f"{name}: {program.state}"))
    >>> export(presets.find("cascaded/pi"), "txt", name="tanks")
    'tanks: 2'
    """
    if not (isinstance(name, str) and re.fullmatch("[A-Za-z0-9]+", name)):
        raise InputError(f"language {name!r}: must be a text of letters and digits, as 'c'")
    if LANGUAGES.get(name, language) != language:
        raise InputError(f"language {name!r} is taken: choose another name")
    LANGUAGES[name] = language
    return language


def export(
    case: Case, language: str = "c", precision: str = "double", name: str | None = None
) -> str:
    """Return the controller and observer of a case as source code.

    Parameters
    ----------
    case : Case
    language : "c" (C99), "st" (Structured Text), "m" (MATLAB), "js" (JavaScript), or one that was
        added by `register`
    precision : "double" or, in C and Structured Text, "float"
    name : of the functions; None: made from the case's

    Returns
    -------
    The text; of a language with several files (C: a header) one after the other.

    Raises
    ------
    InputError
        For an option that is not offered, a controller that plays a signal back, and one that uses
        an operation without a counterpart in the language.

    Examples
    --------
    >>> from jaxtank import presets
    >>> text = export(presets.find("cascaded/pi"), "m", name="tanks")
    >>> text.split("(")[0]
    'function [u, s] = tanks'
    """
    texts = files(case, language, precision, name)
    if not all(isinstance(text, str) for text in texts.values()):
        raise InputError(f"--lang {language} is no text: call jaxtank.export.source.files")
    return "\n".join(texts.values())


def files(
    case: Case,
    language: str = "c",
    precision: str = "double",
    name: str | None = None,
    plant: bool = False,
    version: str | None = None,
) -> dict[str, Any]:
    """Return {file: text or bytes} of the controller of a case, or of its plant."""
    if language not in LANGUAGES:
        raise InputError(f"--lang {language!r}: must be one of {', '.join(LANGUAGES)}")
    if precision not in PRECISIONS:
        raise InputError(f"--precision {precision!r}: must be one of {', '.join(PRECISIONS)}")
    target = LANGUAGES[language]
    if precision not in target.precisions:
        raise InputError(
            f"--precision {precision}: --lang {language} has {' and '.join(target.precisions)} only"
        )
    if plant and not target.plants:
        with_plants = " or ".join(n for n, other in LANGUAGES.items() if other.plants)
        raise InputError(f"--plant: --lang {language} has controllers only; give {with_plants}")
    if version is not None and version not in target.versions:
        allowed = " or ".join(target.versions) or "left out"
        raise InputError(f"--fmi {version}: of --lang {language} it must be {allowed}")
    (_check_plant if plant else _check_controller)(case)
    name = _checked_name(case, name, target.reserved)
    write = target.versions.get(version or "", target.write)
    written = write(program(case, plant, target.adjustable), name, precision)
    return written if isinstance(written, dict) else {f"{name}.{language}": written}


def _check_controller(case):
    """Raise InputError for a controller whose inputs do not follow from levels and setpoints."""
    controller = case.loop.controller
    if isinstance(controller, OpenLoop) or controller.inputs(case.clock) != ():
        raise InputError(
            f"{case.name}: its controller plays a signal back, and exported code holds no signals:"
            ' give a controller that reads levels ([controller] kind = "pi"), or export the plant'
            " alone (--plant --lang fmu)"
        )
    if controller.reads_inflow or controller.reads_flow:
        raise InputError(
            f"{case.name}: its controller reads measured flows, and exported code reads levels and"
            " setpoints alone: leave out controller.inflow_gain and follow_inflow, and of a"
            ' flow-cascade write kind = "pi"'
        )
    if controller.reads_ahead:
        raise InputError(
            f"{case.name}: its controller reads setpoints ahead, and exported code reads those of"
            " the present sample: set controller.preview = 0"
        )
    check_prepared(controller)


def _check_plant(case):
    """Raise InputError for a plant whose inflows are recorded."""
    inflows = case.loop.disturbance
    if inflows is not None and (inflows.is_table or not is_pointwise(inflows)):
        raise InputError(
            f"{case.name}: its inflows are a table or a signal of Python, which code of single"
            " samples does not hold: leave them out and give them to the input d of the plant"
        )


def check_prepared(controller: Any) -> None:
    """Raise InputError for a controller whose steady states need iterations."""
    controller = getattr(controller, "law", controller)
    if isinstance(controller, StateFeedback | LQI):
        remedy = "its steady states need iterations, which exported code has not; export kind pid"
        check_plain(controller.model, f"{type(controller).__name__} as code", f"{remedy} or gpc")


def _checked_name(case, option, reserved):
    """The name of the functions. Raises InputError for one that the language does not allow."""
    name = option or function_name(case)
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,50}", name):
        unnamed = f"{case.name!r} gives no name for the function; --name NAME"
        source = f"--name {option!r}" if option else unnamed
        raise InputError(
            f"{source}: must be letters, digits and _, begin with a letter and have at most 51"
            " characters"
        )
    if name in reserved:
        raise InputError(
            f"--name {name!r}: the language, or the file itself, has this name already; choose"
            " another"
        )
    return name
