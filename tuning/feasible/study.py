"""`feasibility`: which plants can hold the setpoints of a case at all, whatever the controller.

Imported as `tuning.feasibility` and by the commands.
"""

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxtank import rig
from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.rig.values import with_models
from tuning.feasible.mends import DESIGN, KINDS, TARGET, find_mends
from tuning.feasible.offset import least_offsets
from tuning.feasible.ramps import mended_ramp
from tuning.feasible.result import Feasibility, Mend, PlateauNeed
from tuning.uncertainty.distributions import stated
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.needs import Needs, judges
from tuning.uncertainty.sampling import check_whole, probabilities, spread_of


def feasibility(
    case: Case,
    distributions: Mapping[str, Any] | None = None,
    samples: int = 4096,
    seed: int = 0,
    limits: Mapping[str, Any] | None = None,
    *,
    mends: bool = True,
) -> Feasibility:
    """Return which plants can hold every plateau of the reference under some controller.

    A plant cannot hold the setpoints if the steady state of a plateau needs a level above its
    limit, a flow that runs backwards, or an input outside the range of its pump. Steady states are
    solved for all plants at once on the host; nothing is simulated or compiled.

    Parameters
    ----------
    case : Case
    distributions : dict or None
        {dotted name: distribution, or a relative half-width}; those of the case where None.
    samples : int
        Number of plants (scrambled Sobol points).
    seed : int
    limits : dict or None
        {measure: limit} as in `tune`, of which `max_level` counts; those of the case where None. A
        tank without a limit has its rim.
    mends : bool
        Look for the smallest changes that make 95 % of the plants feasible, with twice as many
        plants.

    Returns
    -------
    Feasibility

    Raises
    ------
    InputError
        The reference has no plateaus (a sine moves it), or the rig another number of pumps than of
        outputs; `can_judge` answers beforehand.

    Examples
    --------
    >>> import tuning
    >>> from jaxtank import presets
    >>> found = tuning.feasibility(presets.find("gouta2015/backstepping"), samples=256)
    >>> round(found.infeasible_for_any_controller, 1), [p.tank for p in found.plateaus][-1]
    (0.8, 3)
    >>> [mend.what for mend in found.mends]
    ['setpoints', 'rims', 'orifices']
    """
    check_whole("samples", samples, 2, 2**20)
    check_whole("seed", seed, 0, 2**31 - 1)
    began = time.perf_counter()
    distributions = spread_of(case) if distributions is None else stated(distributions)
    draws = Draws(case.loop, distributions)
    drawn = lambda count: Needs(
        case, draws.values(probabilities("sobol", draws.dimensions, count, seed)), limits
    )
    needs = drawn(samples)
    excess = needs.excess()
    infeasible = np.any(excess > 0, axis=(1, 2))
    rows = _rows(needs, Needs(case, {}, limits).at()[0], excess)
    middle = time.perf_counter()
    wanted = mends and np.mean(infeasible) > 1.0 - TARGET
    found = find_mends(drawn(DESIGN * samples)) if wanted else ()
    return Feasibility(
        case=case,
        distributions=distributions,
        infeasible=infeasible,
        plateaus=rows,
        mends=found,
        seed=seed,
        wall_s=middle - began,
        mends_s=time.perf_counter() - middle,
    )


def _rows(needs, nominal, excess):
    """The PlateauNeeds: every level and input that some plant cannot have."""
    needed, found, tanks = needs.at(), [], needs.rim.shape[1]
    for k, plateau in enumerate(needs.plateaus):
        for q in np.flatnonzero((excess[:, k] > 0).any(axis=0)):
            values, wrong = needed[:, k, q], excess[:, k, q] > 0
            upper = np.sum(wrong & (values > needs.high[:, q])) >= 0.5 * np.sum(wrong)
            limit = (needs.high if upper else needs.low)[:, q]
            found.append(
                PlateauNeed(
                    time_s=plateau.time_s,
                    setpoints=plateau.values,
                    tank=int(q) + 1 if q < tanks else None,
                    pump=int(q) - tanks + 1 if q >= tanks else None,
                    needed=float(nominal[k, q]),
                    needed_p95=float(np.quantile(values, 0.95 if upper else 0.05)),
                    limit=float(np.median(limit)),
                    share=float(np.mean(wrong)),
                    unit=needs.case.loop.units[0 if q < tanks else 1],
                )
            )
    return tuple(found)


