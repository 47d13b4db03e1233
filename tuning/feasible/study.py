"""`feasibility`: which plants can hold the setpoints of a case at all, whatever the controller."""

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank import rig
from jaxtank.analysis.steady_batch import SteadyStates
from jaxtank.case import Case, check_case
from jaxtank.core.checks import check_whole
from jaxtank.core.errors import InputError
from jaxtank.core.labels import input_unit
from jaxtank.core.tree import get_value
from jaxtank.limits import resolve_limits
from jaxtank.loop import run as lp
from jaxtank.rig.values import with_models
from jaxtank.signals.setpoints import Ramps
from tuning.feasible.result import Feasibility, Mend, PlateauNeed
from tuning.problem.scenarios import runs_of
from tuning.uncertainty.distributions import stated
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.needs import Needs, unjudged
from tuning.uncertainty.sampling import probabilities, spread_of


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
        {dotted name: distribution, or a relative half-width}; default: of the case.
    samples : int
        Number of plants (scrambled Sobol points).
    seed : int
    limits : dict or None
        {measure: limit} as in `tune`, of which `max_level` counts; default: of the case. The limit
        of any other tank is its rim.
    mends : bool
        Look for the smallest changes that make 95 % of the plants feasible, with twice as many
        plants.

    Returns
    -------
    Feasibility

    Raises
    ------
    InputError
        The steady states are not known, as where a sine moves the reference; `can_judge` answers
        beforehand.

    Examples
    --------
    >>> import tuning
    >>> from jaxtank import presets
    >>> study = tuning.feasibility(presets.find("gouta2015/backstepping"), samples=256)
    >>> round(study.infeasible_for_any_controller, 1), [p.tank for p in study.plateaus][-1]
    (0.8, 3)
    >>> [mend.what for mend in study.mends]
    ['setpoints', 'rims', 'orifices']
    """
    check_case(case, seed)
    check_whole("samples", samples, 2, 2**20)
    began = time.perf_counter()
    distributions = spread_of(case) if distributions is None else stated(distributions, case.loop)
    draws = Draws(case.loop, distributions)
    points = lambda count: probabilities("sobol", draws.dimensions, count, seed)
    needs_of = lambda count: Needs(case, draws.values(points(count)), limits)
    needs = needs_of(samples)
    excess = needs.excess()
    infeasible = np.any(excess > 0, axis=(1, 2))
    rows = _rows(needs, Needs(case, {}, limits).at()[0], excess)
    middle = time.perf_counter()
    mend = mends and np.mean(infeasible) > 1.0 - TARGET
    return Feasibility(
        case=case,
        distributions=distributions,
        infeasible=infeasible,
        plateaus=rows,
        mends=find_mends(needs_of(DESIGN * samples)) if mend else (),
        seed=seed,
        wall_s=middle - began,
        mends_s=time.perf_counter() - middle,
    )


def _rows(needs, nominal, excess):
    """The PlateauNeeds: every level and input that some plant cannot have."""
    needed, rows, tanks = needs.at(), [], needs.rim.shape[1]
    plant, (length, drive) = needs.case.loop.plant, needs.case.loop.units[:2]
    for k, plateau in enumerate(needs.plateaus):
        for q in np.flatnonzero((excess[:, k] > 0).any(axis=0)):
            values, wrong = needed[:, k, q], excess[:, k, q] > 0
            upper = np.sum(wrong & (values > needs.high[:, q])) >= 0.5 * np.sum(wrong)
            limit = (needs.high if upper else needs.low)[:, q]
            rows.append(
                PlateauNeed(
                    time_s=plateau.time_s,
                    setpoints=plateau.values,
                    tank=int(q) + 1 if q < tanks else None,
                    pump=int(q) - tanks + 1 if q >= tanks else None,
                    needed=float(nominal[k, q]),
                    needed_p95=float(np.quantile(values, 0.95 if upper else 0.05)),
                    limit=float(np.median(limit)),
                    share=float(np.mean(wrong)),
                    unit=length if q < tanks else input_unit(plant, int(q) - tanks, drive),
                    upper=bool(upper),
                )
            )
    return tuple(rows)


def of_nominal_plant(case: Case) -> tuple[PlateauNeed, ...] | None:
    """Return what the plateaus need and the plant of the case cannot have; None where not known."""
    if not can_judge(case):
        return None
    needs = Needs(case, {})
    return _rows(needs, needs.at()[0], needs.excess())


def can_judge(case: Case) -> bool:
    return not unjudged(case)


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
    check_case(case)
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
    check_case(case)
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
        The unchanged case and an empty Mend, if no change is needed. Models of controller
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
    check_case(case, seed)
    if kind not in KINDS:
        raise InputError(f"unknown mend {str(kind)!r}: must be one of {', '.join(KINDS)}")
    if kind == "ramps":
        mend = mended_ramp(case if limits is None else case.replace(limits=limits))
        remark = ""
    else:
        study = feasibility(case, distributions, samples, seed, limits)
        mend = next((m for m in study.mends if m.what == kind), None)
        share, others = study.infeasible_for_any_controller, ", ".join(m.what for m in study.mends)
        remark = f": {100 * share:.3g} % of the plants are infeasible"
        remark += f"; what is: {others}" if others else ""
        if share <= 1.0 - TARGET:
            mend = Mend(what=kind, set={}, share=None, words=f"the {kind} need no change")
    if mend is None:
        raise InputError(
            f"{case.name}: no change of its {kind} alone was found to be enough{remark}"
        )
    mended = rig.set_values(case, with_models(case.loop, mend.set))
    if mended.loop.safety_filter is not None:  # designed anew for what has changed
        mended = mended.without_safety_filter().with_safety_filter(**dict(case.safety or {}))
    return mended, mend


ROUNDS = 12  # times that the limits are linearised
SWEEPS = 60  # sweeps of Hildreth's method over the linearised limits

REACHED = 1e-4  # excess over a limit, as a share of it, that counts as within it


def least_offsets(needs: Needs) -> np.ndarray:
    """Return (N, P) distances of the nearest steady states within limits [cm]; NaN: none found."""
    # by sequential quadratic programming from y = r, all plants at once: the limits are linearised
    # at y, and r is projected onto them by Hildreth's method (dual coordinate ascent).
    r = np.broadcast_to(needs.setpoints, (needs.count, *needs.setpoints.shape[1:]))
    size = np.maximum(np.abs(needs.high), np.abs(needs.low))[:, None]
    wrong = needs.excess() > 0
    offsets = np.zeros(r.shape[:2])
    plants = np.flatnonzero(wrong.any(axis=(1, 2)))
    if not len(plants):
        return offsets
    few = Needs(needs.case, {n: v[plants] for n, v in needs.values.items()}, needs.limits)
    few_r, size = r[plants], size[plants]
    low, high = few.low[:, None] / size, few.high[:, None] / size
    y, best = few_r.copy(), np.full(few_r.shape[:2], np.inf)
    step = 1e-5 * np.maximum(few_r, 1e-2 * few_r.max())
    for round_ in range(ROUNDS + 1):
        needed = few.at(y) / size
        over = np.nan_to_num(np.maximum(needed - high, low - needed), nan=np.inf).max(axis=2)
        distance = np.where(over <= REACHED, np.linalg.norm(y - few_r, axis=2), np.inf)
        best = np.minimum(best, distance)
        if round_ == ROUNDS:
            break
        columns = []
        for move in step * np.eye(r.shape[2])[:, None, None]:
            change = (few.at(y + move) - few.at(y - move)) / size
            columns.append(change / (2.0 * move).sum(-1)[..., None])
        slopes = np.stack(columns, axis=-1)
        rows = np.concatenate([slopes, -slopes], axis=2)
        ends = np.concatenate([high - needed, needed - low], axis=2)
        ends = ends + np.einsum("spqm,spm->spq", rows, y)
        y = np.maximum(_projected(few_r, rows, ends), 1e-3 * few_r.max())
    offsets[plants] = np.where(np.isfinite(best), best, np.nan)
    return offsets


def _projected(r, rows, ends):
    """The points next to r with rows . y <= ends, by Hildreth's method."""
    weight = np.sum(rows * rows, axis=3)
    weight = np.where(weight > 1e-18, weight, np.inf)
    y, dual = r.copy(), np.zeros(ends.shape)
    for _ in range(SWEEPS):
        before = dual.copy()
        for q in range(ends.shape[2]):
            row = rows[:, :, q]
            over = np.einsum("spm,spm->sp", row, y) - ends[:, :, q]
            new = np.maximum(0.0, dual[:, :, q] + over / weight[:, :, q])
            y = y - row * (new - dual[:, :, q])[..., None]
            dual[:, :, q] = new
        if np.max(np.abs(dual - before)) <= 1e-9 * max(1.0, np.max(np.abs(dual))):
            break
    return y


