"""Robust tuning: gains for many plants at once, and the violation probability on new plants."""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case, check_case
from jaxtank.core.errors import InputError
from jaxtank.limits import tightened
from jaxtank.rig import check_limits
from tuning.cluster.engine import connect
from tuning.problem.functions import as_measures
from tuning.problem.pairing import check_signs
from tuning.problem.problem import Problem
from tuning.problem.tracking import lost_runs
from tuning.search.messages import messages_of
from tuning.search.options import Options, check_numbers, check_precision, options_of
from tuning.search.result import TuningResult
from tuning.search.setting import scenarios_of
from tuning.search.tuner import TOLERANCE, tune
from tuning.uncertainty.sampling import clopper_pearson, varied
from tuning.uncertainty.study import ensemble
from tuning.uncertainty.validation import SEED_OFFSET, summary_of, validate
from tuning.views import Shown

CONFIDENCE = 1e-6  # probability beta with which the scenario bound may fail [-]


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
    bound: float  # probability of breaking a limit (Campi, Garatti, Ramponi 2018)
    fresh: int  # new plants run afterwards
    broken: int  # of those, how many violated a limit
    interval95: list  # Clopper and Pearson
    back_off: float = 0.0  # constraint tightening of the search, as a share of each limit

    _repr_html_ = Shown._repr_html_
    _sections = Shown._sections
    __str__ = Shown.__str__

    def to_json(self):
        """Return the numbers on plants."""
        return {n: v for n, v in self._asdict().items() if n != "back_off"}

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
    # Campi, Garatti, Ramponi, IEEE TAC 63(12), 2018: eps(k) = 1 - (beta/(N C(N, k)))^(1/(N - k)).
    # For the mean and cvar every plant moves the gains a little: then this is an indication only.
    if not 0 <= support <= scenarios:
        raise InputError(f"support = {support}: must be from 0 to the {scenarios} scenarios")
    if support >= scenarios:
        return 1.0
    log = math.log(beta / scenarios) - math.log(math.comb(scenarios, support))
    return 1.0 - math.exp(log / (scenarios - support))


