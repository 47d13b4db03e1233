"""Types of options: functions that read the text of a value, or raise ValueError."""

import os
import re

from jaxtank.core.errors import InputError

DECIMAL_COMMA = re.compile(r"([+-]?)(\d+|[1-9]\d{0,2}(?:\.\d{3})+),(\d+(?:[eE][+-]?\d+)?)")
"""Text that is either a list of two numbers or one number with a decimal comma: 0,05 or 1.000,5."""
LEADING_ZERO = re.compile(r"[+-]?0\d")  # digits after a decimal comma, and no number


def plain_number(text):
    """Return an int where `text` is written as one and a float can hold it, else a float."""
    for read in (int, float) if "_" not in text else ():
        try:
            value = read(text)
            float(value)
            return value
        except (ValueError, OverflowError):
            continue
    raise ValueError("must be a number")


def seconds(name):
    """Return a reader of a time [s], also with another unit of time: "5 min"."""

    def read(text):
        try:
            return number(text)
        except ValueError:
            from jaxtank.core.quantities import quantity

            return quantity(name, text, "s")

    return read


def number(text):
    return float(plain_number(text))


def above(low, high=float("inf"), including=False, read=None):
    """Return a reader of a number above `low`, or from `low` on, and up to `high`."""

    def read_above(text):
        value = (read or number)(text)
        if not (low <= value if including else low < value) or not value <= high:
            upper = f" and at most {high:g}" if high < float("inf") else ""
            raise ValueError(f"must be {'at least' if including else 'above'} {low:g}{upper}")
        return value

    return read_above


def share(text):
    """Return a number between 0 and 1."""
    value = number(text)
    if not 0 < value < 1:
        raise ValueError("must be a share between 0 and 1")
    return value


def whole(low, high):
    """Return a reader of a whole number from `low` to `high`."""

    def read(text):
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise ValueError(f"must be a whole number from {low} to {high}")
        return value

    return read