STEPS = 9  # runs of a bisection: to 1/500 of its first interval


def mended_ramp(case: Case) -> Mend | None:
    """Return the shortest `reference.ramp` with which the case's own run holds its limits."""
    reference = case.loop.reference
    if not isinstance(reference, Ramps) or not reference.changes:
        raise InputError(f"{case.name}: its reference has no ramps to mend")
    now, most = float(reference.ramp), _longest(reference, case.clock.duration)
    if _holds(case, now):
        return Mend(what="ramps", set={}, share=None, words="the ramps need no change")
    bad, good = now, max(now, 1.0)
    while good < most:
        good = min(1.6 * good, most)
        if _holds(case, good):
            break
        bad = good
    else:
        return None
    for _ in range(STEPS):
        middle = 0.5 * (bad + good)
        bad, good = (bad, middle) if _holds(case, middle) else (middle, good)
    scale = 10.0 ** (2 - math.floor(math.log10(good)))
    rounded = math.ceil(good * scale - 1e-9) / scale  # up to three digits
    good = rounded if rounded <= most and _holds(case, rounded) else good
    words = f"ramps of {good:g} s"
    return Mend(what="ramps", set={"reference.ramp": good}, share=None, words=words)


def _longest(reference, duration):
    """The shortest time between two changes of an output, or to the end of the run [s]."""
    times = ([t for t, i in reference.changes if i == j] for j in range(reference.channels))
    gaps = (b - a for each in times for a, b in zip(each, [*each[1:], duration]))
    return min(gap for gap in gaps if gap > 0)


