"""Input validation that observers share: their model, and the tanks that they name."""

import jax
import numpy as np
from jax.core import Tracer
from numpy.typing import ArrayLike

from jaxtank.analysis.linear_model import linearise_compiled
from jaxtank.core.errors import InputError


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


def check_disturbed(observer, plant, levels, shares: ArrayLike = 1.0):
    """Raise InputError unless the disturbances of a Kalman filter can be found."""
    # A constant disturbance of the rates of the tanks `disturbed` shows in the readings if [[A, E],
    # [C, 0]] has full column rank, A the slope of the level rates, E and C the columns and rows of
    # the identity of `disturbed` and `measured` (Popov, Belevitch and Hautus, at the eigenvalue 0).
    check_tanks(observer, "disturbed", plant, least=0)
    if not observer.disturbed:
        return
    if observer.walk is None:
        raise InputError(
            "observer.walk: needs a variance per tank where observer.disturbed names tanks"
        )
    if not hasattr(observer.model, "area"):
        raise InputError("observer.disturbed: needs a model with the area of each tank")
    traced = (observer.model, levels)
    if any(isinstance(v, Tracer) for v in jax.tree.leaves(traced)):
        return
    eye, still = np.eye(plant.tanks), np.zeros(plant.pumps)
    A = np.asarray(linearise_compiled(observer.model, np.asarray(levels) * shares, still)[0])
    # each state in units of what it does in a time constant: all entries are near 1
    A = A / max(np.abs(A).max(), 1e-300)
    E, C = eye[:, list(observer.disturbed)], eye[list(observer.measured)]
    none = np.zeros((len(C), E.shape[1]))
    if np.linalg.matrix_rank(np.block([[A, E], [C, none]]), 1e-9) < plant.tanks + E.shape[1]:
        raise InputError(
            f"observer.disturbed = {observer.disturbed}: these disturbances are not identifiable"
            f" from observer.measured = {observer.measured}: name at most as many tanks as are"
            " measured, each connected to a measured tank"
        )
