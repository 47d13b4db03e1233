"""Every case of `jaxtank list` as a subject of the audit: a short run from levels of every kind, by
every leaf of the loop at once.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from audit_subjects import scales_of
from gradient_audit import Subject
from jax.flatten_util import ravel_pytree
from jax.tree_util import GetAttrKey

from jaxtank import presets, rig
from jaxtank.controllers import NMPC
from jaxtank.core.tree import parameters, with_values
from jaxtank.loop import run as lp
from jaxtank.loop.derivatives import sensitivities_compiled
from jaxtank.signals.setpoints import Ramps

MEASURES = (
    *("mean_square_error", "iae", "rms_input", "input_travel", "saturation_excess", "max_level"),
    "min_level",
)
SAMPLES = 64
"""A square: reverse mode then has no rest to compile."""
STARTS = ("near", "far", "dry", "empty", "equal", "full", "over", "zero")
CORNER = (
    "an interior point rounds a corner off over 1e-6 of the data; a solution of one sample lies on"
    " it, between the slopes of both sides"
)
COARSE = {
    "khalid/laguerre-constrained": (1e-3, CORNER),
    "khalid/laguerre-mimo-constrained": (1e-3, CORNER),
    "khalid/gpc-mimo-constrained": (1e-2, CORNER),
}
"""{case: (tolerance, why)} where differences, or the run, are good to less."""
JUMPS = {
    "mirakhorli/smc-printed": (
        "zero",
        "its sign function is 0 at exactly 0 and jumps by 4 V on either side: no slope there",
    )
}
"""{case: (a kind of start, why)} that is left out."""
TIED = dict.fromkeys(
    ("mirakhorli/hybrid", "mirakhorli/hybrid-fitted"),
    "the law's limits and the pumps' are both 0 V: moved apart, they are a kink of every sample"
    " at rest",
)
"""{case: why} every point lies on several kinks at once."""


def start(kind, rng, loop):
    """(n,) levels at t = 0 of a kind."""
    plant = loop.plant
    rim, x0 = np.asarray(plant.rim, dtype=float), np.asarray(loop.x0, dtype=float)
    x = {
        "near": np.clip(x0 * rng.uniform(0.8, 1.2, x0.size), 0.05 * rim, 0.9 * rim),
        "far": rim * rng.uniform(0.1, 0.9, x0.size),
        "dry": rim * rng.uniform(0.1, 0.9, x0.size),
        "empty": plant.knee * rng.uniform(0.1, 1.5, x0.size),
        # a kink of many: pumps rest exactly at their limit, tanks exactly at their bottom
        "zero": 0.0,
        "equal": rim * rng.uniform(0.2, 0.8),
        "full": rim * rng.uniform(0.97, 1.0, x0.size),
        "over": rim * rng.uniform(1.01, 1.05, x0.size),
    }[kind] * np.ones(x0.size)
    if kind == "dry":
        x[rng.integers(x0.size)] = rng.uniform(0, 0.9) * plant.knee
    return x


def short(name):
    """The case with a run of SAMPLES, without noise: changes of the setpoint come at once, and a
    delay is of ten samples, for there is no time to wait for them.
    """
    case = presets.find(name)
    dt = max(case.clock.dt, 0.05)  # 64 samples of 0.01 s are too short for the levels to move
    changes = {"clock.dt": dt, "clock.duration": (SAMPLES - 1) * dt}
    if case.loop.actuator.delay:
        changes |= {"actuator.delay": 10 * dt, "sensor.noise": 0.0}
    if isinstance(case.loop.controller, NMPC):  # with limits of its own, above those of the pumps
        changes["controller.low"] = np.full(case.loop.plant.pumps, 0.2)
    reference = case.loop.reference
    if isinstance(reference, Ramps):
        soon = tuple((10.0 * dt, i) for _, i in reference.changes[:2])
        reference = dataclasses.replace(
            reference, changes=soon, targets=np.asarray(reference.targets)[:2], ramp=20.0 * dt
        )
        case = case.replace(loop=dataclasses.replace(case.loop, reference=reference))
    return rig.set_values(case, changes)


def within(path, value):
    """A value that may have left its range: the share of a pump that its first tank gets."""
    return np.minimum(value, 0.99) if path[-1] == GetAttrKey("split") else value


def points_of(loop, rng, kinds):
    """(points, scales) of one case, one of each kind of start."""
    points, scales = [], []
    for kind in kinds:
        here = jax.tree.map(
            lambda a: np.asarray(a, dtype=float) * (1.0 + 0.02 * rng.standard_normal(np.shape(a))),
            loop,
        )
        here = jax.tree_util.tree_map_with_path(within, here)
        here = dataclasses.replace(here, x0=start(kind, rng, loop))
        points.append(np.asarray(ravel_pytree(here)[0]))
        moved = scales_of(
            dataclasses.replace(here, x0=np.maximum(here.x0, 0.01 * np.asarray(loop.plant.rim)))
        )
        quiet = jax.tree.map(np.ones_like, here)  # no key, no noise: its leaf stays where it is
        quiet = dataclasses.replace(
            quiet, sensor=dataclasses.replace(quiet.sensor, noise=np.zeros_like(here.sensor.noise))
        )
        scales.append(moved * np.asarray(ravel_pytree(quiet)[0]))
    return points, scales


def subject(names, seed=0):
    """The Subject of cases that differ in their numbers alone: one program, points of each."""
    cases, rng = [short(name) for name in names], np.random.default_rng(seed)
    loop, clock = cases[0].loop, cases[0].clock
    kinds = tuple(kind for kind in STARTS if kind != JUMPS.get(names[0], ("",))[0])
    points, scales = (
        np.concatenate(column)
        for column in zip(*(points_of(case.loop, rng, kinds) for case in cases))
    )
    unravel = ravel_pytree(jax.tree.map(lambda a: np.asarray(a, dtype=float), loop))[1]

    def value(run, theta):
        found = run(unravel(theta), clock, MEASURES)
        found = found[0] if isinstance(found, tuple) else found
        return jnp.concatenate([jnp.ravel(found[m]) for m in MEASURES])

    tolerance, why = COARSE.get(names[0], (1e-5, "runs of 64 samples amplify rounding"))
    return Subject(
        label(names),
        functools.partial(value, lp.evaluate_and_flag),
        points,
        scales,
        directions=6,
        tolerance=tolerance,
        why=why,
        backwards=functools.partial(value, lp.evaluate_for_reverse),
        piled=tuple(
            i for i in range(len(points)) if names[0] in TIED or kinds[i % len(kinds)] == "zero"
        ),
    )


def label(names):
    return f"case {names[0]}" + (f" and {len(names) - 1} more" if len(names) > 1 else "")


def groups():
    """Names of cases, those together whose short runs are one program."""
    found = {}
    for paper in presets.PAPERS:
        for name in presets.load(paper).cases:
            case = short(f"{paper}/{name}")
            sizes = tuple(np.shape(a) for a in jax.tree.leaves(case.loop))
            found.setdefault((paper, jax.tree.structure(case.loop), sizes, case.clock), []).append(
                f"{paper}/{name}"
            )
    return list(found.values())


def carried(name, batch):
    """The derivatives that the tuner carries along with a run (`loop.sensitivities`), which are not
    those of jax.jvp; `lanes`: as it makes them for several runs side by side.
    """
    case, rng = short(name), np.random.default_rng(0)
    loop, clock = case.loop, case.clock
    own = {
        n: v
        for n, v in parameters(loop).items()
        if n.startswith("controller.") and not n.startswith("controller.model.")
    }
    values = own | {n: parameters(loop)[n] for n in ("plant.drain", "x0")}
    points = [
        {
            n: np.asarray(v, dtype=float) * (1.0 + 0.02 * rng.standard_normal(np.shape(v)))
            for n, v in values.items()
        }
        | {"x0": start(kind, rng, loop)}
        for kind in STARTS
    ]
    order = tuple(values)
    unravel = ravel_pytree([points[0][n] for n in order])[1]
    flat = lambda found: jnp.concatenate([jnp.ravel(found[m]) for m in MEASURES])
    at = lambda theta: with_values(loop, dict(zip(order, unravel(theta))))

    def forwards(theta):
        slopes = sensitivities_compiled(
            loop, clock, MEASURES, order, unravel(theta), None, batched=batch
        )[1]
        return jnp.concatenate([slopes[m].reshape(-1, theta.size) for m in MEASURES])

    return Subject(
        f"sensitivities {name}{', lanes' if batch else ''}",
        lambda theta: flat(lp.evaluate_and_flag(at(theta), clock, MEASURES)[0]),
        np.array([ravel_pytree([p[n] for n in order])[0] for p in points]),
        np.array(
            [
                scales_of([np.maximum(p[n], 0.01) if n == "x0" else p[n] for n in order])
                for p in points
            ]
        ),
        tolerance=1e-5,
        why="runs of 64 samples amplify rounding",
        backwards=lambda theta: flat(lp.evaluate_for_reverse(at(theta), clock, MEASURES)),
        forwards=forwards,
        piled=(STARTS.index("zero"),),
    )


GROUPS = {label(names): names for names in groups()}
SUBJECTS = {title: functools.partial(subject, names) for title, names in GROUPS.items()} | {
    f"sensitivities {name}{', lanes' if batch else ''}": functools.partial(carried, name, batch)
    for name in (
        "gouta2015/ngpc",
        "gouta2022/chadpc",
        "calofir/backstepping",
        "mirakhorli/hybrid",
        "khalid/gpc",
    )
    for batch in (False, True)
}