def can_judge(case: Case) -> bool:
    """Return whether `feasibility` is defined for a case: its reference has plateaus, and its rig
    as many pumps as outputs.
    """
    return judges(case)


def can_follow(
    case: Case, draws: Mapping[str, Any], limits: Mapping[str, Any] | None = None
) -> np.ndarray:
    """Return which plants can hold every plateau of the reference under some controller.

    Parameters
    ----------
    case : Case
    draws : dict
        {dotted name: (N, ...)} values of leaves, or of entries of them.
    limits : dict or None
        As in `feasibility`.

    Returns
    -------
    (N,) array of bool

    Examples
    --------
    >>> import numpy as np
    >>> from jaxtank import presets
    >>> case = presets.find("gouta2015/backstepping")
    >>> can_follow(case, {"plant.orifice[0]": np.array([0.12, 0.09])}).tolist()
    [True, False]
    """
    return Needs(case, draws, limits).feasible()


def least_offset(
    case: Case, draws: Mapping[str, Any], limits: Mapping[str, Any] | None = None
) -> np.ndarray:
    """Return the least offset from the setpoints that any controller can leave on each plant.

    Parameters
    ----------
    case, draws, limits
        As in `can_follow`.

    Returns
    -------
    (N,) array
        Root mean square over outputs and plateaus [cm]; 0 where the plant can follow, NaN where no
        steady state within the limits was found.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxtank import presets
    >>> case = presets.find("gouta2015/backstepping")
    >>> least_offset(case, {"plant.orifice[0]": np.array([0.12, 0.1])}).round(2).tolist()
    [0.0, 0.68]
    """
    needs = Needs(case, draws, limits)
    return np.sqrt(np.mean(least_offsets(needs) ** 2, axis=1) / needs.setpoints.shape[2])


def apply_mend(
    case: Case,
    kind: str,
    distributions: Mapping[str, Any] | None = None,
    samples: int = 4096,
    seed: int = 0,
    limits: Mapping[str, Any] | None = None,
) -> tuple[Case, Mend]:
    """Return a case with the smallest change of one kind that makes its setpoints feasible for 95 %
    of the plants, and that change.

    Parameters
    ----------
    case : Case
    kind : {"setpoints", "rims", "orifices", "pumps", "ramps"}
        "ramps" are for transients: the shortest with which the nominal run keeps its limits.
    distributions, samples, seed, limits
        As in `feasibility`.

    Returns
    -------
    (Case, Mend)
        The case as it is, and a Mend with nothing to set, where it needs none. Models of controller
        and observer follow a changed plant.

    Raises
    ------
    InputError
        No change of this kind is enough.

    Examples
    --------
    >>> import tuning
    >>> from jaxtank import presets
    >>> case = presets.find("gouta2015/backstepping")
    >>> mended, mend = tuning.apply_mend(case, "rims", samples=512)
    >>> float(mended.loop.plant.rim[2]) > 35.0, mend.what
    (True, 'rims')
    """
    if kind not in KINDS:
        raise InputError(f"unknown mend {str(kind)!r}: must be one of {', '.join(KINDS)}")
    if kind == "ramps":
        mend = mended_ramp(case if limits is None else case.replace(limits=limits))
        needed = ""
    else:
        found = feasibility(case, distributions, samples, seed, limits)
        mend = next((m for m in found.mends if m.what == kind), None)
        needed = f": {100 * found.infeasible_for_any_controller:.3g} % of the plants are infeasible"
        if np.mean(found.infeasible) <= 1.0 - TARGET:
            mend = Mend(what=kind, set={}, share=None, words=f"the {kind} need no change")
    if mend is None:
        others = "" if kind == "ramps" else _others(found)
        raise InputError(
            f"{case.name}: no change of its {kind} alone was found to be enough{needed}{others}"
        )
    found = rig.set_values(case, with_models(case.loop, mend.set))
    if found.loop.safety_filter is not None:  # designed anew for what has changed
        found = found.without_safety_filter().with_safety_filter(**dict(case.safety or {}))
    return found, mend


def _others(found):
    """What else would be enough, for a message."""
    kinds = ", ".join(m.what for m in found.mends)
    return f"; what is: {kinds}" if kinds else ""
