"""Inputs as unknowns: what a run costs as a function of every voltage it is given, with the exact
gradient by checkpointed reverse mode.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank import measures as ms
from jaxtank.controllers import OpenLoop
from jaxtank.core.numerics import magnitude
from jaxtank.instruments import LevelSensor
from jaxtank.loop import run as lp
from jaxtank.loop.closed_loop import initial, inputs, run_of
from jaxtank.loop.step import step
from jaxtank.observers import Direct
from jaxtank.signals.base import Table

RUNNING = {m: ms.MEASURES[m].sense for m in ("max_level", "min_level", "max_error")}
"""Measures whose limit is held sample by sample: +1 for an upper limit, -1 for a lower one."""


class Terms(NamedTuple):
    """What is made small and what must hold: the part that is compiled in."""

    objective: tuple  # ((measure, weight), ...)
    squared: bool  # the square of the cost is searched: smooth where the cost is a root alone
    running: tuple  # ((measure, entry), ...) limits of RUNNING
    whole: tuple  # ((measure, entry), ...) limits of measures that are sums over the run


class Held(NamedTuple):
    """An augmented Lagrangian: values, multipliers and weight of the limits, and what the cost
    counts as 1.
    """

    scale: Any  # () cost, or its square, that counts as 1
    weight: Any  # () of a squared excess [-]
    running: Any  # (running,) values of the limits [cm]
    forces: Any  # (running,) tuple of (samples,) multipliers [-]
    whole: Any  # (whole,) values of the limits, in their measures' units
    pulls: Any  # (whole,) multipliers [-]
    room: Any  # ((running,), (whole,)) what an excess of each limit is a share of
    knees: Any  # (input [V], error [cm]) below which a search sees an absolute value as a parabola


def open_loop(loop, u, interval):
    """`loop` with its law replaced by the inputs u (pumps, intervals), each held for `interval`
    [s], and without sensor noise.
    """
    return dataclasses.replace(
        loop,
        controller=OpenLoop(signal=Table(values=u, period=interval)),
        observer=Direct(),
        sensor=LevelSensor(noise=np.zeros(loop.plant.tanks)),
        # inputs within the limits need no allocation
        actuator=(
            dataclasses.replace(loop.actuator, saturation="clip")
            if loop.actuator.allocates
            else loop.actuator
        ),
    )


def excess(terms, held, sample):
    """How far each running limit is passed at a sample, negative inside, as a share of its room
    [-].
    """
    found = []
    for j, (measure, i) in enumerate(terms.running):
        quantity = magnitude(sample.e[i]) if measure == "max_error" else sample.x[i]
        found.append(RUNNING[measure] * (quantity - held.running[j]) / held.room[0][j])
    return found


@functools.partial(jax.jit, static_argnames=("clock", "terms"))
def value_and_gradient(loop, clock, terms, u, held):
    """(search cost, its gradient (pumps, intervals)) of the inputs u of an open loop."""
    return jax.value_and_grad(_search_cost)(u, loop, clock, terms, held)


@functools.partial(jax.jit, static_argnames=("clock", "terms"))
def look(loop, clock, terms, u, held):
    """((running,) tuple of (samples,) excesses, (whole,) excesses, both as shares of their rooms,
    {measure: value}) of the inputs u.
    """
    loop = _with_inputs(loop, u)
    names = _names(terms)
    run = run_of(loop, clock)

    def body(carry, now):
        state, acc = carry
        state, sample = step(loop, clock, state, now)
        return (state, ms.update(run, acc, sample, now.context)), tuple(excess(terms, held, sample))

    (_, acc), over = lp.scan(
        body,
        (initial(loop, clock), ms.start(run, names)),
        inputs(loop, clock, names, None),
        clock.samples,
    )
    measures = ms.read(run, acc, names)
    return over, _whole(terms, held, measures), measures


def _search_cost(u, loop, clock, terms, held):
    loop = _with_inputs(loop, u)
    names = _names(terms)
    run, zero = run_of(loop, clock), jnp.zeros((), u.dtype)
    soft = {m for m, _ in terms.objective} & {"input_travel", "iae"}

    def body(carry, xs):
        state, acc, (before, travel, absolute), penalty = carry
        now, forces = xs
        state, sample = step(loop, clock, state, now)
        acc = ms.update(run, acc, sample, now.context)
        if "input_travel" in soft:
            change = sum(_soft(a - b, held.knees[0]) for a, b in zip(sample.u, before))
            travel, before = travel + jnp.where(state.k == 1, 0.0, change), sample.u
        if "iae" in soft:
            absolute = absolute + sum(_soft(e, held.knees[1]) for e in sample.e)
        for force, over in zip(forces, excess(terms, held, sample)):
            push = force + held.weight * over
            penalty = penalty + jnp.where(push > 0.0, push * push, 0.0)
        return (state, acc, (before, travel, absolute), penalty), None

    extra = ((zero,) * loop.plant.pumps if "input_travel" in soft else (), zero, zero)
    carry = (initial(loop, clock), ms.start(run, names), extra, zero)
    xs = (inputs(loop, clock, names, None), held.forces)
    _, acc, (_, travel, absolute), penalty = lp.checkpointed_scan(body, carry, xs, clock.samples)
    measures = ms.read(run, acc, names)
    smooth = {"input_travel": travel, "iae": absolute * clock.dt}
    cost = sum(w * (smooth[m] if m in smooth else jnp.sum(measures[m])) for m, w in terms.objective)
    total = (cost * cost if terms.squared else cost) / held.scale + 0.5 * penalty / (
        held.weight * clock.samples
    )
    for j, over in enumerate(_whole(terms, held, measures)):
        push = held.pulls[j] + held.weight * over
        total = total + 0.5 * jnp.where(push > 0.0, push * push, 0.0) / held.weight
    return total


def _whole(terms, held, measures):
    return [
        (jnp.ravel(measures[m])[i] - held.whole[j]) / held.room[1][j]
        for j, (m, i) in enumerate(terms.whole)
    ]


def _names(terms):
    return tuple(dict.fromkeys([*(m for m, _ in terms.objective), *(m for m, _ in terms.whole)]))


def _with_inputs(loop, u):
    signal = dataclasses.replace(loop.controller.signal, values=u)
    return dataclasses.replace(loop, controller=dataclasses.replace(loop.controller, signal=signal))


def _soft(x, knee):
    """|x|, a parabola near 0: sqrt(x^2 + knee^2) - knee."""
    return jnp.sqrt(x * x + knee * knee) - knee