def value(text):
    """Return a number, a truth value, a list of numbers ("[1,2]", "1,2,3"), or the text itself."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    bracketed = text.startswith("[") and text.endswith("]")
    inner = text[1:-1] if bracketed else text
    parts = entries()(inner) if inner.strip() else []
    try:
        numbers = [plain_number(part) for part in parts if part]
    except ValueError:
        # a list with units is converted where the unit of the value is known
        return [_number_or_text(part) for part in parts] if bracketed else text
    if len(numbers) < len(parts):
        raise ValueError("an entry of the list is empty: leave out the comma, or give its number")
    _check_decimal_comma(text, parts, numbers)
    if bracketed or len(numbers) > 1:
        return numbers
    return numbers[0] if numbers else text


def value_or_matrix(text):
    """Return a matrix of its rows, "[[1,2],[3,4]]", or another `value`."""
    if rows := re.fullmatch(r"\[\s*\[(.*)\]\s*\]", text):
        return [value(f"[{row}]") for row in re.split(r"\]\s*,\s*\[", rows[1])]
    return value(text)


def _check_decimal_comma(text, parts, numbers):
    if comma := DECIMAL_COMMA.fullmatch(text):
        sign, whole_part, digits = comma.groups()
        point = f"{sign}{whole_part.replace('.', '')}.{digits}"
        raise ValueError(
            f"the comma may be a decimal one: write {point}, with a point, for a number, or"
            f" [{', '.join(map(str, numbers))}] for a list"
        )
    zero = next(filter(LEADING_ZERO.match, parts), None)
    if len(parts) > 1 and zero:
        raise ValueError(
            f"entry {zero} begins with a zero, as the digits after a decimal comma do: write"
            " decimals with a point, as 0.05"
        )


def _number_or_text(part):
    try:
        return plain_number(part)
    except ValueError:
        return part


def pair(read=value, form="NAME=VALUE"):
    """Return a reader of (name, value) of NAME=VALUE."""

    def read_pair(text):
        name, equals, rest = text.partition("=")
        if not equals or not name.strip():
            raise ValueError(f"must be {form}")
        return name.strip(), read(rest.strip())

    return read_pair


def span(text):
    """Return (low, high, "log" or "linear") of LOW:HIGH, LOW:HIGH:log or LOW:HIGH:linear."""
    low, high, scale, *more = [*text.split(":"), "", ""] if ":" in text else ["", "", ""]
    try:
        low, high = number(low), number(high)
    except ValueError:
        raise ValueError("must be NAME=LOW:HIGH with two numbers") from None
    if scale not in ("", "log", "linear") or any(more):
        raise ValueError("must be LOW:HIGH, LOW:HIGH:log or LOW:HIGH:linear")
    return low, high, scale or ("log" if low * high > 0 else "linear")


free_range = pair(span, "NAME=LOW:HIGH")  # reads (name, range) of --free


def limit(text):
    """Return (measure, limit) of MEASURE=VALUE; ("none", None) of "none"."""
    if text == "none":
        return "none", None
    name, bound = pair(form="MEASURE=VALUE or MEASURE.NAME=VALUE")(text)
    measure, entry = measure_and_part(name)
    return f"{measure}.{entry}" if entry else measure, None if bound == "none" else bound


def measure_and_part(name):
    """Return (measure, name or number of a tank, pump or output, "" for all) of MEASURE[.NAME]."""
    measure, dot, entry = name.partition(".")
    if not dot and (brackets := re.fullmatch(r"(\w+)\[(.*\D.*)\]", name)):  # max_level[LT101]
        measure, entry = brackets.groups()
    return checked_measure(measure), entry


def weight(text):
    """Return (measure, weight) of MEASURE=WEIGHT."""
    measure, share = pair(number, "MEASURE=WEIGHT")(text)
    return checked_measure(measure), share


def checked_measure(name):
    from jaxtank.measures import check_names

    check_names([name])
    return name


def scenario(text):
    """Return (text, {name: value}) of NAME=VALUE[;NAME=VALUE]; None of "none"."""
    if text == "none":
        return None
    values = {}
    for part in filter(str.strip, text.split(";")):
        name, entry = pair(value_or_matrix)(part)
        if name in values:
            raise InputError(f"--scenario {name} is given twice: give it once")
        values[name] = entry
    return text, values


def candidates(text):
    """Return the values of V1,V2,.."""
    parts = entries()(text)
    if "" in parts or any(map(LEADING_ZERO.match, parts)):
        raise ValueError("must be values with commas between them, decimals with a point: 0.5,1.5")
    return [value(part) for part in parts]


def tradeoff(text):
    """Return (measure, values) of MEASURE=LOW:HIGH or MEASURE=LOW:HIGH:N."""
    measure, (low, high, *count) = pair(lambda rest: rest.split(":") + [""])(text)
    try:
        low, high = number(low), number(high)
        count = int(count[0] or 6) if len(count) < 3 else 0
    except ValueError:
        count = 0
    if not (2 <= count <= 50 and low < high):
        raise ValueError(
            "must be MEASURE=LOW:HIGH or MEASURE=LOW:HIGH:N, LOW below HIGH, N from 2 to 50"
        )
    return checked_measure(measure), [low + (high - low) * i / (count - 1) for i in range(count)]


def knots(text):
    """Return (variable, knots) of VARIABLE:K1,K2,.."""
    variable, colon, rest = text.partition(":")
    if not colon:
        raise ValueError("must be NAME=VARIABLE:K1,K2,...")
    return variable.strip(), value(f"[{rest}]")


def column(text):
    """Return HEADER, or (HEADER, UNIT) of HEADER;UNIT."""
    header, semicolon, unit = text.rpartition(";")
    return (header.strip(), unit.strip()) if semicolon else text


def deviations(text):
    """Return a standard deviation, or a list of them."""
    noise = value(text)
    each = noise if isinstance(noise, list) else [noise]
    if not each or any(isinstance(v, str | bool) or not v > 0 for v in each):
        raise ValueError("must be a number above 0, or [SD1,SD2,...], one per channel")
    return noise


def held_back(text):
    """Return a share from 0 to below 1, or a number of samples."""
    last = number(text)
    if not last >= 0 or (last >= 1 and last != int(last)):
        raise ValueError("must be a share from 0 to below 1, or a whole number of samples")
    return last if last < 1 else int(last)


def entries(read=str.strip):
    """Return a reader of a list of V1,V2,.."""
    return lambda text: [read(entry) for entry in text.split(",")]


def folder(text):
    """Return the name of a folder that can be written to; nothing is made yet."""
    from jaxtank.core.files import check_folder

    if not text.strip():
        raise ValueError("must name a folder")
    check_folder(text)
    return text


def earlier_folder(text):
    if not os.path.isdir(folder(text)):
        raise ValueError("cannot be read as a run to go on with: there is no such folder")
    return text
