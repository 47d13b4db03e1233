"""Whether any limit of a case is broken in fewer plants than promised: its runs as margins."""

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.core.tree import is_real
from jaxtank.limits import UNDEFINED_MARGIN, Limit, limit_scale, without_overflow
from jaxtank.loop.derivatives import sensitivities_compiled
from jaxtank.xla.jit import compiled
from tuning.uncertainty.batches import batch_runner, in_batches
from tuning.uncertainty.distributions import Discrete, Empirical
from tuning.uncertainty.draws import Draws, entry_names
from tuning.uncertainty.sampling import clopper_pearson

FARTHEST = 7.0  # where a search ends: beyond lie 1e-12 of the plants [sd]
WIDE_RUNS, WIDE_SHARE = 256, 0.25  # of a wide normal distribution: first, later

LANES, STEPS = 32, 20  # searches at once, and their steps
RAY = 16  # runs between the origin and a failure that look for the first failure on the way
APART = 1.0  # least distance of two centres [sd]
CENTRES = 16  # most centres of a mixture

DEFENSIVE = 0.2  # share of runs of the distribution itself: bounds the weights

BATCH = 256  # runs after which the estimate is looked at

ACCURACY, FINEST = 0.07, 0.02  # variation of the probability: usual, undecided [-]

TURNS, FIRST_HITS = 4, 100  # most mixtures that are sampled, and failures to which one is fitted

FITTED, INFLATION = 0.7, 1.2  # share of fitted parts, factor of their variance [-]
LARGEST_SHARE, FEWEST_HITS = 0.1, 20  # of one run that gets a centre; failures
LEVEL_RUNS, KEPT_SHARE, LEVELS = 500, 0.1, 7  # of subset simulation


class Margins:
    """Margins (n, K) to limits at points (n, D) of the normal space, < 0 where broken; counted."""

    def __init__(self, judged: Callable, explored: Callable, slopes: Callable):
        self.of, self.runs, self.gradients = (judged, explored, slopes), 0, 0

    def judged(self, z: Any) -> Any:
        """Return the margins of runs with their own noise."""
        self.runs += len(z)
        return self.of[0](z)

    def explored(self, z: Any) -> Any:
        """Return the margins of the function that the searches look at."""
        self.runs += len(z)
        return self.of[1](z)

    def slopes(self, z: Any) -> Any:
        """Return ((n, K), (n, K, D)) of `explored` and its derivatives."""
        self.gradients += len(z)
        return self.of[2](z)


class Estimate(NamedTuple):
    """A probability by weighted runs."""

    probability: float
    interval95: tuple[float, float]
    variation: float  # coefficient of variation, inf without a failure [-]
    shares: Any  # (K,) share of the failures in which each limit is the one broken most
    plain: int  # runs that were drawn from the distribution itself


class Failures(NamedTuple):
    """What `probability` returns."""

    estimate: Estimate
    centres: Any  # (k, D) most likely failures, the nearest to the origin first
    runs: int
    gradients: int
    subset: float | None  # probability by subset simulation, where the slopes led nowhere


def probability(
    margins: Margins, pilot: Any, promise: float, most: int, seed: int, progress: Any = None
) -> Failures:
    """Return P(some margin < 0) after `pilot` (points, margins), in up to `most` more runs."""
    z, g = pilot
    estimate = _counted(g)
    if estimate.interval95[0] > promise and estimate.variation < FEWEST_HITS**-0.5:
        return Failures(estimate, _failing(z, g)[:1], 0, 0, None)
    rng, count, subset = np.random.default_rng([seed, 7]), margins, None
    wide = width(z.shape[1]) * rng.standard_normal((WIDE_RUNS, z.shape[1]))
    z, g = np.concatenate([z, wide]), np.concatenate([g, count.explored(wide)])
    centres = search(count, z, g)
    # plain runs without a failure that show the promise to be kept
    plain = np.ceil(np.log(0.025) / np.log1p(-promise))
    if not len(centres) and plain > 2 * LEVELS * LEVEL_RUNS:
        subset, failing = subset_simulation(count, z.shape[1], rng)
        if len(failing):
            centres = _pulled(count, failing)
    mixture, fitted = mixture_of(centres), False
    sample = Sample(mixture, len(pilot[0]))
    for turn in range(TURNS):
        last = turn == TURNS - 1
        enough = np.inf if fitted or last else FIRST_HITS
        if not sample.draw(count, promise, most, rng, enough, last, progress):
            break
        apart = mixture.apart(sample.hits, sample.weights)
        if np.any(apart):
            centres = _distinct(np.concatenate([centres, _refined(count, sample.hits[apart])]))
            mixture = mixture_of(centres)
        else:
            mixture, fitted = mixture.fitted(sample.hits, sample.weights), True
        sample = Sample(mixture, len(pilot[0]))
    return Failures(sample.estimate(), centres, count.runs, count.gradients, subset)


