"""Sentences on what a case has and no run can follow: keys without effect, parts that never act."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxtank.case import Case
from jaxtank.controllers.pid import PID
from jaxtank.core.labels import label_of
from jaxtank.core.tree import get_value
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.rig.schema import SECTIONS
from jaxtank.rig.signals import parts_of, steps
from jaxtank.signals.setpoints import Sine

RANGEABILITY, EXPONENT = (
    SECTIONS[section][key].default
    for section, key in (("valve", "rangeability"), ("orifice", "exponent"))
)
"""What a file that says nothing has [-]."""


def idle_parts(case: Case) -> Iterator[str]:
    """Yield a sentence for each part of a case that has no effect on any run of it."""
    if isinstance(case.loop.plant, TankNetwork):
        for rule in (_closed, _valves, _dry, _overflows, _pumps):
            yield from rule(case)
    for rule in (_faults, _gains, _courses):
        yield from rule(case)


def _at(values: Any, k: int, usual: float) -> float:
    """Entry k of a leaf; `usual` where a plant has no such leaf."""
    return usual if values is None else float(values[k])


def _label(plant: Any, kind: str, k: int) -> str:
    """What sentences call an opening."""
    if kind == "drain":
        return f"drain of {label_of(plant, 'tank', k)}"
    return label_of(plant, "pump", len(plant.feeds) + k) if kind == "valve" else f"{kind} {k + 1}"


def _closed(case: Case) -> Iterator[str]:
    """On keys of drains and orifices that are closed."""
    plant: Any = case.loop.plant
    leaks = {of for of, *_ in case.loop.faults.windows} if case.loop.faults else set()
    for kind in ("drain", "orifice"):
        ports, exponents, resistances = (
            getattr(plant, f"{kind}_{option}") for option in ("port", "exponent", "resistance")
        )
        for k in np.flatnonzero(np.asarray(getattr(plant, kind)) == 0.0).tolist():
            exponent, label = _at(exponents, k, EXPONENT), _label(plant, kind, k)
            if f"{kind}[{k}]" not in leaks and exponent != EXPONENT:
                yield f"{label}: exponent = {exponent:g} has no effect: its area is 0"
            sealed = f"{kind}[{k}]" not in leaks and np.isinf(_at(resistances, k, np.inf))
            if sealed and _at(ports, k, 0.0) > 0.0:
                yield f"{label}: port has no effect: it is closed"


def _valves(case: Case) -> Iterator[str]:
    """On keys of valves of another kind."""
    plant: Any = case.loop.plant
    for k, (_, sink) in enumerate(plant.valves):
        label, kind = _label(plant, "valve", k), plant.characteristics[k]
        share = _at(plant.rangeability, k, RANGEABILITY)
        if kind != "equal-percentage" and share != RANGEABILITY:
            word = kind if isinstance(kind, str) else "a table"
            yield f"{label}: rangeability = {share:g} has no effect: its characteristic is {word}"
        if plant.one_way[k] and sink is None:
            yield f"{label}: check = true has no effect: nothing comes back from the basin"


def _dry(case: Case) -> Iterator[str]:
    """On openings at or above the rims of the tanks that they leave."""
    plant: Any = case.loop.plant
    ends = {"drain": [(i,) for i in range(plant.tanks)], "pipe": plant.pipes}
    ends |= {"orifice": [links[:1] for links in plant.links], "valve": plant.valves}
    for kind, openings in ends.items():
        ports = getattr(plant, f"{kind}_port")
        if ports is None:
            continue
        for k, tanks in enumerate(openings):
            rim = max(float(plant.rim[i]) for i in tanks if i is not None)
            if float(ports[k]) >= rim:
                yield (
                    f"{_label(plant, kind, k)}: its port, {ports[k]:g} {plant.units[0]}, is not"
                    f" below the rim at {rim:g} {plant.units[0]}: nothing flows through it up to"
                    " there"
                )


def _overflows(case: Case) -> Iterator[str]:
    """On spills of a rig whose overflow is not simulated."""
    plant: Any = case.loop.plant
    if plant.spills and not plant.overflow:
        yield "plant.overflow = false: levels rise past their rims, and no [[spill]] has an effect"


def _pumps(case: Case) -> Iterator[str]:
    """On inputs that never leave their dead zone, and on keys of a dead zone that is none."""
    plant, bank = case.loop.plant, case.loop.actuator
    zones = getattr(bank, "dead_zone", None)
    if zones is None:
        if getattr(bank, "dead_zone_kind", "plain") != "plain":
            yield f'actuator.dead_zone_kind = "{bank.dead_zone_kind}" has no effect: no dead_zone'
        return
    for j, (zone, high) in enumerate(zip(np.asarray(zones), np.asarray(bank.high))):
        if zone >= high > 0.0:
            yield (
                f"{label_of(plant, 'pump', j)} never runs: its dead_zone, {zone:g}, is not below"
                f" its high, {high:g}"
            )


def _faults(case: Case) -> Iterator[str]:
    """On faults that change nothing."""
    faults = case.loop.faults
    if faults is None:
        return
    windows = faults.windows
    for k, (of, *_) in enumerate(windows):
        factor, extra = float(faults.factor[k]), float(faults.extra[k])
        value = float(get_value(case.loop.plant, of))
        alone = sum(other == of for other, *_ in windows) == 1
        if alone and value * factor + extra == value:
            yield (
                f"fault {k + 1} of {of}: factor = {factor:g} and extra = {extra:g} leave it at"
                f" {value:g}: it has no effect"
            )


def _gains(case: Case) -> Iterator[str]:
    """On keys of the integral action of a PID without one."""
    part = case.loop.controller  # a schedule may hold the Ti of its law
    if not isinstance(part, PID) or part.Ti is not None:
        return
    if part.anti_windup != "back-calculation":
        yield f'controller.anti_windup = "{part.anti_windup}" has no effect: there is no Ti'


def _courses(case: Case) -> Iterator[str]:
    """On a shape of ramps of no duration, and sines and pulses of nothing."""
    parts = {"reference": case.loop.reference, "inputs": case.loop.controller}
    for name, part in parts.items():
        signal = steps(getattr(part, "signal", part))
        if signal is not None and signal.changes and not signal.ramp and signal.shape != "linear":
            yield f'{name}.shape = "{signal.shape}" has no effect: {name}.ramp is 0'
    sine = getattr(case.loop.reference, "second", None)
    if isinstance(sine, Sine):
        if float(sine.amplitude) == 0.0 == float(sine.offset):
            yield "reference.sine has no effect: its amplitude is 0"
        elif sine.period < 2.0 * case.clock.dt:
            yield (
                f"reference.sine.period = {sine.period:g} s is below two samples of"
                f" {case.clock.dt:g} s: the samples show another, slower sine"
            )
    pulses, *_ = parts_of(case.loop.disturbance)
    if pulses is not None:
        for k in np.flatnonzero(np.asarray(pulses.volume) == 0.0):
            yield f"inflow at {pulses.events[k][0]:g} s has no effect: its volume is 0"
