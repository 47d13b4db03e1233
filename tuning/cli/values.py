"""What the words of a command line mean: numbers, ranges, NAME=VALUE, the case they describe."""

import os
import re
import sys
from typing import Any

from jaxtank.core.errors import InputError
from jaxtank.core.text import printable


def open_case(args):
    """The checked case of the command line, in float64; what of a rig file can hardly be meant is
    told on stderr.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxtank import rig
    from jaxtank.loop import step_size

    case, notes = rig.open_case(args.case), []
    # as the file is: what --set changes is meant
    if args.case.endswith(".toml") and not args.quiet:
        notes = rig.doubts(case)
        for sentence in notes:
            print(f"jaxtank: {printable(args.case)}: note: {sentence}", file=sys.stderr)
    values = settings(args)
    clock, case = case.clock, rig.check(rig.set_and_schedule(case, values, schedule(args.schedule)))
    case, replaced = rig.overridden(case, values)
    if args.command == "tune" and not args.scenario and not args.quiet:
        for name, scenarios in replaced.items():
            words = f"--set {name} takes the place of the value of {_counted(scenarios)}"
            print(f"jaxtank: note: {words}", file=sys.stderr)
    for sentence in () if args.quiet else rig.model_doubts(case):
        if sentence not in notes:
            print(f"jaxtank: note: {sentence}", file=sys.stderr)
    if case.clock != clock and not args.quiet:
        for sentence in rig.clock_doubts(case.clock):
            print(f"jaxtank: note: {sentence}", file=sys.stderr)
    for sentence in () if args.quiet else step_size.step_warnings(case.loop, case.clock):
        print(f"jaxtank: note: {sentence}", file=sys.stderr)
    return case


def settings(args):
    """{name: value} of --set and --dt."""
    values = once("--set", [pair("--set", text) for text in args.values]) or {}
    if args.dt is not None:
        if "clock.dt" in values:
            raise InputError(
                f"--dt {args.dt} beside --set clock.dt={values['clock.dt']}: give one of them"
            )
        values["clock.dt"] = number("--dt", args.dt)
    return values


def _counted(scenarios):
    named = [repr(printable(name)) for name in scenarios[:3]] + ["..."] * (len(scenarios) > 3)
    return f"{len(scenarios)} scenario{'s' if len(scenarios) > 1 else ''} ({', '.join(named)})"


def schedule(texts):
    """The table of a rig file's [schedule] for the options --schedule."""
    found = [pair("--schedule", text, lambda v: v) for text in texts]
    once("--schedule", found)
    if len({rule for _, rule in found}) > 1:
        raise InputError(
            f"--schedule {texts[-1]!r}: variable and knots must be the same for all gains"
        )
    for name, rule in found:
        variable, colon, knots = rule.partition(":")
        if not colon:
            raise InputError(f"--schedule {name}={rule!r}: must be NAME=VARIABLE:K1,K2,...")
        return {
            "gains": [n for n, _ in found],
            "variable": variable.strip(),
            "knots": parse_value(f"[{knots}]", f"--schedule {name}"),
        }
    return {}


def pair(option, text, read=None) -> tuple[str, Any]:
    """(name, value) of NAME=VALUE; read: makes the value of its text, `parse_value` where it is
    None.
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise InputError(f"{option} {text!r}: must be NAME=VALUE")
    name, value = name.strip(), value.strip()
    return name, parse_value(value, f"{option} {name}") if read is None else read(value)


def once(option, pairs):
    """{name: value} of (name, value) pairs, None where there is none; InputError for a name that is
    given twice.
    """
    names = [name for name, _ in pairs]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{option} {name} is given {names.count(name)} times: give it once")
    return dict(pairs) or None


DECIMAL_COMMA = re.compile(r"([+-]?)(\d+|[1-9]\d{0,2}(?:\.\d{3})+),(\d+(?:[eE][+-]?\d+)?)")
"""Text that is either a list of two numbers or one number with a decimal comma: 0,05 or 1.000,5."""


def parse_value(text, where):
    """Return a number, a truth value, a list of numbers ("[1,2]", "1,2,3"), or the text itself.

    A list needs brackets where a decimal comma could be meant. where: option and name, for the
    error. Raises InputError for such a text, for an empty entry and for an entry such as 05.
    """
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    inner = text[1:-1] if text.startswith("[") and text.endswith("]") else text
    parts = [p.strip() for p in inner.split(",")] if inner.strip() else []
    try:
        found = [plain_number(p) for p in parts if p]
    except ValueError:
        return text
    if len(found) < len(parts):
        raise InputError(
            f"{where}={text}: an entry of the list is empty: leave out the comma, or give its"
            " number"
        )
    if comma := DECIMAL_COMMA.fullmatch(text):
        sign, whole, digits = comma.groups()
        point = f"{sign}{whole.replace('.', '')}.{digits}"
        raise InputError(
            f"{where}={text}: the comma may be a decimal one: write {point}, with a point, for a"
            f" number, or [{', '.join(map(str, found))}] for a list"
        )
    if len(parts) > 1 and (odd := next((p for p in parts if re.match(r"[+-]?0\d", p)), None)):
        raise InputError(
            f"{where}={text}: entry {odd} begins with a zero, as the digits after a decimal comma"
            " do: write decimals with a point, as 0.05"
        )
    return (
        found[0]
        if len(found) == 1 and inner is text
        else found
        if found or inner is not text
        else text
    )


def plain_number(text):
    """An int where it is written as one and a float can hold it, else a float; underscores are not
    numbers.
    """
    if "_" in text:
        raise ValueError(text)
    try:
        value = int(text)
        float(value)
        return value
    except (ValueError, OverflowError):
        return float(text)


def number(option, text):
    try:
        return float(plain_number(text))
    except ValueError:
        raise InputError(f"{option} {text!r}: must be a number") from None


def whole(option, text, low, high):
    try:
        value = int(text)
    except ValueError:
        value = None
    if value is None or not low <= value <= high:
        raise InputError(f"{option} {text!r}: must be a whole number from {low} to {high}")
    return value


def seed(args):
    return whole("--seed", args.seed, 0, 2**31 - 1)


def folder_of(args) -> Any:
    """The folder that a command writes to, None where it writes to none. Raises InputError where it
    cannot; nothing is made yet.
    """
    out, resume = getattr(args, "out", None), getattr(args, "resume", None)
    for option, folder in (("--out", out), ("--resume", resume)):
        if folder is not None and not folder.strip():
            raise InputError(f"{option} '': must name a folder")
    if resume and out and resume != out:
        raise InputError("--resume and --out name different folders: a run is continued in its own")
    if args.command == "merge" and not out:
        return args.case if os.path.isdir(args.case) else None
    folder = resume or out
    if folder is not None:
        from jaxtank.core.files import check_folder

        check_folder(folder)
    return folder


def span(text):
    parts = text.split(":")
    try:
        low, high = (float(plain_number(p)) for p in parts[:2])
    except ValueError:
        raise InputError(f"--free range {text!r}: must be NAME=LOW:HIGH with two numbers") from None
    if len(parts) > 3 or (len(parts) == 3 and parts[2] not in ("log", "linear")):
        raise InputError(
            f"--free range {text!r}: must be LOW:HIGH, LOW:HIGH:log or LOW:HIGH:linear"
        )
    return (low, high, parts[2] if len(parts) == 3 else "log" if low > 0 else "linear")