def _counted(g):
    """The Estimate of plain runs with margins g (n, K)."""
    n, worst = len(g), np.argmin(g, axis=1)[np.min(g, axis=1) < 0]
    hits, (low, high) = len(worst), clopper_pearson(len(worst), n)
    shares = np.bincount(worst, minlength=g.shape[1]) / max(hits, 1)
    variation = np.sqrt((1.0 - hits / n) / hits) if hits else np.inf
    return Estimate(hits / n, (low, high), float(variation), shares, n)


def width(dimensions: int) -> float:
    """Return the standard deviation [sd] that keeps most points within FARTHEST of the origin."""
    return max(1.3, min(2.0, 6.0 / np.sqrt(dimensions)))


class Mixture(NamedTuple):
    """Normal densities: around the origin, a wide one, and some around failures."""

    shares: Any  # (k,), of which the first is the least share of the distribution itself
    means: Any  # (k, D)
    factors: Any  # (k, D, D) lower Cholesky factors of the covariances

    def draw(self, n: int, rng: np.random.Generator) -> tuple[Any, int]:
        """Return (points (n, D), how many were drawn from the distribution itself)."""
        which = rng.choice(len(self.shares), size=n, p=self.shares)
        moves = rng.standard_normal((n, self.means.shape[1]))
        z = self.means[which] + np.einsum("nij,nj->ni", self.factors[which], moves)
        return z, int(np.sum(which == 0))

    def densities(self, z: Any) -> Any:
        """Return (n, k) densities at points z (n, D) over the standard normal one."""
        columns = []
        for share, mean, factor in zip(*self):
            back = scipy.linalg.solve_triangular(factor, (z - mean).T, lower=True)
            exponent = 0.5 * (np.sum(z**2, axis=1) - np.sum(back**2, axis=0))
            volume = np.prod(np.diag(factor))
            columns.append(share * np.exp(np.minimum(exponent, 700.0)) / volume)
        return np.stack(columns, axis=1)

    def apart(self, z: Any, weights: Any) -> Any:
        """Return which failures z (n, D) count much and are near to no part around failures."""
        near = np.sum(self.densities(z)[:, 2:], axis=1) * weights > 0.5
        return (weights > LARGEST_SHARE * np.sum(weights)) & ~near

    def fitted(self, z: Any, weights: Any) -> "Mixture":
        """Return the mixture fitted to failures z: means, and variances in their directions."""
        densities, shares = self.densities(z), self.shares.copy()
        parts = (weights / np.sum(densities, axis=1))[:, None] * densities
        means, factors, likely = list(self.means), list(self.factors), np.sum(parts, axis=0)
        for k in np.flatnonzero(likely > 1e-3 * np.sum(likely)):
            if k < 2:
                continue
            mean = parts[:, k] @ z / likely[k]
            along = mean / np.linalg.norm(mean)
            variance = parts[:, k] @ ((z - mean) @ along) ** 2 / likely[k]
            change = min(1.0, INFLATION * variance) - 1.0
            spread = np.eye(len(mean)) + change * np.outer(along, along)
            share = FITTED * np.sum(self.shares[2:]) * likely[k] / np.sum(likely[2:])
            shares[k] *= 1.0 - FITTED
            shares = np.append(shares, share)
            means.append(mean)
            factors.append(np.linalg.cholesky(spread))
        return Mixture(shares / np.sum(shares), np.array(means), np.array(factors))


def mixture_of(centres: Any) -> Mixture:
    """Return the Mixture around the origin and centres (k, D)."""
    k, n = np.shape(centres)
    if not k:
        return Mixture(np.ones(1), np.zeros((1, n)), np.eye(n)[None])
    likely = scipy.special.ndtr(-np.linalg.norm(centres, axis=-1))
    parts = 0.5 * likely / max(likely.sum(), 1e-300) + 0.5 / k
    shares = np.array([DEFENSIVE, WIDE_SHARE, *(1.0 - DEFENSIVE - WIDE_SHARE) * parts])
    sizes = np.where(np.arange(k + 2) == 1, width(n), 1.0)
    means = np.concatenate([np.zeros((2, n)), centres])
    return Mixture(shares / shares.sum(), means, sizes[:, None, None] * np.eye(n))


