"""Values of a command line: numbers, ranges, NAME=VALUE, and the case that they describe."""

import re
import sys
from typing import Any

from jaxtank.core.errors import InputError
from jaxtank.core.text import printable
from tuning.problem.wording import count


def open_case(args):
    """Return the checked case of the command line, in float64; warnings go to stderr."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxtank import rig
    from jaxtank.loop import tank_bottom

    opened = rig.open_case(args.case)
    known = [] if args.quiet else rig.case_warnings(opened)
    for sentence in known if args.case.endswith(".toml") else ():
        print(f"jaxtank: {printable(args.case)}: note: {sentence}", file=sys.stderr)
    values, of_filter = _apart(settings(args))
    case = rig.set_and_schedule(opened, values, schedule(args.schedule))
    case, replaced = rig.overridden(case, values)
    if "plant.bottom" not in values and not tank_bottom.can_withdraw(opened.loop):
        case = rig.with_bottom(case)
    case = rig.check(case)
    case = rig.filtered(case, args.safety_filter, of_filter)
    if not args.quiet:
        for sentence in _warnings(args, case, replaced):
            if sentence not in known:
                print(f"jaxtank: note: {sentence}", file=sys.stderr)
    return case


def _warnings(args, case, replaced):
    """Sentences on a case as --set has changed it."""
    from jaxtank import rig
    from jaxtank.loop import step_size

    found = []
    if args.command == "tune" and not args.scenario:
        for name, scenarios in replaced.items():
            found.append(f"--set {name} also replaces the value of {name} in {_named(scenarios)}")
    found += rig.case_warnings(case)
    return found + _not_proved(case) + step_size.step_warnings(case.loop, case.clock)


def _apart(values):
    """({name: value} of the rig, {key: value} of its safety filter), from those of --set."""
    prefix = "safety_filter."
    own = {n.removeprefix(prefix): v for n, v in values.items() if n.startswith(prefix)}
    return {n: v for n, v in values.items() if not n.startswith(prefix)}, own


def _not_proved(case):
    """Sentences on tanks whose limits the safety filter of the case is not proved to keep."""
    if case.loop.safety_filter is None:
        return []
    from jaxtank.safety.of_case import certificates_of

    rows = certificates_of(case)
    found = [
        f"safety filter: the limit of tank {row.tank + 1} is not proved: {row.reason}"
        for row in rows
        if not row.certified
    ]
    return found + [
        f"safety filter: the low limit of tank {row.tank + 1} is not proved: {row.low_reason}"
        for row in rows
        if row.low > 0.0 and not row.low_certified
    ]


def settings(args):
    """Return {name: value} of --set and --dt."""
    values = once("--set", [pair("--set", text) for text in args.values]) or {}
    if args.dt is not None:
        if "clock.dt" in values:
            raise InputError(
                f"--dt {args.dt:g} beside --set clock.dt={values['clock.dt']}: give one of them"
            )
        values["clock.dt"] = args.dt
    return values


def _named(scenarios):
    """How many scenarios, and the names of the first ones."""
    names = [repr(printable(name)) for name in scenarios[:3]] + ["..."] * (len(scenarios) > 3)
    return f"{count(len(scenarios), 'scenario')} ({', '.join(names)})"


def schedule(texts):
    """Return the table [schedule] of a rig file for the options --schedule."""
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
    """Return (name, value) of NAME=VALUE."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise InputError(f"{option} {text!r}: must be NAME=VALUE")
    name, value = name.strip(), value.strip()
    return name, parse_value(value, f"{option} {name}") if read is None else read(value)


def once(option, pairs):
    """Return {name: value} of (name, value) pairs, None where there is none."""
    names = [name for name, _ in pairs]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{option} {name} is given {names.count(name)} times: give it once")
    return dict(pairs) or None


DECIMAL_COMMA = re.compile(r"([+-]?)(\d+|[1-9]\d{0,2}(?:\.\d{3})+),(\d+(?:[eE][+-]?\d+)?)")
"""Text that is either a list of two numbers or one number with a decimal comma: 0,05 or 1.000,5."""


def parse_value(text, where):
    """Return a number, a truth value, a list of numbers ("[1,2]", "1,2,3"), or the text itself."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    bracketed = text.startswith("[") and text.endswith("]")
    inner = text[1:-1] if bracketed else text
    parts = [p.strip() for p in inner.split(",")] if inner.strip() else []
    try:
        found = [plain_number(p) for p in parts if p]
    except ValueError:
        return text
    _check_list(text, parts, found, f"{where}={text}")
    if bracketed:
        return found
    return found if len(found) > 1 else found[0] if found else text


def _check_list(text, parts, found, where):
    """Raise InputError where a list of numbers may be meant otherwise."""
    if len(found) < len(parts):
        raise InputError(
            f"{where}: an entry of the list is empty: leave out the comma, or give its number"
        )
    if comma := DECIMAL_COMMA.fullmatch(text):
        sign, whole_part, digits = comma.groups()
        point = f"{sign}{whole_part.replace('.', '')}.{digits}"
        raise InputError(
            f"{where}: the comma may be a decimal one: write {point}, with a point, for a number,"
            f" or [{', '.join(map(str, found))}] for a list"
        )
    odd = next((p for p in parts if re.match(r"[+-]?0\d", p)), None)
    if len(parts) > 1 and odd:
        raise InputError(
            f"{where}: entry {odd} begins with a zero, as the digits after a decimal comma do:"
            " write decimals with a point, as 0.05"
        )


def plain_number(text):
    """Return an int where `text` is written as one and a float can hold it, else a float."""
    # Raises ValueError for a text that is no number; underscores are not numbers.
    if "_" in text:
        raise ValueError(text)
    try:
        value = int(text)
        float(value)
        return value
    except (ValueError, OverflowError):
        return float(text)


def number(option, text):
    """Return the number of an option; InputError where its text is none."""
    try:
        return float(plain_number(text))
    except ValueError:
        raise InputError(f"{option} {text!r}: must be a number") from None


def whole_number(option, text, low, high):
    """Return the whole number of an option, from `low` to `high`; InputError otherwise."""
    try:
        value = int(text)
    except ValueError:
        value = None
    if value is None or not low <= value <= high:
        raise InputError(f"{option} {text!r}: must be a whole number from {low} to {high}")
    return value


def folder_of(args) -> Any:
    """Return the folder that a command writes to, None where it writes to none."""
    # Raises InputError where it cannot be written to; nothing is made yet.
    out, resume = getattr(args, "out", None), getattr(args, "resume", None)
    for name, folder in (("--out", out), ("--resume", resume)):
        if folder is not None and not folder.strip():
            raise InputError(f"{name} '': must name a folder")
    if resume and out and resume != out:
        raise InputError("--resume and --out name different folders: a run is continued in its own")
    folder = resume or out
    if folder is not None:
        from jaxtank.core.files import check_folder

        check_folder(folder)
    return folder


def span(text):
    """Return (low, high, "log" or "linear") of a range LOW:HIGH, LOW:HIGH:log or
    LOW:HIGH:linear.
    """
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