def tune_robust(
    case: Case,
    distributions: Mapping[str, Any] | None = None,
    risk: str = "mean",
    samples: int = 64,
    fresh: int = 1024,
    seed: int = 0,
    back_off: float = 0.0,
    method: str | Options = "auto",
    *,
    free: Mapping[str, Any] | None = None,
    objective: Any = None,
    limits: Any = None,
    **options: Any,
) -> TuningResult:
    """Return the result of `tune` on `samples` drawn plants, every limit held on every plant.

    Parameters
    ----------
    case, free, objective, limits : as in `tune`.
    distributions : {name: distribution or share}; the case's own spread where None.
    risk : "mean", "cvar" or "worst" of the costs of the plants.
    samples : plants in the search.
    fresh : new plants drawn afterwards, with other seeds, on which the values before and
        after are run.
    seed : of the draws, the Sobol points and the sensor noise.
    back_off : constraint tightening, as a share of each limit [-]: the search keeps that far inside
        each limit, while new plants are judged by the limit itself. A limit that is active on one
        of N plants is violated on about one new plant in N + 1.
    method : as in `tune`; tolerance is 1e-4 where Options have none. Their `validation` are runs of
        a case with scenarios (any other is validated on the new plants).
    options : starts, checkpoint, resume and progress of `tune`.

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
    check_case(case, seed)
    check_numbers(low=2, samples=samples)
    check_numbers(fresh=fresh)
    number = isinstance(back_off, (int, float)) and not isinstance(back_off, bool)
    if not number or not 0.0 <= back_off < 1.0:
        raise InputError(
            f"back_off = {back_off!r}: must be a share of each limit, from 0 to below 1"
        )
    check_signs(case, free)
    check_precision()
    chosen = options_of(method).filled(tolerance=TOLERANCE, validation=64)
    objective, limits = as_measures(objective, limits)
    distributions, _ = varied(case, distributions)
    limits = check_limits(case.loop, case.limits if limits is None else limits)
    if len(case.scenarios) > samples:
        raise InputError(
            f"samples = {samples}: must be at least the number of scenarios of the case,"
            f" {len(case.scenarios)}"
        )
    plants = scenarios_of(case, distributions, samples, seed)
    with connect(chosen.cluster) as engine:
        inside = _tightened(case, limits, back_off)
        problem = Problem(case, free, objective, inside, plants, seed, risk)
        result = tune(problem, dataclasses.replace(chosen, validation=0, cluster=engine), **options)
        judge = Problem(case, free, objective, limits, None, seed)
        run = functools.partial(_run, distributions, limits, fresh, seed, engine)
        # the certificate is for the run of the case, the answer is judged on its scenarios
        summary = cloud = None
        if case.scenarios:
            broken = int((~run(result.tuned, ()).held).sum())
        else:
            summary, cloud, broken = _on_new_plants(result, judge, run, distributions)
    if case.scenarios and chosen.validation and result.status != "interrupted":
        values = {n: p["after"] for n, p in result.parameters.items()}
        summary, cloud = validate(judge, judge.own_values(), values, chosen.validation, seed)
    support, interval = _support(result), clopper_pearson(broken, fresh)
    bound = scenario_bound(samples, support)
    certificate = Certificate(samples, support, bound, fresh, broken, interval, float(back_off))
    result = result.replace(certificate=certificate, validation=summary, cloud=cloud)
    return result.replace(messages=messages_of(result))


def _tightened(case, limits, share):
    """Return `limits` tightened by `share` of each; "rim" is the rim of the plant."""
    amounts = {}
    for measure, value in limits.items():
        value = case.loop.plant.rim if isinstance(value, str) else value
        entries = ms.entries(measure, case.loop.plant)
        sizes = share * np.abs(np.broadcast_to(np.asarray(value, dtype=float), (entries,)))
        amounts |= {(measure, i): float(size) for i, size in enumerate(sizes)}
    return tightened(case.loop.plant, limits, amounts)


def _run(distributions, limits, fresh, seed, cluster, case, names):
    """Return the Ensemble of new plants."""
    options = {"measures": names, "limits": limits, "fan": False, "cluster": cluster}
    return ensemble(case, distributions, samples=fresh, key=(SEED_OFFSET + seed) % 2**31, **options)


def _on_new_plants(result, judge, run, distributions):
    """Return (summary, cloud, how many violate a limit after tuning) on new plants."""
    tracked = [name for name in ms.TRACKED if ms.serves(name, judge.loop)]
    names = tuple(dict.fromkeys([*judge.objective, "max_level", *tracked]))
    sides = [run(case, names) for case in (result.case, result.tuned)]
    weights = judge.objective.items()
    costs = [
        sum(w * plants.measures[m].reshape(plants.samples, -1).sum(axis=1) for m, w in weights)
        for plants in sides
    ]
    holds = np.stack([plants.held for plants in sides], axis=1)
    levels = np.stack([plants.measures["max_level"] for plants in sides], axis=1)
    failed = sides[0].failed | sides[1].failed
    spread = {n: getattr(d, "relative", None) for n, d in distributions.items()}
    noise = judge.runs[0].key is not None
    costs = np.stack(costs, axis=1)
    lost = [lost_runs(judge.loop, plants.measures, plants.failed) for plants in sides]
    astray = np.stack(lost, axis=1)
    summary = summary_of(judge.limits, costs, holds, levels, failed, spread, noise, astray)
    return *summary, int((~holds[:, 1]).sum())


def _support(result):
    """Return how many plants determine the answer: at a limit or, by risk, at the largest cost."""
    scaled = zip(result.constraints, result.problem.limit_scales)
    support = {c.scenario for c, scale in scaled if c.margin < 1e-3 * scale}
    if result.problem.risk != "mean":
        costs = np.array([result.problem.cost(row) for row in result.tables["after"]])
        share = result.problem.shares(costs, range(len(costs)))
        least = costs[share > 0].min()
        at = costs >= least - 1e-4 * abs(least)
        support |= {result.problem.runs[i].name for i in np.flatnonzero(at)}
    return len(support)