class Sample:
    """Runs at points of a Mixture: those that fail, with their weights."""

    def __init__(self, mixture: Mixture, plain: int):
        self.mixture, self.plain, self.runs = mixture, plain, 0
        self.hits: Any = np.zeros((0, mixture.means.shape[1]))
        self.worst: Any = np.zeros(0, dtype=int)
        self.limits = 1

    @property
    def weights(self) -> Any:
        """Weights of the failures, of the distribution over the mixture."""
        return 1.0 / np.sum(self.mixture.densities(self.hits), axis=1)

    def draw(self, count, promise, most, rng, enough, last, progress) -> bool:
        """Run batches until accurate or spent; return True where the mixture should be improved."""
        while True:
            self._run(count, rng)
            if progress is not None:
                progress(count.runs)
            w = self.weights
            alone = not last and len(w) >= FEWEST_HITS and np.any(self.mixture.apart(self.hits, w))
            if alone or len(w) >= enough:
                return True
            estimate = self.estimate()
            decided = not estimate.interval95[0] <= promise <= estimate.interval95[1]
            accurate = estimate.variation <= (ACCURACY if decided else FINEST)
            if accurate or (decided and not len(w)) or count.runs + BATCH > most:
                return False

    def _run(self, count, rng):
        z, direct = self.mixture.draw(BATCH, rng)
        g = count.judged(z)
        hit, self.limits = np.min(g, axis=1) < 0, g.shape[1]
        self.runs, self.plain = self.runs + BATCH, self.plain + direct
        self.hits = np.concatenate([self.hits, z[hit]])
        self.worst = np.append(self.worst, np.argmin(g[hit], axis=1))

    def estimate(self) -> Estimate:
        """Return the Estimate by the failures so far."""
        w = self.weights
        ends = interval(w / self.runs, 1.0 / (self.mixture.shares[0] * self.runs))
        total = max(np.sum(w), 1e-300)
        variation = float(np.sqrt(np.sum(w**2)) / total) if len(w) else np.inf
        shares = np.bincount(self.worst, w, self.limits) / total
        return Estimate(float(np.sum(w) / self.runs), ends, variation, shares, self.plain)


def interval(weights: Any, largest: float) -> tuple[float, float]:
    """Return the 95 % interval of a sum of weights (Fay and Feuer), `largest` of uncounted ones."""
    total, square = float(np.sum(weights)), float(np.sum(weights**2))
    chi2 = lambda p, freedom: 2.0 * float(scipy.special.gammaincinv(freedom / 2.0, p))
    low = square / (2 * total) * chi2(0.025, 2 * total**2 / square) if total else 0.0
    weight = float(np.max(weights)) if total else largest
    total, square = total + weight, square + weight**2
    high = float(square / (2 * total) * chi2(0.975, 2 * total**2 / square))
    return low, min(1.0, high)


def search(count: Any, z: Any, g: Any) -> Any:
    """Return (k, D) most likely failures, the nearest first; (z, g): runs to begin from."""
    starts, limits = _starts(z, g)
    return _pulled(count, np.concatenate([_nearest(count, starts, limits), _failing(z, g)]))


def _refined(count, z):
    """Most likely failures near failures z."""
    g = count.explored(z)
    return _pulled(count, np.concatenate([_nearest(count, z, np.argmin(g, axis=1)), z]))


def _failing(z, g):
    """Runs that fail, of each limit the nearest to the origin, the nearest of all first."""
    broken, size = g < 0, np.linalg.norm(z, axis=1)
    nearest = np.argmin(np.where(broken, size[:, None], np.inf), axis=0)[np.any(broken, axis=0)]
    return z[nearest[np.argsort(size[nearest], kind="stable")]]