def _holds(case, ramp):
    """Whether the nominal run with ramps of `ramp` [s] holds every limit of the case."""
    mended = rig.set_values(case.replace(scenarios=()), {"reference.ramp": float(ramp)})
    limits = resolve_limits(mended)
    if not limits:
        return True
    key = runs_of(mended, (), 0)[0].key
    names = tuple(dict.fromkeys(limit.measure for limit in limits))
    measured, diverged = lp.evaluate_and_flag(mended.loop, mended.clock, names, key)
    return not bool(diverged) and all(limit.margin(measured) >= 0 for limit in limits)


KINDS = ("setpoints", "rims", "orifices", "pumps", "ramps")

TARGET = 0.95  # share of the plants that a mend makes feasible [-]

AIM = 0.956  # the same on the draws of the search: 2 sd of the share of 4,096 others above

DESIGN = 2  # draws in the design of a change per draw that is counted: more draws, less scatter

COARSE = 1024  # draws that give the direction of a move of setpoints; its size needs all
FACTORS = (1.02, 1.05, 1.1, 1.2, 1.35, 1.6, 2.0, 3.0)  # on the areas of orifices

FAR = 0.4  # margin, as a share of a limit, above which a change of setpoints ignores the limit
ROUNDING = 1e-4  # margin, as a share of a limit, that a search of setpoints keeps
LARGEST = 1e6  # excess, as a share of a limit, that stands for no steady state


def find_mends(needs: Needs) -> tuple[Mend, ...]:
    """Return the mends of each kind that has one; () where the case needs none."""
    if needs.feasible().mean() >= TARGET:
        return ()
    mends = (search(needs) for search in (_setpoints, _rims, _orifices, _pumps))
    return tuple(mend for mend in mends if mend is not None)


def _least(good: Callable, low: float, high: float, steps: int = 14) -> float:
    for _ in range(steps):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if good(middle) else (middle, high)
    return high


