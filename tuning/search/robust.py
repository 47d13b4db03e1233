"""Robust tuning: gains for many plants at once, and what can be promised of a plant that was not
among them.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case, Scenario
from jaxtank.core.errors import InputError
from jaxtank.core.tree import split_index
from jaxtank.rig import check_limits
from tuning.problem.problem import Problem
from tuning.problem.result import Shown
from tuning.search.baseline import own_values
from tuning.search.diagnostics import HELD_OUT, summary_of, validate
from tuning.search.result import TuningResult
from tuning.search.tuner import tune
from tuning.uncertainty.distributions import stated
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.result import Ensemble
from tuning.uncertainty.sampling import clopper_pearson, probabilities, spread_of
from tuning.uncertainty.study import ensemble

CONFIDENCE = 1e-6
"""Probability beta with which the scenario bound may fail [-]."""

TOLERANCE = 1e-4
"""Change of the objective, as a share of its first value, at which a search over drawn plants has
arrived: their mean is itself known to a few percent only [-].
"""


class Certificate(NamedTuple):
    """What is known of a fresh plant: by the scenario theory before any is run, and by running
    some.
    """

    scenarios: int  # N plants that the search was held to
    support: int  # of those, how many hold the answer in place
    # probability of breaking a limit, at most, with confidence 1 - 1e-6 (Campi, Garatti, Ramponi
    # 2018)
    bound: float
    fresh: int  # plants run afterwards
    broken: int  # of those, how many broke a limit
    interval95: list  # Clopper and Pearson

    _repr_html_ = Shown._repr_html_
    _lines = Shown._lines

    def __str__(self):
        low, high = self.interval95
        rows = {
            "plants of the search": self.scenarios,
            "support scenarios": self.support,
            "scenario bound": f"{self.bound:.2g} (confidence 1 - {CONFIDENCE:g})",
            "validation plants": self.fresh,
            "validation plants that break a limit": self.broken,
            "probability of breaking a limit": f"{low:.2g} to {high:.2g} (95 % interval)",
        }
        return "\n".join(f"{name}: {value}" for name, value in rows.items())


def scenarios_of(case, distributions=None, samples=64, seed=0):
    """`samples` Scenarios of a case: each of its own in turn (its own run, where it has none) on a
    plant drawn from `distributions`, with noise of its own. Latin hypercube draws. Raises
    InputError for what cannot be drawn.
    """
    distributions = spread_of(case) if distributions is None else stated(distributions)
    space = Draws(case.loop, distributions)
    values = space.values(probabilities("latin", space.dimensions, samples, seed))
    base, found = case.scenarios or (Scenario("run"),), []
    for i in range(samples):
        own = base[i % len(base)]
        drawn = {n: v[i].tolist() for n, v in values.items()}
        set_here = {split_index(n)[0] for n in own.values}
        kept = {n: v for n, v in drawn.items() if split_index(n)[0] not in set_here}
        found.append(
            Scenario(
                f"plant {i + 1}",
                {**own.values, **kept},
                seed=(own.seed + 7919 * (i + 1)) % 2**31,
                weight=own.weight,
            )
        )
    return tuple(found)


def scenario_bound(scenarios, support, beta=CONFIDENCE):
    """Largest probability of breaking a limit, with confidence 1 - beta, of an answer that
    `support` of `scenarios` plants hold in place.

    eps(k) = 1 - (beta / (N C(N, k)))^(1 / (N - k)): M. C. Campi, S. Garatti, F. A. Ramponi, A
    general scenario theory for nonconvex optimization and decision making, IEEE TAC 63(12), 2018.
    It holds whatever the distribution and however the answer was found, for independent plants and
    the support by which the same answer is found. What is counted here are the plants at a limit
    and (for the worst case) at the cost: for the mean, and in part for cvar, every plant moves the
    gains a little, by the theorem's letter the support is then all of them and the bound 1, and
    this figure is an indication. Latin hypercube draws are not independent either. The fresh plants
    are the proof.
    """
    if not 0 <= support <= scenarios:
        raise InputError(f"support = {support}: must be from 0 to the {scenarios} scenarios")
    if support >= scenarios:
        return 1.0
    log = (
        math.log(beta)
        - math.log(scenarios)
        - (
            math.lgamma(scenarios + 1)
            - math.lgamma(support + 1)
            - math.lgamma(scenarios - support + 1)
        )
    )
    return 1.0 - math.exp(log / (scenarios - support))


def tune_robust(
    case: Case,
    distributions: Mapping[str, Any] | None = None,
    risk: str = "mean",
    samples: int = 64,
    fresh: int = 1024,
    seed: int = 0,
    back_off: float = 0.0,
    tolerance: float = TOLERANCE,
    validation: int = 64,
    **options: Any,
) -> TuningResult:
    """`tune` on `samples` plants drawn from `distributions` (the case's own spread where None),
    every limit held on every plant.

    risk: "mean", "cvar" or "worst" of their costs; fresh: plants drawn afterwards, with seeds of
    their own, on which the values before and after are run; back_off: share of each limit [-] that
    the search keeps off it, while fresh plants are judged by the limit itself: a limit that one of
    N plants holds in place is broken by about one fresh plant in N + 1; validation: runs of a case
    that has scenarios of its own, 0 for none (any other is validated by the fresh plants);
    tolerance and other options: as in `tune`. Returns a TuningResult with a Certificate. Raises
    InputError as `tune` and `ensemble` do.
    """
    for name, value, low in (("samples", samples, 2), ("fresh", fresh, 1)):
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= 100_000:
            raise InputError(f"{name} = {value!r}: must be a whole number from {low} to 100000")
    if (
        isinstance(back_off, bool)
        or not isinstance(back_off, (int, float))
        or not 0.0 <= back_off < 1.0
    ):
        raise InputError(
            f"back_off = {back_off!r}: must be a share of each limit, from 0 to below 1"
        )
    distributions = spread_of(case) if distributions is None else stated(distributions)
    limits = check_limits(
        case.loop, case.limits if options.get("limits") is None else options["limits"]
    )
    options["limits"] = _kept_off(case, limits, back_off)
    plants = scenarios_of(case, distributions, samples, seed)
    result = tune(
        case, scenarios=plants, risk=risk, seed=seed, tolerance=tolerance, validation=0, **options
    )
    judge = Problem(case, options.get("free"), options.get("objective"), limits, None, seed)
    # what is certified is the case's own run, what the answer is judged by is its scenarios
    if case.scenarios:
        broken = int(_run(result.tuned, distributions, limits, (), fresh, seed)[1].sum())
        found = (None, None)
        if validation and result.status != "interrupted":
            values = {n: p["after"] for n, p in result.parameters.items()}
            found = validate(judge, own_values(judge), values, validation, seed)
    else:
        *found, broken = _on_fresh(result, judge, distributions, limits, fresh, seed)
    support = _support(result)
    interval = clopper_pearson(broken, fresh)
    certificate = Certificate(
        samples, support, scenario_bound(samples, support), fresh, broken, interval
    )
    words = _words(certificate, risk, back_off)
    return result.replace(
        certificate=certificate,
        validation=found[0],
        cloud=found[1],
        message=f"{words}; {result.message}",
    )


def _words(known, risk, back_off):
    """A Certificate in words, joined by semicolons."""
    low, high = known.interval95
    words = (
        f"on {known.fresh} fresh plants a limit was broken {known.broken} times (95 % interval"
        f" {low:.2g} to {high:.2g}); the scenario theory bounds the probability by"
        f" {known.bound:.2g} (N {known.scenarios}, support {known.support}, confidence 1 - 1e-6"
        + (
            ")"
            if risk == "worst"
            else (
                f", an indication: plants at no limit move the {risk} too, and count for nothing"
                " in it)"
            )
        )
    )
    if back_off:
        return (
            f"{words}; the search kept {100 * back_off:g} % off every limit, fresh plants are"
            " judged by the limits themselves"
        )
    if not (known.broken and known.support):
        return words
    many = (
        f"{known.support} of {known.scenarios} plants hold{'s' if known.support == 1 else ''} the"
        " answer in place"
    )
    return (
        f"{words}; {many}: before any fresh one was run up to about"
        f" {100 * known.support / (known.scenarios + 1):.2g} % of them were to be expected past a"
        " limit, what they then did is said above (more plants or a back-off, --back-off 0.03,"
        " bring both down)"
    )


def _kept_off(case, limits, share):
    """`limits` with `share` of each taken off, the rim being that of the plant."""
    if not share:
        return limits
    rim = np.asarray(case.loop.plant.rim).tolist()
    values = {
        m: np.asarray(rim if isinstance(v, str) else v, dtype=float) for m, v in limits.items()
    }
    return {m: (v - share * ms.MEASURES[m].sense * np.abs(v)).tolist() for m, v in values.items()}


def _run(case, distributions, limits, names, fresh, seed):
    """(Ensemble of `fresh` plants that the search never saw, (fresh,) True where one breaks a limit
    or leaves the numbers).
    """
    seen = cast(
        Ensemble,
        ensemble(
            case,
            distributions,
            samples=fresh,
            key=(HELD_OUT + seed) % 2**31,
            measures=names,
            limits=limits,
            fan=False,
        ),
    )
    past = [
        limit.margins(seen.measures[limit.measure].reshape(fresh, -1)[:, limit.index]) < 0
        for limit in seen.limits
    ]
    return seen, seen.failed | np.any(past, axis=0) if past else seen.failed


def _on_fresh(result, judge, distributions, limits, fresh, seed):
    """(summary, cloud, how many break a limit after tuning): fresh plants before and after tuning,
    the same draws on both sides.
    """
    names = tuple(dict.fromkeys([*judge.objective, "max_level"]))
    sides = [
        _run(case, distributions, limits, names, fresh, seed)
        for case in (result.case, result.tuned)
    ]
    costs = [
        sum(w * seen.measures[m].reshape(fresh, -1).sum(axis=1) for m, w in judge.objective.items())
        for seen, _ in sides
    ]
    held = np.stack([~past for _, past in sides], axis=1)
    levels = np.stack([seen.measures["max_level"] for seen, _ in sides], axis=1)
    failed = sides[0][0].failed | sides[1][0].failed
    spread = {n: getattr(d, "relative", None) for n, d in distributions.items()}
    noise = judge.lanes[0].key is not None
    found = summary_of(judge, np.stack(costs, axis=1), held, levels, failed, spread, noise)
    return *found, int((~held[:, 1]).sum())


def _support(result):
    """How many plants hold the answer in place: those at a limit, and for the worst case those at
    the largest cost.
    """
    held = {
        c["scenario"]
        for c, room in zip(result.constraints, result.problem.rooms)
        if c["margin"] < 1e-3 * room
    }
    if result.problem.risk != "mean":
        costs = np.array([result.problem.cost(row) for row in result.tables["after"]])
        share = result.problem.shares(costs, range(len(costs)))
        at = costs >= costs[share > 0].min() * (1 - 1e-4)
        held |= {result.problem.lanes[i].name for i in np.flatnonzero(at)}
    return len(held)
