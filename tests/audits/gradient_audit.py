"""Gradients by audit: forward and reverse derivatives of what is public and differentiable against
central differences at random points.

    python tests/audits/gradient_audit.py            all of it (1,000 points, many minutes)
    python tests/audits/gradient_audit.py --quick    what the default test run does
    python tests/audits/gradient_audit.py law qp     subjects whose name has one of these words
    python tests/audits/gradient_audit.py --record   also keeps each subject's row in tests/data
    python tests/audits/gradient_audit.py --record --missing     those without a row

--record writes gradient_audit.json, and count and worst error to survived.json; where subjects are
named, the rows of the others stay, so that it can be done in pieces.

How a difference is judged. Every direction is scaled by the parameter itself, so steps and slopes
are relative. Central differences are taken at eight steps, each a quarter of the last, and
extrapolated pairwise (Richardson: fourth order). The step is chosen by the differences alone, where
three in a row agree best, never by the derivative that is judged. The error is relative to the
component's own slope, but not to less than 1e-3 of the largest slope of that component over the
points, nor 1e-6 of its value: below, differences of float64 say nothing.

Kinks. The samples of a run have hundreds of clips, absolute values and extremes; now and then one
lies within the steps, and a central difference is then the mean of two slopes. A derivative that
misses the central difference is therefore compared with the slopes of the left and of the right, of
smaller steps and each by itself (third order). Where these two agree with each other there is no
kink, and a miss is a miss. Where they do not, the derivative must be one of them ("kinks" in the
table: its error is the distance from the nearer) or lie between them ("between"), as numerics.py
has it at ties; anything else fails.

Several kinks at one point. Each rule of numerics.py takes a slope of its own kink, and the chain
rule joins them: where an empty rig starts at a setpoint of 0 cm, a pump rests at its limit (clip:
the slope inside) and moves by nothing (|u1 - u0|: slope 0), and the sum of both is no slope of the
sum, nor between its two. There is no better answer that is linear; a point where a subject is so by
construction names itself (`piled`). There a derivative may be outside, if a hair to the left and a
hair to the right it is the slope of that side; such slopes are counted by themselves ("piled").
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

DATA = Path(__file__).parents[1] / "data"

STEPS = 0.01 * 0.25 ** np.arange(8)
NEAR = 0.01 * 0.25 ** np.arange(2, 12)  # of one-sided differences: down to 2e-9
HAIR, BESIDE = (
    1e-7,
    1e-4,
    # beside several kinks: how far the derivative is looked at, and how near it must be: curvature
    # moves it by 1e-5
)
SIDES = 0.01
"""Share of the tolerance by which the slopes of both sides of several kinks must differ: those of
single kinks nearly cancel in some directions.
"""

TOLERANCE = 1e-6
FLOOR = 1e-3  # share of a component's largest slope below which an error is relative to that share
BOTH_WAYS = 1e-9  # forward against reverse,
ROUNDING = (
    16 * np.finfo(float).eps
    # but for this share of the point's largest slope: a slope of 0 is 1e-15 one way, on some
    # processors
)
# reverse mode is compared, not timed: half of the audit was its compilation
IN_HASTE = {"xla_backend_optimization_level": 0}


class Subject(NamedTuple):
    """A function and where it is audited."""

    name: str
    function: Callable  # (P,) -> (outputs,)
    points: np.ndarray  # (K, P)
    scales: np.ndarray  # (K, P) what counts as a change of 1 of each parameter
    directions: int | None = None  # random directions per point; None: every axis
    tolerance: float = TOLERANCE
    why: str = ""  # of another tolerance or floor
    floor: float = FLOOR
    # the same function for reverse mode, where that is another program
    backwards: Callable | None = None
    # (P,) -> (outputs, P): its forward derivatives, where a program of its own makes them
    forwards: Callable | None = None
    piled: tuple = ()  # points that lie on several kinks at once by construction


class Row(NamedTuple):
    """What an audit found."""

    name: str
    points: int
    slopes: int
    worst: float  # against differences
    step: float  # at which
    where: tuple  # (point, direction, output)
    ways: float  # forward against reverse
    finite: bool
    tolerance: float
    kinks: int = 0  # slopes beside a kink: equal to the left or the right one
    between: int = 0  # slopes on a kink: between the left and the right one
    # slopes on several kinks at once: outside, but right to the left and to the right
    piled: int = 0

    @property
    def good(self):
        return self.finite and self.worst < self.tolerance and self.ways < BOTH_WAYS


def audit(subject, seed=0):
    """A Row of one subject."""
    f, (count, size) = subject.function, subject.points.shape
    rng = np.random.default_rng(seed)
    if subject.directions is None:
        moves = subject.scales[:, None, :] * np.eye(size)
    else:
        moves = subject.scales[:, None, :] * rng.choice(
            [-1.0, 1.0], (count, subject.directions, size)
        )
    along = forwards(subject)
    forward = along(subject.points, moves)
    signs = np.array([1.0, -1.0])
    at = (
        subject.points[:, None, None, None, :]
        + moves[:, :, None, None, :] * STEPS[:, None, None] * signs[:, None]
    )
    run = jax.jit(jax.vmap(f))
    values = np.asarray(run(at.reshape(-1, size))).reshape(*at.shape[:4], -1)
    found, step = differences(values)
    size_of = np.abs(values).max(axis=(0, 1, 2, 3))
    least = np.maximum(subject.floor * np.abs(forward).max(axis=(0, 1)), 1e-6 * size_of) + 1e-300
    scale = np.maximum(np.maximum(np.abs(forward), np.abs(found)), least)
    rounding = ROUNDING * np.abs(forward).max(axis=(1, 2), keepdims=True)
    error, ways = np.abs(forward - found) / scale, np.inf
    for haste in (IN_HASTE, {}):  # on a kink another rounding is the other side's slope
        if not np.max(ways) < BOTH_WAYS:
            reverse = backwards(subject, moves, haste)
            ways = np.maximum(np.abs(forward - reverse) - rounding, 0.0) / scale
    finite = bool(
        np.isfinite(forward).all() and np.isfinite(reverse).all() and np.isfinite(values).all()
    )
    error, ways = (
        np.where(np.isfinite(error), error, np.inf),
        np.where(np.isfinite(ways), ways, np.inf),
    )
    kinks = between = piled = 0
    doubtful = error >= 0.1 * subject.tolerance
    pairs = np.argwhere(doubtful.any(axis=2))
    if pairs.size and finite:
        sides, steps = one_sided(in_batches(run, at.size // size), subject.points, moves, pairs)
        for (k, d), slopes, h in zip(pairs, sides, steps):
            miss = np.abs(slopes - forward[k, d]) / scale[k, d]
            apart = np.abs(slopes[0] - slopes[1]) / scale[k, d]
            low, high = slopes.min(axis=0), slopes.max(axis=0)
            for o in np.flatnonzero(doubtful[k, d]):
                side = miss[:, o].argmin()
                kinked = apart[o] >= subject.tolerance
                if miss[side, o] < min(error[k, d, o], subject.tolerance):
                    error[k, d, o], step[k, d, o] = miss[side, o], h[side, o]
                    kinks += kinked
                elif (
                    error[k, d, o] >= subject.tolerance
                    and kinked
                    and low[o] <= forward[k, d, o] <= high[o]
                ):
                    error[k, d, o], between = 0.0, between + 1
            if k in subject.piled and (error[k, d] >= subject.tolerance).any():
                beside = np.array(
                    [
                        along(subject.points + side * HAIR * moves[:, d], moves)[k, d]
                        for side in (-1.0, 1.0)
                    ]
                )
                right = (np.abs(beside - slopes) / scale[k, d] < BESIDE).all(axis=0) & (
                    apart >= SIDES * subject.tolerance
                )
                outside = right & (error[k, d] >= subject.tolerance)
                error[k, d], piled = np.where(outside, 0.0, error[k, d]), piled + int(outside.sum())
    where = np.unravel_index(error.argmax(), error.shape)
    at = tuple(int(i) for i in where)
    worst = float(error[where]), float(step[where]), at, float(ways.max())
    return Row(
        subject.name, count, forward.size, *worst, finite, subject.tolerance, int(kinks), between,
        piled,
    )  # fmt: skip


def backwards(subject, moves, options):
    """(points, directions, outputs) reverse derivatives of a subject, compiled with `options`."""
    slopes = jax.vmap(jax.jacrev(subject.backwards or subject.function))
    jacobian = jax.jit(slopes, compiler_options=options)(subject.points)
    return np.einsum("kop,kdp->kdo", np.asarray(jacobian), moves)


def forwards(subject):
    """(points, moves) -> (points, directions, outputs) forward derivatives of a subject."""
    if subject.forwards is None:
        found = jax.jit(
            jax.vmap(lambda x, v: jax.vmap(lambda w: jax.jvp(subject.function, (x,), (w,))[1])(v))
        )
        return lambda points, moves: np.asarray(found(points, moves))
    whole = jax.jit(jax.vmap(subject.forwards))
    return lambda points, moves: np.einsum("kop,kdp->kdo", np.asarray(whole(points)), moves)


def differences(values):
    """((points, directions, outputs) slopes, steps at which) of values (points, directions, steps,
    2, outputs).
    """
    central = (values[..., 0, :] - values[..., 1, :]) / (2 * STEPS[:, None])
    better = (16.0 * central[:, :, 1:] - central[:, :, :-1]) / 15.0
    apart = np.abs(np.diff(better, axis=2))
    calm = apart[:, :, :-1] + apart[:, :, 1:]
    best = calm.argmin(axis=2)
    return np.take_along_axis(better, best[:, :, None] + 1, axis=2)[:, :, 0], STEPS[best + 2]


def in_batches(run, size):
    """`run` of any number of points, `size` at a time: the program that is there already."""

    def of(points):
        short = -len(points) % size
        padded = np.concatenate([points, np.repeat(points[:1], short, axis=0)])
        found = [np.asarray(run(part)) for part in padded.reshape(-1, size, points.shape[1])]
        return np.concatenate(found)[: len(points)]

    return of


def one_sided(run, points, moves, pairs):
    """(pairs, left and right, outputs) slopes, and the steps at which, along `moves` of the (point,
    direction) `pairs`.
    """
    x, v = points[pairs[:, 0]], np.array([moves[k, d] for k, d in pairs])
    signs = np.array([-1.0, 1.0])
    at = x[:, None, None] + v[:, None, None] * (signs[:, None] * NEAR)[..., None]
    here, values = run(x), run(at.reshape(-1, x.shape[1])).reshape(*at.shape[:3], -1)
    first = (values - here[:, None, None]) / (signs[:, None] * NEAR)[..., None]
    second = (4.0 * first[:, :, 1:] - first[:, :, :-1]) / 3.0
    better = (16.0 * second[:, :, 1:] - second[:, :, :-1]) / 15.0
    apart = np.abs(np.diff(better, axis=2))
    best = (apart[:, :, :-1] + apart[:, :, 1:]).argmin(axis=2)
    return np.take_along_axis(better, best[:, :, None] + 1, axis=2)[:, :, 0], NEAR[best + 3]


def reported(rows):
    """The table and its last line: how many points, the worst error."""
    lines = [f"{'subject':44} points  slopes  worst     step      fwd=rev   kinks  between  piled"]
    for r in rows:
        mark = (
            ""
            if r.good
            else (
                "  FAILS at (point, direction, output)"
                f" {r.where}{'' if r.finite else ', not finite'}"
            )
        )
        found = f"{r.points:6d} {r.slopes:7d}  {r.worst:.1e}   {r.step:.0e}   {r.ways:.1e}"
        lines.append(f"{r.name:44} {found}   {r.kinks:5d}  {r.between:7d}  {r.piled:5d}{mark}")
    if rows:
        lines.append(f"{sum(r.points for r in rows)} points, {summed(rows)}")
    return "\n".join(lines)


def summed(rows, of=None):
    """What was found, in a line. of: how many subjects there are."""
    worst, failed = max(rows, key=lambda r: r.worst), [r.name for r in rows if not r.good]
    audited = f"{len(rows)} of {of}" if of else len(rows)
    beside, on, piled = (
        sum(getattr(r, kind) for r in rows) for kind in ("kinks", "between", "piled")
    )
    return (
        f"{sum(r.slopes for r in rows)} slopes of {audited} subjects: worst against differences"
        f" {worst.worst:.1e} ({worst.name}), forward against reverse"
        f" {max(r.ways for r in rows):.1e}; {beside} slopes beside a kink, {on} on one, {piled} on"
        " several at once;"
        f" {f'{len(failed)} fail: ' + ', '.join(failed) if failed else 'none fails'}"
    )


def recorded():
    """{subject: its row} of gradient_audit.json."""
    file = DATA / "gradient_audit.json"
    return json.loads(file.read_text()) if file.exists() else {}


def record(rows, known):
    """Keep `rows` beside those kept before of subjects that are still `known`; the sum of all goes
    to data/survived.json.
    """
    from jaxtank.core.files import write_atomic

    kept = recorded()
    kept = {n: kept[n] for n in known if n in kept} | {r.name: list(r[1:]) for r in rows}
    write_atomic(
        DATA / "gradient_audit.json",
        "{\n" + ",\n".join(f" {json.dumps(n)}: {json.dumps(r)}" for n, r in kept.items()) + "\n}\n",
    )
    survived = (
        json.loads((DATA / "survived.json").read_text())
        if (DATA / "survived.json").exists()
        else {}
    )
    found = [Row(n, *r) for n, r in kept.items()]
    survived["gradient audit"] = {
        "count": sum(r.points for r in found),
        "outcome": summed(found, len(known)),
    }
    write_atomic(DATA / "survived.json", json.dumps(survived, indent=1) + "\n")
    return found


def main(words):
    import jaxtank  # noqa: F401  (before jax starts)

    jax.config.update("jax_enable_x64", True)
    import audit_cases
    import audit_subjects

    known = {**audit_subjects.SUBJECTS, **audit_cases.SUBJECTS}
    chosen = {
        n: make for n, make in known.items() if n in audit_subjects.QUICK or "--quick" not in words
    }
    if "--missing" in words:
        chosen = {n: make for n, make in chosen.items() if n not in recorded()}
    wanted = [w for w in words if not w.startswith("-")]
    rows = []
    for name, make in chosen.items():
        if not wanted or any(w in name for w in wanted):
            rows.append(audit(make()))
            if "--record" in words:
                record(rows[-1:], known)
            print(reported(rows[-1:]).splitlines()[1], flush=True)
            # programs of a subject are not used again, and take gigabytes together
            jax.clear_caches()
    if "--record" in words:
        rows = record(rows, known)
    print(reported(rows).splitlines()[-1])
    return 0 if all(r.good for r in rows) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
