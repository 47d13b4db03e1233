"""The integration error of a run, estimated from the same run with half the step."""

import dataclasses
from typing import Any

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.labels import entry_label, input_unit, label_of, labels_of
from jaxtank.loop import step_size
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.run import evaluate_and_flag
from jaxtank.loop.saved_rows import simulate_compiled

MAX_ERROR = 5.0
"""Error of a level above which a run is refused, in `step_size.visible_heights` (1 %) [-]."""
LASTING = 0.25
"""Share of a run over which a level near a tip or a pump's suction must differ by that [-]."""
LISTED = 0.01
"""Share by which a measure must differ to be listed [-]."""
MOST = 4
"""Measures that are listed, those that differ most."""


def halving_warnings(loop: ClosedLoop, clock: Clock, key: jax.Array | None) -> list[str]:
    """One sentence on what half the step changes, or [] where nothing visible changes."""
    unstable = list(step_size.unstable_tanks(loop, clock))
    narrow = list(step_size.narrow_tanks(loop, clock))
    sources = sorted({i for _, i, share in step_size.pump_draws(loop, clock) if share > 1.0})
    if not (unstable or narrow or sources):
        return []
    finer = dataclasses.replace(clock, substeps=2 * clock.substeps)
    (run, broken), (half, _) = (simulate_compiled(loop, c, key, 1) for c in (clock, finer))
    if bool(broken):
        return []  # reported by the run itself
    step_size.check_run(loop, clock, run)
    x, apart = np.asarray(run.x), np.abs(np.asarray(run.x) - np.asarray(half.x))
    visible = step_size.visible_heights(loop, x)
    errors = apart.max(axis=0) / visible
    tank, length = int(np.argmax(errors)), loop.units[0]
    time = float(run.t[np.argmax(apart[:, tank])])
    if not errors[tank] > 1.0:
        return []
    sentence = (
        f"with half the step, {0.5 * clock.dt / clock.substeps:g} s, the level of"
        f" {label_of(loop.plant, 'tank', tank)}"
        f" differs by {apart[:, tank].max():.3g} {length} at t = {time:g} s"
    )
    by_unstable = bool(unstable) and tank not in {*narrow, *sources}
    # near a tip a level falls within a step: one that differs for a moment is no wrong run
    lasting = np.quantile(apart[:, tank], 1.0 - LASTING) / visible[tank]
    if (errors[tank] if by_unstable else lasting) > MAX_ERROR:
        remedy = "halve clock.dt, or double clock.substeps, and again where needed"
        tanks = [tank]
        if by_unstable:
            remedy = max(unstable, key=lambda item: item.height).remedy
            tanks = [item.tank for item in unstable]
        raise InputError(
            f"clock.dt = {clock.dt:g} s: steps too long to follow"
            f" {labels_of(loop.plant, 'tank', tanks)}, near empty: {sentence}: {remedy}"
        )
    if not by_unstable:
        sentence += (
            f" ({_places(loop, narrow, sources)} a step takes more liquid than there is: halve the"
            " step, by clock.substeps or clock.dt, until this note is gone)"
        )
    inputs = np.abs(np.asarray(run.u) - np.asarray(half.u)).max(axis=0)
    pump = int(np.argmax(inputs))
    sentence += (
        f", the input of {label_of(loop.plant, 'pump', pump)} by {inputs[pump]:.3g}"
        f" {input_unit(loop.plant, pump, loop.units[1])}".removesuffix(" -")
    )
    return [", ".join([sentence, *_changed(loop, clock, finer, key)])]


def _places(loop: ClosedLoop, narrow: list[int], sources: list[int]) -> str:
    """The parts of tanks from which a step may take too much, for a message."""
    places: list[str] = []
    if narrow:
        places.append(f"near the tip of {labels_of(loop.plant, 'tank', narrow)}")
    if sources:
        tanks = labels_of(loop.plant, "tank", sources)
        places.append(f"near the bottom of {tanks}, from which a pump draws,")
    return " and ".join(places)


def _changed(loop: ClosedLoop, clock: Clock, finer: Clock, key: Any) -> list[str]:
    """Return up to MOST phrases, largest relative change first: "rms_error of output 1 is ..."."""
    names = tuple(m for m in ms.placed("summary") if ms.serves(m, loop))
    values, half = (evaluate_and_flag(loop, c, names, key)[0] for c in (clock, finer))
    differences: list[tuple[float, str]] = []
    for name in names:
        pairs = np.column_stack([np.ravel(values[name]), np.ravel(half[name])])
        for i, (value, better) in enumerate(pairs):
            size = max(abs(value), abs(better))
            if np.isfinite(size) and size > 0.0 and abs(value - better) > LISTED * size:
                per, unit = ms.MEASURES[name].per, ms.unit(name, loop.units)
                of = entry_label(loop.plant, name, per, i)
                unit = "" if unit == "-" else f" {unit}"
                words = f"{of} is {better:.3g}{unit} in place of {value:.3g}{unit}"
                differences.append((abs(value - better) / size, words))
    return [words for _, words in sorted(differences, reverse=True)[:MOST]]