def _rounded(value: float, old: float, digits: int = 2) -> float:
    """`value` rounded away from `old`, to `digits` digits of the change behind its first."""
    change = abs(value - old)
    if change == 0.0:
        return value
    places = digits - math.floor(math.log10(change))
    scale = 10.0**places
    away = math.ceil if value > old else math.floor
    return round(away(round(value * scale, 6)) / scale, max(places, 0))


# setpoints

MANY = 24  # setpoints up to which their least change is searched for; nobody sets more by hand


def _setpoints(needs: Needs) -> Mend | None:
    """The least change of all setpoints, in the sum of its squares."""
    names = list(dict.fromkeys(name for p in needs.plateaus for name in p.names))
    if len(names) > MANY:
        return None
    where = np.array([[names.index(name) for name in p.names] for p in needs.plateaus])
    moved = lambda change: needs.setpoints + change[where]
    share = lambda change: needs.feasible(needs.at(moved(change))).mean()
    old = {n: v for p in needs.plateaus for n, v in zip(p.names, p.values)}
    values = np.array([old[name] for name in names])
    change, quantile, coarse = np.zeros(len(names)), AIM, needs.first(COARSE)
    low, high = AIM, 1.0 - (1.0 - AIM) / 8.0
    best = None
    for _ in range(5):  # the quantile of each need at which they hold together
        change = _least_move(coarse, where, values, quantile, change)
        enough = share(change) >= AIM
        best = change if enough else best
        low, high = (low, quantile) if enough else (quantile, high)
        quantile = 0.5 * (low + high)
    if best is None:
        return None
    scale = _least(lambda s: share(s * best) >= AIM, 0.0, 1.0, 10)
    return _rounded_setpoints(names, values, scale * best, share)


def _rounded_setpoints(names, values, change, share):
    """The Mend of a change, rounded away from the case; a little more where rounding lost some."""
    digits = 10.0 ** (math.floor(math.log10(np.max(np.abs(change)))) - 2)
    for more in 1.0 + 0.005 * np.arange(20):
        large = np.where(np.abs(change) < digits, 0.0, more * change)
        away = np.sign(large) * np.ceil(np.abs(large) / digits - 1e-9) * digits
        places = max(0, -round(math.log10(digits)))
        new = {n: round(float(v + c), places) for n, v, c in zip(names, values, away) if c != 0.0}
        exact = np.array([new.get(n, v) for n, v in zip(names, values)]) - values
        if (feasible := share(exact)) >= AIM:
            pairs = [f"{n} {v:g} -> {new[n]:g}" for n, v in zip(names, values) if n in new]
            return Mend(what="setpoints", set=new, share=float(feasible), words=", ".join(pairs))
    return None


def _least_move(needs, where, values, quantile, start):
    """(names,) least change for which the quantile of each need is within its limit."""
    size = np.maximum(np.abs(needs.high), np.abs(needs.low))[:, None]
    outputs = where.shape[1]

    def over(change):
        excess = needs.excess(needs.at(np.maximum(needs.setpoints + change, 1e-6))) / size
        return np.minimum(excess, LARGEST)

    rank = min(needs.count, math.ceil(quantile * needs.count)) - 1
    # levels far from their limit are ignored here; the final share counts all
    near = np.partition(over(0.0), rank, axis=0)[rank] > -FAR
    needed = lambda change: np.partition(over(change)[:, near], rank, axis=0)[rank]

    def slopes(change):
        h, base = 1e-4 * float(np.max(np.abs(values))), change[where]
        matrix = np.zeros((*near.shape, len(values)))
        for j in range(outputs):
            step = h * np.eye(outputs)[j]
            slope = np.zeros(near.shape)
            slope[near] = -(needed(base + step) - needed(base - step)) / (2.0 * h)
            for k, name in enumerate(where[:, j]):
                matrix[k, :, name] += slope[k]
        return matrix[near]

    return scipy.optimize.minimize(
        lambda change: float(change @ change),
        start,
        jac=lambda change: 2.0 * change,
        method="SLSQP",
        bounds=[(-0.9 * v, None) if v > 0 else (0.0, None) for v in values],
        constraints={"type": "ineq", "fun": lambda c: -needed(c[where]) - ROUNDING, "jac": slopes},
        options={"maxiter": 40, "ftol": 1e-4},
    ).x