def _starts(z, g):
    """(points (n, D), limits (n,)): the origin, nearest failures, and others in new directions."""
    size, rows = np.linalg.norm(z, axis=1), []
    for limit in np.argsort(np.min(g, axis=0), kind="stable")[: LANES // 3]:
        cost = np.where(g[:, limit] < 0, size - 1e6, g[:, limit])
        first = np.argmin(cost)
        beside = z @ z[first] > 0.5 * size * size[first]
        rows += [(np.zeros(z.shape[1]), limit), (z[first], limit)]
        rows.append((z[np.argmin(np.where(beside, np.inf, cost))], limit))
    points, limits = zip(*rows)
    return np.array(points), np.array(limits)


@np.errstate(all="ignore")  # slopes may be 0 or infinite
def _nearest(count, z, limits):
    """Points (n, D) at which the margins to `limits` (n,) are 0, nearest to the origin."""
    rows = np.arange(len(z))

    def slopes(z):
        g, s = count.slopes(z)
        g, s = g[rows, limits], s[rows, limits]
        size = np.sum(s**2, axis=1)
        usable = np.isfinite(g) & np.isfinite(size) & (size > 0)
        step = ((np.sum(s * z, axis=1) - g) / size)[:, None] * s - z
        long = np.linalg.norm(step, axis=1, keepdims=True)
        step = np.where(usable[:, None], step * np.minimum(1.0, 3.0 / long), 0.0)
        return g, np.sqrt(size), np.nan_to_num(step)

    g, size, step = slopes(z)
    share = np.ones(len(z))
    for _ in range(STEPS):
        active = (np.linalg.norm(share[:, None] * step, axis=1) > 0.05) & (share > 1 / 64)
        if not np.any(active):
            break
        trial = z + share[:, None] * step
        trial = trial * np.minimum(1.0, FARTHEST / np.linalg.norm(trial, axis=1, keepdims=True))
        new = slopes(trial)
        weight = 2.0 * np.linalg.norm(z + step, axis=1) / size + 1.0 / size
        merit = lambda z, g, w=weight: 0.5 * np.sum(z**2, axis=1) + w * np.abs(g)
        better = active & (merit(trial, new[0]) < merit(z, g))
        z = np.where(better[:, None], trial, z)
        g, size = np.where(better, new[0], g), np.where(better, new[1], size)
        step = np.where(better[:, None], new[2], step)
        share = np.where(better, 1.0, 0.5 * share)
    return z


def _pulled(count, z):
    """Centres: the first failures on the rays from the origin through z (n, D) and a little on."""
    z = _distinct(z[np.linalg.norm(z, axis=1) > 0.0])
    if not len(z):
        return z
    shares = 1.1 * np.arange(1, RAY + 1) / RAY
    rays = z[:, None] * shares[:, None]
    g = count.explored(rays.reshape(-1, z.shape[1]))
    failed = (np.min(g, axis=1) < 0).reshape(len(z), RAY)
    first = np.argmax(failed, axis=1)
    return _distinct(rays[np.arange(len(z)), first][np.any(failed, axis=1)])


def _distinct(z):
    """Points that lie apart, the nearest to the origin first."""
    centres: list[Any] = []
    for point in z[np.argsort(np.linalg.norm(z, axis=1), kind="stable")]:
        apart = all(np.linalg.norm(point - other) > APART for other in centres)
        if apart and len(centres) < CENTRES:
            centres.append(point)
    return np.array(centres).reshape(-1, z.shape[1])


def subset_simulation(count: Any, dimensions: int, rng: np.random.Generator) -> tuple[float, Any]:
    """Return (probability, points that fail); 0 and none where no level reaches a failure."""
    z = rng.standard_normal((LEVEL_RUNS, dimensions))
    g, share, seeds = np.min(count.explored(z), axis=1), 1.0, int(KEPT_SHARE * LEVEL_RUNS)
    for _ in range(LEVELS):
        order = np.argsort(g, kind="stable")
        level = g[order[seeds - 1]]
        if level < 0 or g[order[0]] == level:  # reached, or flat
            break
        share, z, g = share * KEPT_SHARE, z[order[:seeds]], g[order[:seeds]]
        chains = [(z, g)]
        for _ in range(LEVEL_RUNS // seeds - 1):
            moved = 0.8 * z + 0.6 * rng.standard_normal(z.shape)  # keeps the normal distribution
            new = np.min(count.explored(moved), axis=1)
            inside = new <= level
            z, g = np.where(inside[:, None], moved, z), np.where(inside, new, g)
            chains.append((z, g))
        z, g = (np.concatenate(parts) for parts in zip(*chains))
    return share * float(np.mean(g < 0)), z[g < 0]


PILOT = 4096  # most draws of the study that the search for failures begins from
FURTHER = 100  # most runs after the draws of the study, in numbers of them [-]
CLIPPED = 1e-12  # least and, below 1, largest probability at which a distribution is read [-]
BEYOND = 8.0  # where every value of a distribution is passed, CLIPPED [sd]
STEP = 1e-4  # step of the differences of drawn values in the standard normal space [sd]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Promise:
    """The estimated probability that any limit is broken, and the promised upper bound."""

    promise: float
    answer: str  # "kept", "not kept" by the interval, or "undecided" if it contains the promise
    probability: float
    interval95: tuple[float, float]
    coefficient_of_variation: float | None  # of the probability; None where no run broke a limit
    limits: dict[str, float]  # {limit: share of the failures that break it most}, largest first
    # the most likely, nearest first: {"distance" [standard deviations], "values": {name: value}}
    failures: list[dict[str, Any]]
    runs: int  # the draws of the study among them
    gradients: int  # runs with derivatives
    unseen: float  # 95 % upper bound on the probability of failures unlike all plain draws
    subset_simulation: float | None  # estimate, if the search by gradients found no failure
    cut: float | None  # where the first normal distribution is cut [standard deviations]


def check_promise(case: Case, promise: Any, limits: Any, distributions: Any) -> None:
    """Raise InputError unless `promise` is None, or a probability of breaking one of `limits`."""
    if promise is None:
        return
    if not (is_real(promise) and np.ndim(promise) == 0 and 0 < promise < 1):
        raise InputError(f"promise = {promise!r}: must be a probability above 0 and below 1")
    for name, d in distributions.items():
        if isinstance(d, Empirical):
            raise InputError(
                f"promise = {promise:g}: {name} has {len(d.draws)} draws and no tail: give a"
                " distribution, or leave it out for the [covariance] of the rig"
            )
    if not limits:
        raise InputError(
            f"promise = {promise:g}: {case.name} has no limit that could be broken; state one, as"
            " --limit max_level=rim"
        )


class Study(NamedTuple):
    """Runs of a case at points of the standard normal space."""

    case: Case
    space: Draws
    limits: tuple[Limit, ...]
    measures: tuple[str, ...]
    noise: int | None  # seed of the sensor noise
    seed: int
    batch: int

    def explored(self) -> "Study":
        """Return the study in which a level can be seen to pass a rim."""
        loop = without_overflow(self.case.loop)
        if loop is self.case.loop:
            return self
        rim = np.asarray(loop.plant.rim, dtype=float)
        spills = lambda v: v.measure == "overflow_volume"
        level = lambda v: Limit("max_level", v.index, float(rim[v.index]), name=v.name)
        limits = tuple(level(v) if spills(v) else v for v in self.limits)
        measures = tuple(dict.fromkeys(limit.measure for limit in limits))
        return self._replace(case=self.case.replace(loop=loop), limits=limits, measures=measures)

    def values(self, z: Any) -> dict[str, Any]:
        """Return {name: (n, ...)} at points z (n, D)."""
        return self.space.values(np.clip(scipy.special.ndtr(z), CLIPPED, 1.0 - CLIPPED))

    def margins(self, measures: Any, failed: Any) -> Any:
        """Return (n, K) margins, each divided by its scale, of measures {name: (n, ...)}."""
        columns = [
            limit.margins(np.reshape(measures[limit.measure], (len(failed), -1))[:, limit.index])
            / limit_scale(limit, self.case.loop)
            for limit in self.limits
        ]
        return np.where(failed[:, None], -UNDEFINED_MARGIN, np.stack(columns, axis=1))

    def at(self, run: Any, z: Any, first: int) -> Any:
        """Return (n, K) margins of runs at z (n, D), with the noise of draws `first` and on."""
        size = self.batch

        def inputs(k):
            rows = np.minimum(np.arange(k * size, (k + 1) * size), len(z) - 1)
            return self.values(z[rows]), first + np.arange(k * size, (k + 1) * size)

        batches = dict(run(range(-(-len(z) // size)), inputs, size))
        parts = [batches[k] for k in sorted(batches)]
        joined = {n: np.concatenate([part[n] for part in parts])[: len(z)] for n in batches[0]}
        return self.margins(joined, joined.pop("failed") > 0)

    def slopes(self, z: Any) -> Any:
        """Return ((n, K) margins, (n, K, D) their slopes) at z (n, D), LANES points at once."""
        values = self.values(z)
        columns = []
        for move in STEP * np.eye(z.shape[1]):
            ends = (_flat(self.values(z + sign * move)) for sign in (1.0, -1.0))
            columns.append(np.subtract(*ends) / (2.0 * STEP))
        moving, jacobian = self.moving(), np.stack(columns, axis=-1)
        moving = moving if len(moving) else np.arange(1)  # a slope of 0
        order = tuple(_entries(values)[i] for i in moving)
        fixed = self.noise, self.case.clock, self.measures, order
        run = lambda rows: _sensitivities(self.case.loop, tuple(rows.T), *fixed)
        measures, rates, failed = in_batches(run, LANES, _flat(values)[:, moving])
        slopes = []
        for limit in self.limits:
            rate = rates[limit.measure].reshape(len(z), -1, len(order))[:, limit.index]
            slopes.append(-limit.sign / limit_scale(limit, self.case.loop) * rate)
        slopes = np.einsum("nkp,npd->nkd", np.stack(slopes, axis=1), jacobian[:, moving])
        return self.margins(measures, failed), slopes

    def moving(self) -> Any:
        """Return which entries of the drawn values differ from plant to plant."""
        n, parts = self.space.dimensions, (part[1] for part in self.space.parts)
        places = [p for d in parts if isinstance(d, Discrete) for p in d.places()]
        z = np.concatenate([[-BEYOND, BEYOND], scipy.special.ndtri(places)])[:, None] * np.ones(n)
        # the axes: the parts of a correlated value can cancel each other
        flat = _flat(self.values(np.concatenate([z, BEYOND * np.eye(n)])))
        return np.flatnonzero(np.any(flat != flat[0], axis=0))


def _flat(values):
    """(n, entries) of {name: (n, ...)}."""
    return np.concatenate([np.reshape(v, (len(v), -1)) for v in values.values()], axis=1)


def _entries(values):
    """Dotted name of each column of `_flat`."""
    return [n for name, v in values.items() for _, n in entry_names(name, np.shape(v)[1:])]


@compiled("clock", "names", "order", "seed", keep=True)
def _sensitivities(loop, rows, seed, clock, names, order):
    """(measures, their slopes by `order`, whether diverged) of runs at `rows`, same noise."""
    key = None if seed is None else jax.random.key(seed)

    def run(values):
        return sensitivities_compiled(loop, clock, names, order, values, key, (), True)

    measures, slopes, _, diverged = jax.vmap(run)(rows)
    return measures, slopes, diverged


def promise_of(study, promise, points, table, failed, devices, cluster, progress):
    """Return the Promise of a study, after the draws at `points` with the measures `table`."""
    if promise is None:
        return None
    explored, drawn = study.explored(), min(len(failed), PILOT)
    z = scipy.special.ndtri(points.rows(0, drawn))
    pilot = z, study.margins({m: table[m][:drawn] for m in study.measures}, failed[:drawn])
    used = len(failed)

    def runs(of, run):
        def margins(z):
            nonlocal used
            used += len(z)
            return of.at(run, z, used - len(z))

        return margins

    runner = lambda of: batch_runner(of.case, of.measures, study.noise, devices, cluster)
    with runner(study) as run, contextlib.ExitStack() as stack:
        other = run if explored is study else stack.enter_context(runner(explored))
        margins = Margins(runs(study, run), runs(explored, other), explored.slopes)
        report = progress and (lambda done: progress(done + len(failed)))
        most = FURTHER * len(failed)
        result = probability(margins, pilot, promise, most, study.seed, report)
    estimate, (low, high) = result.estimate, result.estimate.interval95
    cuts = [d.cut for _, d, *_ in study.space.parts if hasattr(d, "cut")]
    shares = sorted(zip(estimate.shares, study.limits), key=lambda pair: -pair[0])
    return Promise(
        promise=promise,
        answer="kept" if high < promise else "not kept" if low > promise else "undecided",
        probability=estimate.probability,
        interval95=(low, high),
        coefficient_of_variation=estimate.variation if np.isfinite(estimate.variation) else None,
        limits={limit.label: float(share) for share, limit in shares if share > 0},
        failures=_failures(study, result.centres),
        runs=len(failed) + result.runs + result.gradients,
        gradients=result.gradients,
        unseen=float(-np.expm1(np.log(0.05) / estimate.plain)),
        subset_simulation=result.subset,
        cut=min(cuts, default=None),
    )


def _failures(study, centres):
    """{"distance", "values"} of centres (k, D)."""
    if not len(centres):
        return []
    values, moving = study.values(centres), study.moving()
    names, flat = _entries(values), _flat(values)
    return [
        {"distance": float(np.linalg.norm(z)), "values": {names[j]: float(row[j]) for j in moving}}
        for z, row in zip(centres, flat)
    ]
