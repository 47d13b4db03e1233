"""A paper: its cases, its published numbers, and the measured ones."""

import dataclasses
import inspect
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxtank.case import Case, Free
from jaxtank.core.tree import number
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.observers import Direct


class Published(NamedTuple):
    """Something a paper prints: a number (or a tuple of them), or a claim in words.

    value : number, tuple of numbers, or text
    unit : its unit, "" for a claim
    where : section, table or figure of the paper
    tolerance : share of the printed number by which the measured one may differ and still count as
        reproduced; None for a number that is only quoted (a gain, a limit) and for a claim
    reason : why the measured number differs, or why it cannot be measured
    fitted : the assumption that was chosen so that this number is matched; it is then no
        evidence for the paper; "" for none
    closed_form : the formula by which the printed number follows from other printed ones, so that
        a measured one may equal it; "" for none, and a number that equals it is an input
    ramp : duration of the setpoint ramps of the runs it is measured in [s], where the paper prints
        none; None for a paper that does, and for what depends on no ramp

    Examples
    --------
    >>> Published(12.0, "V", "eq. (9)").tolerance is None
    True
    """

    value: Any
    unit: str
    where: str
    tolerance: float | None = None
    reason: str = ""
    fitted: str = ""
    closed_form: str = ""
    ramp: float | None = None


@dataclasses.dataclass(frozen=True)
class Claim:
    """Measured evidence for a claim in words.

    holds : whether the claim holds, or one boolean for each part of it: comparisons of what was
        measured, never constants
    text : the numbers from which the verdict follows
    by_ramp : {duration of the setpoint ramps [s]: whether it holds with that one}

    Examples
    --------
    >>> Claim(1e-4 < 1e-3, "largest error 1e-4 m").verdict
    'reproduced'
    >>> Claim((True, False), "0.1 cm in tank 1, 3 cm in tank 2").verdict
    'partly'
    """

    holds: Any
    text: str
    by_ramp: Mapping[float, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        verdict(self.holds)

    @property
    def verdict(self) -> str:
        """ "reproduced", "partly" or "not reproduced"."""
        return verdict(self.holds)


class Sample(NamedTuple):
    """Numbers measured in several runs with noise, one row a seed: (seeds, entries)."""

    values: Any

    @property
    def mean(self) -> tuple:
        return tuple(np.mean(self.values, axis=0).tolist())

    @property
    def deviation(self) -> tuple:
        """Standard deviation of a single run."""
        return tuple(np.std(self.values, axis=0, ddof=1).tolist())


def verdict(holds: Any) -> str:
    """Return the verdict of a claim whose parts were measured to hold, or not to."""
    parts = np.ravel(np.asarray(holds))
    if parts.dtype != bool or not parts.size:
        raise TypeError(f"a claim holds or not, and so does each of its parts: {holds!r}")
    return "reproduced" if parts.all() else "partly" if parts.any() else "not reproduced"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Preset:
    """A paper: its rig with several controllers, and its published numbers.

    Parameters
    ----------
    paper : name of the paper; its cases are called paper/case
    citation : authors, title, year
    cases : {name: Case}
    published : {parameter or quantity: Published}
    measured : function of `run` that returns {quantity: number, tuple, Sample or Claim} for what
        can be measured, where run(case name, values={}, save_every=1, seed=0) gives (Case with
        `values` set, Trajectory as host arrays)
    tunable : {parameter: Free}
    uncertain : {parameter: (spread as a share of it, why)}
    departures : sentences, each on what differs from the paper and why
    best : {name of a case: section} of controllers that the paper calls better than all others that
        it compares; several where sections contradict each other, {} where it compares none

    Examples
    --------
    >>> from jaxtank import presets
    >>> preset = presets.load("calofir")
    >>> sorted(preset.cases), preset.notes.name
    (['backstepping', 'backstepping-perturbed'], 'calofir.md')
    """

    paper: str
    citation: str
    cases: Mapping[str, Case]
    published: Mapping[str, Published]
    measured: Callable
    tunable: Mapping[str, Free]
    uncertain: Mapping[str, tuple]
    departures: tuple
    best: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def notes(self) -> Path:
        """Path of the derivation: equations as used, errata, assumptions, reference values.

        It is notes/<paper>.md beside the file that defines `measured`. Messages name its sections.
        """
        return Path(inspect.getfile(self.measured)).with_name("notes") / f"{self.paper}.md"


def closed_loop(plant: Any, controller: Any, reference: Any, x0: Any, **parts: Any) -> ClosedLoop:
    """Return the loop of a paper, with sensors without noise."""
    # sensor: (level per volt, full scale [V]); pumps: {field of PumpBank: one number, or one for
    # each pump}; other parts: fields of ClosedLoop.
    scale, full_scale = parts.pop("sensor")
    each = lambda count, value: np.array(np.broadcast_to(number(value), (count,)))
    pumps: dict[str, Any] = {
        name: value if isinstance(value, str) else each(plant.pumps, value)
        for name, value in parts.pop("pumps").items()
    }
    gain = each(plant.tanks, scale)
    return ClosedLoop(
        plant=plant,
        sensor=LevelSensor(gain=gain, noise=np.zeros(plant.tanks), full_scale=full_scale),
        controller=controller,
        actuator=PumpBank(**pumps),
        reference=reference,
        x0=number(x0),
        **{"observer": Direct(), **parts},
    )


def printed(paper: str) -> dict[str, Any]:
    """Return the fields of a Preset that are data, from <paper>.toml: its rows keep their order."""
    table = tomllib.loads(Path(__file__).with_name(f"{paper}.toml").read_text("utf-8"))
    rows = table["published"]
    for row in rows.values():
        if isinstance(row["value"], list):
            row["value"] = tuple(row["value"])
    return {
        "paper": paper,
        "citation": table["citation"],
        "published": {name: Published(**row) for name, row in rows.items()},
        "uncertain": {name: tuple(entry) for name, entry in table["uncertain"].items()},
        "departures": tuple(table["departures"]),
        "best": table.get("best", {}),
    }