# rims and pumps


def _rims(needs: Needs) -> Mend | None:
    """Return raised rims; None if rims differ from plant to plant. Limits below a rim stay."""
    if np.ptp(needs.rim, axis=0).any():
        return None
    return _raised(needs, "rims", "plant.rim", 0, np.flatnonzero(needs.at_rim))


def _pumps(needs: Needs) -> Mend | None:
    """Return raised upper limits of the pumps; None if they differ from plant to plant."""
    tanks = needs.rim.shape[1]
    if np.ptp(needs.high[:, tanks:], axis=0).any():
        return None
    plant: Any = needs.case.loop.plant
    pumps = np.arange(tanks, tanks + len(plant.feeds))  # a valve opens to 1 at most
    return _raised(needs, "pumps", "actuator.high", tanks, pumps)


def _raised(needs, what, leaf, first, columns) -> Mend | None:
    """Return the Mend that raises the violated limits among `columns`; equal ones stay equal."""
    needed, old = needs.at(), needs.high[0]
    most = np.nan_to_num(needed, nan=np.inf).max(axis=1)

    def raised(quantile):
        high = needs.high.copy()
        for i in columns:
            new = np.quantile(most[:, i], quantile, method="higher")
            if new > old[i] and np.isfinite(new):
                high[:, i] = new
        return high

    share = lambda high: needs.feasible(needed, high=high).mean()
    if share(raised(1.0)) < AIM:
        return None
    quantile = _least(lambda p: share(raised(p)) >= AIM, 0.5, 1.0)
    high = raised(quantile)[0]
    changed = [int(i) for i in columns if high[i] > old[i]]
    new = {i: _rounded(float(high[i]), float(old[i])) for i in changed}
    if len(changed) > 1 and len({old[i] for i in changed}) == 1:
        bound = max(new.values())
        level = lambda top: np.where(np.isin(np.arange(len(old)), changed), top, needs.high)
        before = float(old[changed[0]])
        least = _least(lambda top: share(level(top)) >= AIM, before, bound)
        new = dict.fromkeys(changed, _rounded(least, before))
    top = needs.high.copy()
    top[:, changed] = [new[i] for i in changed]
    which = ", ".join(str(i - first + 1) for i in changed)
    several, unit = "s" * (len(changed) > 1), needs.case.loop.units[0 if first == 0 else 1]
    heights = ", ".join(dict.fromkeys(f"{v:g}" for v in new.values()))
    words = f"rim{several} of tank{several} {which} at {heights} {unit}"
    if what == "pumps":
        words = f"pump{several} {which} up to {heights} {unit}"
    values = {f"{leaf}[{i - first}]": v for i, v in new.items()}
    return Mend(what=what, set=values, share=float(share(top)), words=words)


# orifices


def _orifices(needs: Needs) -> Mend | None:
    """One factor on the areas of all orifices and pipes between tanks, the one nearest to 1."""
    leaves = [n for n in ("orifice", "pipe") if needs.states.leaves[n].shape[1]]
    if not leaves:
        return None

    def share(factor):
        now = needs.states
        scaled = {n: v * (factor if n in leaves else 1.0) for n, v in now.leaves.items()}
        states = SteadyStates(now.plant, scaled, now.inflow, now.shared)
        return needs.feasible(np.concatenate(states.at(needs.setpoints), axis=2)).mean()

    good = lambda factor: share(factor) >= AIM
    for before, after in zip((1.0, *FACTORS), FACTORS):
        ways = [way for way in (1.0, -1.0) if good(after**way)]
        if not ways:
            continue
        factors = [_least(lambda f, w=w: good(f**w), before, after, 9) ** w for w in ways]
        factor = _rounded(min(factors, key=lambda f: abs(math.log(f))), 1.0, 2)
        leaf = lambda name: np.asarray(get_value(needs.case.loop, f"plant.{name}"), dtype=float)
        new = {f"plant.{n}": [float(f"{v * factor:.6g}") for v in leaf(n)] for n in leaves}
        words = f"{' and '.join(f'{n}s' for n in leaves)} x {factor:g}"
        return Mend(what="orifices", set=new, share=float(share(factor)), words=words)
    return None
