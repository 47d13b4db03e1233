"""The columns of a sensitivity study, and exact derivatives as one way to fill them."""

from typing import NamedTuple, cast

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.errors import NonFiniteError
from jaxtank.core.tree import get_value, with_values
from jaxtank.loop import run as lp
from tuning.problem.slopes import contradicted
from tuning.uncertainty.distributions import Correlated, Discrete, Normal

CHUNK = 16
"""Parameters whose derivatives are computed at once."""

NORMAL_WIDTH = 2.0
"""Half-width of a normal distribution, in standard deviations [-]."""


UNUSABLE = (
    "a derivative is not finite, or runs contradict it by orders of magnitude, as in a chaotic or"
    " exploding loop"
)


class Column(NamedTuple):
    """The sensitivity of one entry of one measure to every parameter."""

    measure: str
    label: str
    unit: str
    nominal: float  # value of the case's own run, NaN where it has none
    not_finite: int  # runs of the study in which it is no finite number
    effects: dict
    reason: str  # why some or all indices are absent, "" where none is
    empty: bool = False  # no parameter has an index


def entries_of(case, names):
    """Return [(measure, label, unit)] of every entry of the measures, counted from 1."""
    found = []
    for m in names:
        per = ms.MEASURES[m].per
        for i in range(ms.entries(m, case.loop.plant)):
            found.append(
                (m, m if per == "run" else f"{m} of {per} {i + 1}", ms.unit(m, case.loop.units))
            )
    return found


def local_columns(case, draws, names, key, progress=None):
    """Return the Columns by derivatives at the case's own values, and {parameter: half-width}."""
    widths = half_widths(draws)
    scalars = list(dict.fromkeys(name for width in widths for name in width))
    nominal, derivatives = _derivatives(case, scalars, names, key, progress)
    width = {name: w for width in widths for name, w in width.items()}
    steps = np.array([width[name] for name in scalars])
    derivatives = _borne_out(case, scalars, steps, names, key, nominal, derivatives)
    where = {name: i for i, name in enumerate(scalars)}
    effect = [sum(derivatives[:, where[n]] * w for n, w in width.items()) for width in widths]
    effect = np.stack(effect, axis=1)
    alone = [next(iter(width)) if len(width) == 1 else None for width in widths]
    absent = np.full(len(nominal), np.nan)
    single = np.stack([derivatives[:, where[n]] if n else absent for n in alone], axis=1)
    own = np.array([float(get_value(case.loop, n)) if n else np.nan for n in alone])
    elasticity = single * own / np.where(nominal == 0, np.nan, nominal)[:, None]
    effects = {"effect": effect, "derivative": single, "elasticity": elasticity}
    half = [next(iter(w.values())) if len(w) == 1 else list(w.values()) for w in widths]
    return _columns(case, names, nominal, effects), dict(zip(draws.labels, half))


def _columns(case, names, nominal, effects):
    """The Columns of (K,) nominal entries and {quantity: (K, D)}."""
    columns = []
    for k, (measure, label, unit) in enumerate(entries_of(case, names)):
        row = {quantity: values[k] for quantity, values in effects.items()}
        good = bool(np.isfinite(row["effect"]).all())
        reason = "" if good else UNUSABLE
        columns.append(Column(measure, label, unit, float(nominal[k]), int(not good), row, reason))
    return columns


def _derivatives(case, scalars, names, key, progress):
    """(K,) entries of the measures and (K, scalars) their derivatives, CHUNK scalars at once."""
    found, measures = [], {}
    for start in range(0, len(scalars), CHUNK):
        chunk = scalars[start : start + CHUNK]
        values = {name: float(get_value(case.loop, name)) for name in chunk}
        measures, rates, _, diverged = lp.sensitivities(case.loop, case.clock, names, values, key)
        if diverged:
            raise NonFiniteError(
                f"{case.name}: a level stops being finite at the case's own values, so there are no"
                " derivatives"
            )
        rows = [np.asarray(rates[m]).reshape(-1, len(values)) for m in names]
        found.append(np.concatenate(rows))
        if progress is not None:
            progress(min(start + CHUNK, len(scalars)), len(scalars))
    nominal = np.concatenate([np.ravel(measures[m]) for m in names])
    return nominal, np.concatenate(found, axis=1)


def _borne_out(case, scalars, steps, names, key, nominal, derivatives):
    """Return derivatives (K, scalars), NaN where runs contradict them."""
    # Runs are made by a step to either side for each scalar by which some entry would change by
    # more than itself.
    sizes = np.abs(nominal)
    large = ~(np.abs(derivatives * steps) <= sizes[:, None])
    found = derivatives.copy()
    for j in np.flatnonzero(large.any(axis=0)):
        moves, value = np.array([1.0, -1.0]) * steps[j], float(get_value(case.loop, scalars[j]))
        rows = []
        for to in value + moves:
            loop = with_values(case.loop, {scalars[j]: to})
            measures, broken = lp.evaluate_and_flag(loop, case.clock, names, key)
            run = np.concatenate([np.ravel(measures[m]) for m in names])
            rows.append(run * np.nan if broken else run)
        wrong = contradicted(moves[:, None] * derivatives[:, j], np.array(rows) - nominal, sizes)
        found[wrong, j] = np.nan
    return found


def half_widths(draws):
    """Return for each dimension {name of a scalar that it moves: half-width}."""
    found = []
    for name, d, nominal, _ in draws.parts:
        if isinstance(d, Correlated):
            found += [
                {one: NORMAL_WIDTH * float(np.sqrt(d.covariance[i][i]))}
                for i, one in enumerate(d.names)
            ]
            continue
        width = _half_width(d, nominal) + np.zeros(nominal.shape)
        if nominal.ndim == 0:
            found.append({name: abs(float(width))})
            continue
        entries = {
            f"{name}[{','.join(map(str, i))}]": float(width[i]) for i in np.ndindex(nominal.shape)
        }
        found += (
            [entries]
            if d.tied
            else [{one: abs(w)} for one, w in entries.items() if one in draws.labels]
        )
    return found


def _half_width(d, nominal):
    if isinstance(d, Normal):
        return min(NORMAL_WIDTH, d.cut) * (
            cast(float, d.sd) if d.relative is None else d.relative * np.abs(nominal)
        )
    if isinstance(d, Discrete):
        return 0.5 * (max(d.values) - min(d.values))
    return 0.5 * (
        d.quantile(np.ones(nominal.shape), nominal) - d.quantile(np.zeros(nominal.shape), nominal)
    )
