"""Names of tanks, pumps and valves, which a person reads and writes in place of their numbers.

A plant has them in `names`; without them a label is "tank 1", counted from 1.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from jaxtank.core.errors import unknown


class Labels(NamedTuple):
    """Names and counts of the tanks and inputs of a plant, kept with a run."""

    tanks: int
    pumps: int
    outputs: tuple[int, ...]
    names: tuple[tuple[str, tuple[str, ...]], ...] = ()
    feeds: tuple[Any, ...] = ()
    valves: tuple[Any, ...] = ()

    @classmethod
    def of(cls, plant: Any) -> "Labels":
        optional = {name: getattr(plant, name, ()) for name in ("names", "feeds", "valves")}
        return cls(plant.tanks, plant.pumps, tuple(plant.outputs), **optional)


def names_of(plant: Any, kind: str) -> tuple[str, ...]:
    """Return the names of all of a kind, "" for none: of "tank", "pump" (the inputs: pumps, then
    valves), "output" (the tanks whose levels are controlled), "valve".
    """
    named: Mapping[str, tuple[str, ...]] = dict(getattr(plant, "names", ()))
    if not named:
        return ()
    if kind == "pump":
        feeds = len(getattr(plant, "feeds", ()))
        pumps, valves = named.get("pump", ()), named.get("valve", ())
        names = (*pumps, *("",) * (feeds - len(pumps)), *valves)
        return (*names, *("",) * (plant.pumps - len(names)))
    tanks = named.get("tank", ())
    if kind == "output":
        outputs: tuple[int, ...] = plant.outputs
        sensors = named.get("sensor", ()) or ("",) * plant.tanks
        each = tuple(sensors[i] or (tanks[i] if tanks else "") for i in outputs)
        return each if any(each) else ()
    return named.get(kind, ())


def name_of(plant: Any, kind: str, index: int) -> str:
    """Return the name of entry `index` (from 0) of a kind, "" where it has none."""
    names = names_of(plant, kind)
    return names[index] if names else ""


def label_of(plant: Any, kind: str, index: int) -> str:
    """Return what a person reads for entry `index` (from 0) of a kind: its name, or "tank 1"."""
    return name_of(plant, kind, index) or _numbered(plant, kind, index)


def place_of(plant: Any, kind: str, index: int) -> str:
    """Return `label_of`, of an output without a name the label of its tank."""
    if kind == "output" and not name_of(plant, kind, index):
        return label_of(plant, "tank", plant.outputs[index])
    return label_of(plant, kind, index)


def entry_label(plant: Any, name: str, per: str, index: int) -> str:
    """Return the name of an entry of a measure: "max_level of LT101"; `name` of one of the run."""
    return name if per == "run" else f"{name} of {label_of(plant, per, index)}"


def _numbered(plant: Any, kind: str, index: int) -> str:
    valves = len(getattr(plant, "valves", ())) if kind == "pump" else 0
    pumps = plant.pumps - valves if valves else index + 1
    return f"{kind} {index + 1}" if index < pumps else f"valve {index - pumps + 1}"


def labels_of(plant: Any, kind: str, indices: Iterable[int]) -> str:
    """Return labels of entries: "LT101, LT103", "tank 3", "tanks 1, 3" or "tanks 1 to 4"."""
    indices = list(indices)
    valves = kind == "pump" and len(getattr(plant, "valves", ())) > 0
    if valves or any(name_of(plant, kind, i) for i in indices):
        return ", ".join(label_of(plant, kind, i) for i in indices)
    return numbered(kind, [i + 1 for i in indices])


def numbered(word: str, numbers: list[int]) -> str:
    """Return "tank 3", "tanks 1, 3" or "tanks 1 to 4"."""
    if len(numbers) == 1:
        return f"{word} {numbers[0]}"
    if len(numbers) > 2 and numbers[-1] - numbers[0] == len(numbers) - 1:
        return f"{word}s {numbers[0]} to {numbers[-1]}"
    return f"{word}s {', '.join(map(str, numbers))}"


def symbol(plant: Any, letter: str, kind: str, index: int) -> str:
    """Return the variable of an entry, as of a column: "h1", or "h_LT101" where it has a name."""
    name = name_of(plant, kind, index)
    names = names_of(plant, kind)
    before = names[:index].count(name) if name else 0  # of outputs of one tank
    more = f"_{before + 1}" if before else ""
    while more and f"{name}{more}" in names:
        more += "_"
    return f"{letter}_{name}{more}" if name else f"{letter}{index + 1}"


def reading_label(plant: Any, tank: int) -> str:
    """Return what a person reads for the reading of a tank: its sensor's name, its own, or "h1"."""
    return name_of(plant, "sensor", tank) or name_of(plant, "tank", tank) or f"h{tank + 1}"


OF_OPENINGS = {"V": "-", "V/cm": "1/cm", "V s/cm^3": "s/cm^3"}
"""Units of gains where the input is the opening of a valve, by those where it is a pump's."""


def input_unit(plant: Any, index: int, drive: str) -> str:
    """Return the unit of an input: a valve's is its opening, in % where the rig's inputs are."""
    is_valve = getattr(plant, "valves", ()) and index >= len(plant.feeds)
    return "-" if is_valve and drive != "%" else drive


def units_of_inputs(plant: Any) -> str:
    """Return the units of all inputs: "V", or of pumps and valves "m^3/h, -"."""
    units = (input_unit(plant, j, plant.units[1]) for j in range(plant.pumps))
    return ", ".join(dict.fromkeys(units))


def with_input_unit(value: float, plant: Any, index: int, drive: str) -> str:
    """Return a value of an input with its unit; an opening has none."""
    return f"{value:g} {input_unit(plant, index, drive)}".removesuffix(" -")


def signal_units(plant: Any, units: tuple[str, str]) -> list[str]:
    """Return the units of an export's signals: of levels and setpoints, and of each input."""
    return [units[0], *(input_unit(plant, j, units[1]) for j in range(plant.pumps))]


def short(plant: Any, kind: str, index: int) -> Any:
    """Return the name of an entry, or its number from 1: what a column headed "tank" shows."""
    return name_of(plant, kind, index) or index + 1


def index_of(where: str, plant: Any, kind: str, text: Any) -> int:
    """Return the index (from 0) of what a person calls by its name or its number from 1."""
    names, count = names_of(plant, kind), _count(plant, kind)
    aliases = names_of(plant, "sensor") if kind == "tank" else ()
    if kind == "output" and (tanks := names_of(plant, "tank")):  # also by the name of its tank
        outputs: tuple[int, ...] = plant.outputs
        aliases = tuple(tanks[i] for i in outputs)
    for each in (names, aliases):
        if text in each and text:
            return each.index(text)
    number = int(text) if str(text).isascii() and str(text).isdigit() else 0
    if not 1 <= number <= count:
        known = [name or str(i + 1) for i, name in enumerate(names or [""] * min(count, 100))]
        raise unknown(f"{kind} of {where}", str(text), known)
    return number - 1


def _count(plant: Any, kind: str) -> int:
    counts = {"tank": "tanks", "pump": "pumps", "output": "outputs", "valve": "valves"}
    value = getattr(plant, counts[kind])
    return value if isinstance(value, int) else len(value)
