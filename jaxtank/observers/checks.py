"""Input validation that observers share: their model, and the tanks that they name."""

import jax
import numpy as np
from jax.core import Tracer
from numpy.typing import ArrayLike

from jaxtank.analysis.linear_model import linearise_compiled
from jaxtank.core.errors import InputError
from jaxtank.core.tree import describe, get_value, split_index, with_entries


def check_model(observer, plant):
    """Raise InputError unless the observer's model and its leaves fit the plant."""
    n, model = plant.tanks, observer.model
    if model.tanks != n or model.pumps != plant.pumps:
        raise InputError(
            f"observer.model has {model.tanks} tanks and {model.pumps} pumps, the plant {n} and"
            f" {plant.pumps}"
        )


def check_tanks(observer, name, plant, least=1):
    """Raise InputError unless the field `name` holds `least` tanks of the plant, each once."""
    tanks, n = getattr(observer, name), plant.tanks
    if (
        not len(tanks) >= least
        or len(set(tanks)) != len(tanks)
        or not all(isinstance(i, int) and 0 <= i < n for i in tanks)
    ):
        some = "name at least one of" if least else "name"
        raise InputError(
            f"observer.{name} = {tanks}: must {some} the {n} tanks, counted from 0, each once"
        )


def check_coefficients(observer):
    """Raise InputError unless the field `coefficients` names entries that may drift."""
    names, model = observer.coefficients, observer.model
    if len(set(names)) != len(names):
        raise InputError(f"observer.coefficients = {names}: must name each entry once")
    for name in names:
        label, meta = f"observer.coefficients: {name}", describe(model, name)
        positive = meta["kind"] == "leaf" and meta["low"] == 0.0 and meta["high"] is None
        if not positive or meta["unit"] == model.units[0] or not split_index(name)[1]:
            raise InputError(
                f"{label}: must be an entry of an area or of a gain, such as drain[0], pump_gain[0]"
            )
        value = get_value(model, name)
        if not isinstance(value, Tracer) and not np.all(value > 0.0):
            unit = meta["unit"]
            raise InputError(f"{label} = {value:g} {unit}: must be above 0 {unit} in the model")
    needed = {"coefficient_spread", "coefficient_walk"} if names else set()
    if absent := [name for name in sorted(needed) if getattr(observer, name) is None]:
        raise InputError(f"observer.{absent[0]}: needs a value where coefficients are named")


def _effects(model, names, levels):
    """Columns (n,) of what each coefficient adds to the level rates while the inputs run."""
    curves = getattr(model, "curves", ()) or (None,) * model.pumps
    last = [1.0 if curve is None else curve[-1][0] for curve in curves]
    u = tuple(last + [1.0] * (model.pumps - len(last)))
    rates = lambda model: np.stack(model.derivative(0.0, tuple(levels), u, None))
    return [
        rates(with_entries(model, [(name, lambda v: 2.0 * v)])) - rates(model) for name in names
    ]


def check_disturbed(observer, plant, levels, shares: ArrayLike = 1.0):
    """Raise InputError unless the disturbances and coefficients of a filter can be found."""
    # Constants that change the level rates by the columns E show in the readings of a rig at rest
    # if [[A, E], [C, 0]] has full column rank, A the slope of the level rates, C the rows of the
    # identity of `measured` (Popov, Belevitch and Hautus, at the eigenvalue 0). E has the columns
    # of the identity of `disturbed`, and the effects of `coefficients`.
    check_tanks(observer, "disturbed", plant, least=0)
    names = observer.coefficients
    if not observer.disturbed and not names:
        return
    if observer.disturbed and observer.walk is None:
        raise InputError(
            "observer.walk: needs a variance per tank where observer.disturbed names tanks"
        )
    if observer.disturbed and not hasattr(observer.model, "area"):
        raise InputError("observer.disturbed: needs a model with the area of each tank")
    traced = (observer.model, levels)
    if any(isinstance(v, Tracer) for v in jax.tree.leaves(traced)):
        return
    eye, still = np.eye(plant.tanks), np.zeros(plant.pumps)
    levels = np.asarray(levels) * shares
    A = np.asarray(linearise_compiled(observer.model, levels, still)[0])
    # each state in units of what it does in a time constant: all entries are near 1
    A = A / max(np.abs(A).max(), 1e-300)
    E, C = eye[:, list(observer.disturbed)], eye[list(observer.measured)]
    effects = [v / max(np.abs(v).max(), 1e-300) for v in _effects(observer.model, names, levels)]
    E = np.column_stack([E, *effects])
    none = np.zeros((len(C), E.shape[1]))
    if np.linalg.matrix_rank(np.block([[A, E], [C, none]]), 1e-9) < plant.tanks + E.shape[1]:
        unknowns = {"disturbed": observer.disturbed, "coefficients": names}
        named = [f"observer.{name} = {values}" for name, values in unknowns.items() if values]
        what = "these coefficients" if names else "these disturbances"
        raise InputError(
            f"{' and '.join(named)}: {what} are not identifiable"
            f" from observer.measured = {observer.measured}: name at most as many as tanks are"
            " measured, each connected to a measured tank"
        )
