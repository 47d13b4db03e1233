"""Robust tuning: gains for many plants at once, and the violation probability on new plants."""

import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.rig import check_limits
from tuning.cluster.engine import connect
from tuning.problem.functions import as_measures
from tuning.problem.problem import Problem
from tuning.search.result import Message, TuningResult
from tuning.search.setting import scenarios_of
from tuning.search.tuner import tune
from tuning.uncertainty.distributions import stated
from tuning.uncertainty.sampling import clopper_pearson, spread_of
from tuning.uncertainty.study import ensemble
from tuning.uncertainty.validation import SEED_OFFSET, summary_of, validate
from tuning.views import Shown

CONFIDENCE = 1e-6  # probability beta with which the scenario bound may fail [-]

TOLERANCE = 1e-4
"""Change of the objective, as a share of its first value, at which a search over drawn plants has
converged: their mean is itself known to a few percent only [-].
"""


class Certificate(NamedTuple):
    """The violation probability of a new plant: a bound before any is run, and an estimate by runs.

    Examples
    --------
    >>> known = Certificate(64, 1, round(scenario_bound(64, 1), 3), 1024, 3, [0.0006, 0.0085])
    >>> known.bound, known.broken / known.fresh
    (0.296, 0.0029296875)
    """

    scenarios: int  # N plants in the search
    support: int  # of those, the support scenarios
    # probability of breaking a limit, at most, with confidence 1 - 1e-6 (Campi, Garatti, Ramponi
    # 2018)
    bound: float
    fresh: int  # new plants run afterwards
    broken: int  # of those, how many violated a limit
    interval95: list  # Clopper and Pearson

    _repr_html_ = Shown._repr_html_
    _sections = Shown._sections
    __str__ = Shown.__str__

    def _rows(self):
        low, high = self.interval95
        return {
            "plants of the search": self.scenarios,
            "support scenarios": self.support,
            "scenario bound": f"{self.bound:.2g} (confidence 1 - {CONFIDENCE:g})",
            "new plants": self.fresh,
            "new plants that violate a limit": self.broken,
            "probability of violating a limit": f"{low:.2g} to {high:.2g} (95 % interval)",
        }


def scenario_bound(scenarios, support, beta=CONFIDENCE):
    """Return the largest violation probability of an answer, with confidence 1 - beta."""
    # eps(k) = 1 - (beta / (N C(N, k)))^(1 / (N - k)): M. C. Campi, S. Garatti, F. A. Ramponi, A
    # general scenario theory for nonconvex optimization and decision making, IEEE TAC 63(12), 2018.
    # It holds for any distribution and any way to find the answer, for independent plants and the
    # support by which the same answer is found. What is counted here are the plants at a limit and
    # (for the worst case) at the cost: for the mean, and in part for cvar, every plant changes the
    # gains a little; strictly, the support is then all of them and the bound 1, and this figure is
    # an indication. Latin hypercube draws are not independent either. The runs on new plants are
    # the evidence.
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
    cluster: Any = None,
    **options: Any,
) -> TuningResult:
    """Return the result of `tune` on `samples` drawn plants, every limit held on every plant.

    Parameters
    ----------
    case : the Case.
    distributions : {name: distribution or share}; the case's own spread where None.
    risk : "mean", "cvar" or "worst" of the costs of the plants.
    samples : plants in the search.
    fresh : new plants drawn afterwards, with seeds of their own, on which the values before and
        after are run.
    seed : of the draws, the Sobol points and the sensor noise.
    back_off : constraint tightening, as a share of each limit [-]: the search keeps that far inside
        each limit, while new plants are judged by the limit itself. A limit that is active on one
        of N plants is violated on about one new plant in N + 1.
    tolerance, options : as in `tune`.
    validation : runs of a case that has scenarios of its own, 0 for none (any other is validated on
        the new plants).
    cluster : Dask cluster on which the local searches and the new plants run, as in `tune`.

    Returns
    -------
    TuningResult, with a Certificate.

    Raises
    ------
    InputError : as `tune` and `ensemble`.

    Examples
    --------
    >>> import tuning
    >>> from jaxtank import presets
    >>> case = presets.find("gouta2015/backstepping")
    >>> tuning.tune_robust(case, samples=16, back_off=0.03).certificate  # doctest: +SKIP
    """
    _check(samples, fresh, back_off)
    objective, limits = as_measures(options.get("objective"), options.get("limits"))
    options |= {"objective": objective, "limits": limits}
    distributions = spread_of(case) if distributions is None else stated(distributions)
    limits = check_limits(case.loop, case.limits if limits is None else limits)
    options["limits"] = _tightened(case, limits, back_off)
    plants = scenarios_of(case, distributions, samples, seed)
    with connect(cluster) as engine:
        options |= {"seed": seed, "tolerance": tolerance, "validation": 0, "cluster": engine}
        result = tune(case, scenarios=plants, risk=risk, **options)
        judge = Problem(case, options.get("free"), objective, limits, None, seed)
        run = functools.partial(_run, distributions, limits, fresh, seed, engine)
        # what is certified is the case's own run, what the answer is judged by is its scenarios
        if case.scenarios:
            broken = int(run(result.tuned, ())[1].sum())
        else:
            *found, broken = _on_new_plants(result, judge, run, distributions)
    if case.scenarios:
        found = (None, None)
        if validation and result.status != "interrupted":
            values = {n: p["after"] for n, p in result.parameters.items()}
            found = validate(judge, judge.own_values(), values, validation, seed)
    support = _support(result)
    interval = clopper_pearson(broken, fresh)
    certificate = Certificate(
        samples, support, scenario_bound(samples, support), fresh, broken, interval
    )
    return result.replace(
        certificate=certificate,
        validation=found[0],
        cloud=found[1],
        messages=(*certificate_messages(certificate, risk, back_off), *result.messages),
    )


