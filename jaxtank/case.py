"""A case: one rig, one controller, one reference, one clock, and the free parameters."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxtank.core.checks import check_whole
from jaxtank.core.clock import CLOCK_UNITS, Clock
from jaxtank.core.errors import InputError
from jaxtank.core.jsonable import clean
from jaxtank.core.text import count, shortened
from jaxtank.core.tree import describe, get_value, is_real, parameters, walk
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.measures import MEASURES, unit
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.safety import SafetyFilter, TankCertificate, design_for
from jaxtank.safety.of_case import SPREAD, UNKNOWN
from jaxtank.safety.outlets import OutletFilter
from jaxtank.views import CaseViews


def check_case(case: Any, seed: Any = 0) -> None:
    """Raise InputError for what is no Case, and for a seed that is no whole number from 0."""
    if not isinstance(case, Case):
        raise InputError(
            f"case is a {type(case).__name__}: must be a Case; jaxtank.presets.find(NAME) returns"
            " one of this package, jaxtank.rig.load(FILE) that of a rig file"
        )
    check_whole("seed", seed, 0, 2**31 - 1)
    for name, share in case.uncertain.items():
        if not (is_real(share) and np.ndim(share) == 0 and 0 < share < 1):
            raise InputError(
                f"uncertain {name} = {shortened(share)}: must be a share between 0 and 1, 0.05 for"
                " +-5 %; other distributions are given to `ensemble`, `sensitivity` and `attack`"
            )


class Free(NamedTuple):
    """Where a tunable parameter may lie, in its own unit; "log" for gains and times of one
    sign, "linear" for what may pass through 0.

    Examples
    --------
    >>> from jaxtank.case import Free
    >>> Free(0.001, 5.0)
    Free(low=0.001, high=5.0, scale='log')
    """

    low: float
    high: float
    scale: str = "log"


class Scenario(NamedTuple):
    """One of several runs that a tuning is judged by: the case with `values` set by dotted name
    (sensor noise, a weaker pump, other setpoints, another duration), its sensor noise drawn with
    `seed`, counted with `weight` in the mean over scenarios [-].

    A value is a number in the parameter's unit, or a text relative to the case as it stands:
    "x1.3", "by -0.5", "0.02 if zero", "steady" (`rig.set_scenario`).

    Examples
    --------
    >>> from jaxtank.case import Scenario
    >>> Scenario("weak pump", {"plant.pump_gain": "x0.7"}).weight
    1.0
    """

    name: str
    values: Mapping[str, Any] = {}
    seed: int = 0
    weight: float = 1.0


class Symmetry(NamedTuple):
    """A permutation symmetry of the gains: image({name: value}) are the values, of some or all
    names, that give the same loop or nearly so.

    Examples
    --------
    >>> from jaxtank.case import Symmetry
    >>> both = Symmetry("a and b", lambda v: {"a": v["b"], "b": v["a"]})
    >>> both.image({"a": 1, "b": 2})
    {'a': 2, 'b': 1}
    """

    words: str
    image: Callable[[Mapping[str, Any]], Mapping[str, Any]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case(CaseViews):
    """One rig, one controller, one reference, one clock, with the gains its paper prints.

    Parameters
    ----------
    name, title : str
    loop : ClosedLoop
    clock : Clock
    limits : {measure: limit}
        A number, one per entry, or "rim" for the rim of each tank.
    free : {dotted name: Free}
        What `tune` tunes unless others are named.
    objective : {measure: weight}
        What `tune` minimises.
    reachable : bool
        Whether every plateau of the reference must have a steady state within the pumps' direction
        (False where the paper asks for one that has none).
    scenarios : sequence of Scenario
        What `tune` judges by instead of the case's own run; () for that alone.
    symmetry : Symmetry, optional
        Gains that exchange roles.
    uncertain : {dotted name of the plant: spread as a share of it}
        What a result is validated on.
    covariance : (names (n,), matrix (n, n) in their units), optional
        Of parameters that were identified together.
    rejected : bool
        Whether the data reject the structure of the rig with which `covariance` was estimated.
    log : {"t", "pump1", "h1", ..: column of a data file, its unit in its header}
        Where a data file of this rig names them otherwise.
    safety : settings of `with_safety_filter`, optional
    origin : "paper/case" of the preset that it was made from, "" for none
    begins : date and time of t = 0, "" where none is known

    Examples
    --------
    >>> from jaxtank import presets
    >>> case = presets.load("cascaded/pi")
    >>> print(str(case).splitlines()[1])
      2 tanks, 1 pump; controller PID, observer Direct
    >>> case.replace(name="mine").name
    'mine'
    """

    name: str
    title: str
    loop: ClosedLoop
    clock: Clock
    limits: Mapping[str, Any]
    free: Mapping[str, Free]
    objective: Mapping[str, float]
    reachable: bool = True
    scenarios: tuple[Scenario, ...] = ()
    symmetry: Symmetry | None = None
    uncertain: Mapping[str, float] = dataclasses.field(default_factory=dict)
    covariance: tuple | None = None
    rejected: bool = False
    log: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    safety: Mapping[str, Any] | None = None
    origin: str = ""
    begins: str = ""

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """{"tank", "pump" or "valve": a name of each, "" for none}, where the rig gives them."""
        return dict(self.loop.plant.names)

    def replace(self, **changes: Any) -> "Case":
        """Return a copy with the named fields changed."""
        return dataclasses.replace(self, **changes)

    def safety_design(
        self, **settings: Any
    ) -> tuple[SafetyFilter | OutletFilter, tuple[TankCertificate, ...]]:
        """Return a safety filter for the case, and the certificate of each tank.

        Settings and their defaults, and errors, as in `jaxtank.safety.design_for`.

        Examples
        --------
        >>> from jaxtank import presets
        >>> _, rows = presets.find("cascaded/pi").safety_design()
        >>> [(row.certified, row.reason) for row in rows]
        [(True, 'Theorem 1'), (True, 'Theorem 2')]
        """
        return design_for(self, **settings)

    def with_safety_filter(self, **settings: Any) -> "Case":
        """Return the case with a safety filter on its pumps; settings as in `safety_design`.

        Examples
        --------
        >>> from jaxtank import presets
        >>> presets.find("cascaded/pi").with_safety_filter().loop.safety_filter.held
        (0, 1)
        """
        safety_filter, _ = self.safety_design(**settings)
        loop = dataclasses.replace(self.loop, safety_filter=safety_filter)
        return self.replace(loop=loop, safety=settings)

    def without_safety_filter(self) -> "Case":
        """Return the case without a safety filter."""
        return self.replace(loop=dataclasses.replace(self.loop, safety_filter=None), safety=None)

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object: name, clock, every parameter with its unit, limits, objective, what
        is free, scenarios; null for what is not finite. `jaxtank show --json` adds the paper's.
        """
        parameters = {
            name: {"value": clean(value), "unit": meta["unit"]}
            for kind in ("leaf", "static")
            for name, value, meta in walk(self.loop, kind=kind)
        }
        clock = {
            f"clock.{name}": {"value": getattr(self.clock, name), "unit": unit}
            for name, unit in CLOCK_UNITS.items()
        }
        return {
            "case": self.name,
            "title": self.title,
            "parameters": parameters | clock,
            "free": {name: list(Free(*spec)) for name, spec in self.free.items()},
            "limits": clean(dict(self.limits)),
            "objective": clean(dict(self.objective)),
            "scenarios": clean(
                [s._replace(values=dict(s.values))._asdict() for s in self.scenarios]
            ),
            "uncertain": clean(dict(self.uncertain)),
        }

    def __str__(self) -> str:
        heading, *lines = (f"{what}: {text}" if what else text for what, text in self.summary())
        return "\n".join([heading, *(f"  {line}" for line in lines)])

    def summary(self) -> list[tuple[str, str]]:
        """(what, text) of each line for people."""
        plant, loop, clock = self.loop.plant, self.loop, self.clock
        sizes = f"{count(plant.tanks, 'tank')}, {count(plant.pumps, 'pump')}"
        parts = (
            f"controller {type(loop.controller).__name__}, observer {type(loop.observer).__name__}"
        )
        rows = [
            ("", f"{self.name}: {self.title}"),
            ("", f"{sizes}; {parts}"),
            ("", f"{clock.duration:g} s in samples of {clock.dt:g} s"),
        ]
        for name, spec in self.free.items():
            free, of = Free(*spec), describe(loop, name)["unit"]
            value = clean(get_value(loop, name))
            rows.append(
                ("tunable", f"{name} = {value} {of}, from {free.low:g} to {free.high:g} {of}")
            )
        for measure, limit in self.limits.items():
            if measure not in MEASURES:
                rows.append(("limit", f"{measure}: there is no such measure"))
                continue
            side = "at least" if MEASURES[measure].sense < 0 else "at most"
            of = "" if isinstance(limit, str) else f" {unit(measure, loop.units)}"
            rows.append(("limit", f"{measure} {side} {clean(limit)}{of}"))
        return [*rows, ("objective", " + ".join(f"{w:g} {m}" for m, w in self.objective.items()))]


def uncertain_shares(case: Case) -> dict[str, float]:
    """Return {name: share} of the uncertain parameters of a case; every flow if it states none."""
    if case.uncertain or case.covariance is not None:
        return dict(case.uncertain)
    values = parameters(case.loop)
    # of a custom plant, a leaf named "valve" may be anything
    elements = isinstance(case.loop.plant, TankNetwork)
    names = UNKNOWN if elements else [n for n in UNKNOWN if n not in ("valve", "extent")]
    shares = {f"plant.{n}": SPREAD for n in names if np.size(values.get(f"plant.{n}", ()))}
    if np.max(np.asarray(values.get("plant.split", 0.0)), initial=0.0) * (1.0 + SPREAD) > 1.0:
        shares.pop("plant.split")
    return shares or {"sensor.noise": SPREAD}
