"""Gradients by audit: forward and reverse derivatives of what is public and differentiable against central differences at random points.

    python tests/gradient_audit.py            all of it (1,000 points and more; many minutes)
    python tests/gradient_audit.py --quick    what the default test run does
    python tests/gradient_audit.py law qp     subjects whose name has one of these words

How a difference is judged. Every direction is scaled by the parameter itself, so steps and slopes are relative. Central differences are
taken at eight steps, each a quarter of the last, and extrapolated pairwise (Richardson: fourth order). The step is chosen by the differences
alone, where three in a row agree best, never by the derivative that is judged. The error is relative to the component's own slope, but not to
less than 1e-3 of the largest slope of that component over the points, nor 1e-6 of its value: below, differences of float64 say nothing.
"""

import sys
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

STEPS = 0.01 * 0.25 ** np.arange(8)
TOLERANCE = 1e-6
BOTH_WAYS = 1e-9  # forward against reverse


class Subject(NamedTuple):
    """A function and where it is audited."""

    name: str
    function: Callable  # (P,) -> (outputs,)
    points: np.ndarray  # (K, P)
    scales: np.ndarray  # (K, P) what counts as a change of 1 of each parameter
    directions: int | None = None  # random directions per point; None: every axis
    tolerance: float = TOLERANCE
    why: str = ""  # of another tolerance
    backwards: Callable | None = None  # the same function for reverse mode, where that is another program


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
        moves = subject.scales[:, None, :] * rng.choice([-1.0, 1.0], (count, subject.directions, size))
    forward = jax.jit(jax.vmap(lambda x, v: jax.vmap(lambda w: jax.jvp(f, (x,), (w,))[1])(v)))(subject.points, moves)
    jacobian = jax.jit(jax.vmap(jax.jacrev(subject.backwards or f)))(subject.points)
    forward, reverse = np.asarray(forward), np.einsum("kop,kdp->kdo", np.asarray(jacobian), moves)
    signs = np.array([1.0, -1.0])
    at = subject.points[:, None, None, None, :] + moves[:, :, None, None, :] * STEPS[:, None, None] * signs[:, None]
    values = np.asarray(jax.jit(jax.vmap(f))(at.reshape(-1, size))).reshape(*at.shape[:4], -1)
    found, step = differences(values)
    size_of = np.abs(values).max(axis=(0, 1, 2, 3))
    least = np.maximum(1e-3 * np.abs(forward).max(axis=(0, 1)), 1e-6 * size_of) + 1e-300
    scale = np.maximum(np.maximum(np.abs(forward), np.abs(found)), least)
    error, ways = np.abs(forward - found) / scale, np.abs(forward - reverse) / scale
    finite = bool(np.isfinite(forward).all() and np.isfinite(reverse).all() and np.isfinite(values).all())
    error, ways = np.where(np.isfinite(error), error, np.inf), np.where(np.isfinite(ways), ways, np.inf)
    where = np.unravel_index(error.argmax(), error.shape)
    at = tuple(int(i) for i in where)
    worst = float(error[where]), float(step[where]), at, float(ways.max())
    return Row(subject.name, count, forward.size, *worst, finite, subject.tolerance)


def differences(values):
    """((points, directions, outputs) slopes, steps at which) of values (points, directions, steps, 2, outputs)."""
    central = (values[..., 0, :] - values[..., 1, :]) / (2 * STEPS[:, None])
    better = (16.0 * central[:, :, 1:] - central[:, :, :-1]) / 15.0
    apart = np.abs(np.diff(better, axis=2))
    calm = apart[:, :, :-1] + apart[:, :, 1:]
    best = calm.argmin(axis=2)
    return np.take_along_axis(better, best[:, :, None] + 1, axis=2)[:, :, 0], STEPS[best + 2]


def told(rows):
    """The table and its last line: how many points, the worst error."""
    lines = [f"{'subject':44} points  slopes  worst     step      fwd=rev"]
    for r in rows:
        mark = "" if r.good else f"  FAILS at (point, direction, output) {r.where}{'' if r.finite else ', not finite'}"
        lines.append(f"{r.name:44} {r.points:6d} {r.slopes:7d}  {r.worst:.1e}   {r.step:.0e}   {r.ways:.1e}{mark}")
    if rows:
        worst = max(rows, key=lambda r: r.worst)
        lines.append(
            f"{sum(r.points for r in rows)} points, {sum(r.slopes for r in rows)} slopes of {len(rows)} subjects: worst against differences "
            f"{worst.worst:.1e} ({worst.name}), forward against reverse {max(r.ways for r in rows):.1e}; {sum(not r.good for r in rows)} fail"
        )
    return "\n".join(lines)


def main(words):
    import jaxtank  # noqa: F401  (before jax starts)

    jax.config.update("jax_enable_x64", True)
    import audit_cases
    import audit_subjects

    if "--quick" in words:
        chosen = {n: make for n, make in audit_subjects.SUBJECTS.items() if n in audit_subjects.QUICK}
    else:
        chosen = {**audit_subjects.SUBJECTS, **audit_cases.SUBJECTS}
    wanted = [w for w in words if not w.startswith("-")]
    rows = []
    for name, make in chosen.items():
        if not wanted or any(w in name for w in wanted):
            rows.append(audit(make()))
            print(told(rows[-1:]).splitlines()[1], flush=True)
    print(told(rows).splitlines()[-1])
    return 0 if all(r.good for r in rows) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