def _check(samples, fresh, back_off):
    """Raise InputError for a number of plants or a tightening that is out of range."""
    for name, value, low in (("samples", samples, 2), ("fresh", fresh, 1)):
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= 100_000:
            raise InputError(f"{name} = {value!r}: must be a whole number from {low} to 100000")
    number = isinstance(back_off, (int, float)) and not isinstance(back_off, bool)
    if not number or not 0.0 <= back_off < 1.0:
        raise InputError(
            f"back_off = {back_off!r}: must be a share of each limit, from 0 to below 1"
        )


def certificate_messages(known: Certificate, risk: str, back_off: float) -> tuple[Message, ...]:
    """Return the Messages of a Certificate: what was measured, and what was to be expected."""
    low, high = known.interval95
    indication = (
        ""
        if risk == "worst"
        else f", an indication: plants at no limit change the {risk} too, and are not counted in it"
    )
    found = [
        Message(
            "limit-violated-out-of-sample" if known.broken else "limits-hold-out-of-sample",
            f"on {known.fresh} new plants a limit was violated {known.broken} times (95 % interval"
            f" {low:.2g} to {high:.2g})",
        ),
        Message(
            "scenario-bound",
            f"by scenario theory, the probability is at most {known.bound:.2g} (confidence 1 -"
            f" 1e-6, support {known.support} of {known.scenarios} plants{indication})",
        ),
    ]
    if back_off:
        found.append(
            Message(
                "constraints-tightened",
                f"the search tightened every limit by {100 * back_off:g} %, new plants are judged"
                " by the limits themselves",
            )
        )
    elif known.broken and known.support:
        expected = 100 * known.support / (known.scenarios + 1)
        found.append(
            Message(
                "support-scenarios",
                f"{known.support} of {known.scenarios} plants determine the answer: up to about"
                f" {expected:.2g} % of new plants were to be expected past a limit (more plants or"
                " a constraint tightening, --back-off 0.03, reduce both)",
            )
        )
    return tuple(found)


def _tightened(case, limits, share):
    """Return `limits` tightened by `share` of each, the rim being that of the plant."""
    if not share:
        return limits
    rim = np.asarray(case.loop.plant.rim).tolist()
    values = {
        m: np.asarray(rim if isinstance(v, str) else v, dtype=float) for m, v in limits.items()
    }
    return {m: (v - share * ms.MEASURES[m].sense * np.abs(v)).tolist() for m, v in values.items()}


def _run(distributions, limits, fresh, seed, cluster, case, names):
    """Return (Ensemble of new plants, (fresh,) True where one violates a limit or diverges)."""
    found = ensemble(
        case,
        distributions,
        samples=fresh,
        key=(SEED_OFFSET + seed) % 2**31,
        measures=names,
        limits=limits,
        fan=False,
        cluster=cluster,
    )
    past = [
        limit.margins(found.measures[limit.measure].reshape(fresh, -1)[:, limit.index]) < 0
        for limit in found.limits
    ]
    return found, found.failed | np.any(past, axis=0) if past else found.failed


def _on_new_plants(result, judge, run, distributions):
    """Return (summary, cloud, how many violate a limit after tuning) on new plants."""
    names = tuple(dict.fromkeys([*judge.objective, "max_level"]))
    sides = [run(case, names) for case in (result.case, result.tuned)]
    weights = judge.objective.items()
    costs = [
        sum(w * found.measures[m].reshape(found.samples, -1).sum(axis=1) for m, w in weights)
        for found, _ in sides
    ]
    held = np.stack([~past for _, past in sides], axis=1)
    levels = np.stack([found.measures["max_level"] for found, _ in sides], axis=1)
    failed = sides[0][0].failed | sides[1][0].failed
    spread = {n: getattr(d, "relative", None) for n, d in distributions.items()}
    noise = judge.runs[0].key is not None
    found = summary_of(judge, np.stack(costs, axis=1), held, levels, failed, spread, noise)
    return *found, int((~held[:, 1]).sum())


def _support(result):
    """Return how many plants determine the answer: at a limit or, by risk, at the largest cost."""
    held = {
        c.scenario
        for c, scale in zip(result.constraints, result.problem.limit_scales)
        if c.margin < 1e-3 * scale
    }
    if result.problem.risk != "mean":
        costs = np.array([result.problem.cost(row) for row in result.tables["after"]])
        share = result.problem.shares(costs, range(len(costs)))
        at = costs >= costs[share > 0].min() * (1 - 1e-4)
        held |= {result.problem.runs[i].name for i in np.flatnonzero(at)}
    return len(held)
