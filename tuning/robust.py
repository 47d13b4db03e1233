"""Robust tuning: gains for many plants at once, and what can be promised of a plant that was not among them."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from jaxtank.errors import InputError
from jaxtank.presets.base import Scenario
from jaxtank.tree import split_index
from tuning.distributions import Draws
from tuning.ensemble import ensemble, probabilities, spread_of
from tuning.evidence import HELD_OUT
from tuning.search import tune

CONFIDENCE = 1e-6
"""Probability beta with which the scenario bound may fail [-]."""


class Certificate(NamedTuple):
    """What is known of a fresh plant: by the scenario theory before any is run, and by running some."""

    scenarios: int  # N plants that the search was held to
    support: int  # of those, how many hold the answer in place
    bound: float  # probability of breaking a limit, at most, with confidence 1 - 1e-6 (Campi, Garatti, Ramponi 2018)
    fresh: int  # plants run afterwards
    broken: int  # of those, how many broke a limit
    interval95: list  # Clopper and Pearson


def scenarios_of(case, distributions=None, samples=64, seed=0):
    """`samples` Scenarios of a case: each of its own in turn (its own run, where it has none) on a plant drawn from `distributions`, with
    noise of its own. Latin hypercube draws. Raises InputError for what cannot be drawn."""
    distributions = spread_of(case) if distributions is None else distributions
    space = Draws(case.loop, distributions)
    values = space.values(probabilities("latin", space.dimensions, samples, seed))
    base, found = case.scenarios or (Scenario("run"),), []
    for i in range(samples):
        own = base[i % len(base)]
        drawn = {n: v[i].tolist() for n, v in values.items()}
        set_here = {split_index(n)[0] for n in own.values}
        kept = {n: v for n, v in drawn.items() if split_index(n)[0] not in set_here}
        found.append(
            Scenario(f"plant {i + 1}", {**own.values, **kept}, seed=(own.seed + 7919 * (i + 1)) % 2**31, weight=own.weight)
        )
    return tuple(found)


def scenario_bound(scenarios, support, beta=CONFIDENCE):
    """Largest probability of breaking a limit, with confidence 1 - beta, of an answer that `support` of `scenarios` plants hold in place.

    eps(k) = 1 - (beta / (N C(N, k)))^(1 / (N - k)): M. C. Campi, S. Garatti, F. A. Ramponi, A general scenario theory for nonconvex
    optimization and decision making, IEEE TAC 63(12), 2018. It holds whatever the distribution and however the answer was found; the
    support is counted here as the plants at a limit or (for the worst case) at the cost, which is an estimate.
    """
    if not 0 <= support <= scenarios:
        raise InputError(f"support = {support}: must be from 0 to the {scenarios} scenarios")
    if support >= scenarios:
        return 1.0
    log = (
        math.log(beta)
        - math.log(scenarios)
        - (math.lgamma(scenarios + 1) - math.lgamma(support + 1) - math.lgamma(scenarios - support + 1))
    )
    return 1.0 - math.exp(log / (scenarios - support))


def tune_robust(case, distributions: Mapping[str, Any] | None = None, risk="mean", samples=64, fresh=1024, seed=0, **options):
    """`tune` on `samples` plants drawn from `distributions` (the case's own spread where None), every limit held on every plant.

    risk: "mean", "cvar" or "worst" of their costs; fresh: plants drawn afterwards, with seeds of their own, that the answer is run on;
    options: as in `tune`. Returns a TuningResult with a Certificate. Raises InputError as `tune` and `ensemble` do.
    """
    for name, value, low in (("samples", samples, 2), ("fresh", fresh, 1)):
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= 100_000:
            raise InputError(f"{name} = {value!r}: must be a whole number from {low} to 100000")
    distributions = spread_of(case) if distributions is None else dict(distributions)
    result = tune(case, scenarios=scenarios_of(case, distributions, samples, seed), risk=risk, seed=seed, **options)
    seen = ensemble(result.tuned, distributions, samples=fresh, key=HELD_OUT + seed, limits=options.get("limits"), fan=False)
    rows = np.array(
        [limit.sign * (seen.measures[limit.measure].reshape(fresh, -1)[:, limit.index] - limit.value) > 0 for limit in seen.limits]
    )
    broken = int(np.sum(seen.failed | rows.any(axis=0))) if len(rows) else int(seen.failed.sum())
    support = _support(result)
    interval = [float(v) for v in stats.binomtest(broken, fresh).proportion_ci(0.95, "exact")]
    certificate = Certificate(samples, support, scenario_bound(samples, support), fresh, broken, interval)
    words = (
        f"on {fresh} fresh plants a limit was broken {broken} times (95 % interval {interval[0]:.2g} to {interval[1]:.2g}); the scenario "
        f"theory bounds the probability by {certificate.bound:.2g} (N {samples}, support {support}, confidence 1 - 1e-6)"
    )
    return result.replace(certificate=certificate, message=f"{words}; {result.message}")


def _support(result):
    """How many plants hold the answer in place: those at a limit, and for the worst case those at the largest cost."""
    held = {c["scenario"] for c in result.constraints if c["margin"] < 1e-3 * max(abs(c["limit"]), 1.0)}
    if result.problem.risk != "mean":
        costs = np.array([result.problem.cost(row) for row in result.tables["after"]])
        share = result.problem.shares(costs, range(len(costs)))
        at = costs >= costs[share > 0].min() * (1 - 1e-4)
        held |= {result.problem.lanes[i].name for i in np.flatnonzero(at)}
    return len(held)
