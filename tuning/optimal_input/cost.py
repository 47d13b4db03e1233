"""The cost of a run as a function of every input; its gradient by checkpointed reverse mode."""

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
from jaxtank.loop.closed_loop import initial, inputs, run_of
from jaxtank.loop.step import step
from jaxtank.observers import Direct
from jaxtank.signals.base import Table
from jaxtank.xla.hoist import checkpointed_scan, scan

POINTWISE = {m: ms.MEASURES[m].sense for m in ("max_level", "min_level", "max_error")}
"""Measures whose limit is held at every sample: +1 for an upper limit, -1 for a lower one."""


class Terms(NamedTuple):
    """Terms of the cost and of the limits: static, part of the compiled program."""

    objective: tuple  # ((measure, weight), ...)
    squared: bool  # whether the square of the cost is minimised: smooth where the cost is a root
    pointwise: tuple  # ((measure, entry), ...) limits of POINTWISE
    integral: tuple  # ((measure, entry), ...) limits of measures that are sums over the run


class Lagrangian(NamedTuple):
    """Augmented Lagrangian: limits, multipliers, weight, and the scale of the cost."""

    scale: Any  # () of the cost, or of its square
    weight: Any  # () of a squared excess [-]
    pointwise: Any  # (pointwise,) values of the limits [cm]
    multipliers: Any  # (pointwise,) tuple of (samples,) multipliers [-]
    integral: Any  # (integral,) values of the limits, in their measures' units
    integral_multipliers: Any  # (integral,) multipliers [-]
    sizes: Any  # ((pointwise,), (integral,)) of which an excess is a share
    smoothing: Any  # (input [V], error [cm]) below which an absolute value is a parabola


def scaled(lagrangian, ratio):
    return lagrangian._replace(
        multipliers=tuple(f * ratio for f in lagrangian.multipliers),
        integral_multipliers=lagrangian.integral_multipliers * ratio,
    )


def open_loop(loop, u, interval):
    """Return `loop` with the inputs u (pumps, intervals) in place of its controller."""
    actuator = loop.actuator
    if actuator.allocates:  # inputs within the limits need no allocation
        actuator = dataclasses.replace(actuator, saturation="clip")
    return dataclasses.replace(
        loop,
        controller=OpenLoop(signal=Table(values=u, period=interval)),
        observer=Direct(),
        sensor=LevelSensor(noise=np.zeros(loop.plant.tanks)),
        actuator=actuator,
    )


def _pointwise_excess(terms, lagrangian, sample):
    """Return the excess over each pointwise limit at a sample, as a share of its size [-]."""
    excesses = []
    for j, (measure, i) in enumerate(terms.pointwise):
        quantity = magnitude(sample.e[i]) if measure == "max_error" else sample.x[i]
        excess = quantity - lagrangian.pointwise[j]
        excesses.append(POINTWISE[measure] * excess / lagrangian.sizes[0][j])
    return excesses


def _integral_excess(terms, lagrangian, measures):
    """Return the excess over each integral limit, as a share of its size [-]."""
    return [
        (jnp.ravel(measures[m])[i] - lagrangian.integral[j]) / lagrangian.sizes[1][j]
        for j, (m, i) in enumerate(terms.integral)
    ]


@functools.partial(jax.jit, static_argnames=("clock", "terms"))
def value_and_gradient(loop, clock, terms, u, lagrangian):
    """Return (search cost, gradient (pumps, intervals)) of the inputs u of an open loop."""
    return jax.value_and_grad(_search_cost)(u, loop, clock, terms, lagrangian)


@functools.partial(jax.jit, static_argnames=("clock", "terms"))
def evaluate(loop, clock, terms, u, lagrangian):
    """Return the excesses and the measures of the inputs u."""
    loop = _with_inputs(loop, u)
    names = _names(terms)
    run = run_of(loop, clock)

    def body(carry, now):
        state, acc = carry
        state, sample = step(loop, clock, state, now)
        acc = ms.update(run, acc, sample, now.context)
        return (state, acc), tuple(_pointwise_excess(terms, lagrangian, sample))

    carry = (initial(loop, clock), ms.start(run, names))
    (_, acc), over = scan(body, carry, inputs(loop, clock, names, None), clock.samples)
    measures = ms.read(run, acc, names)
    return over, _integral_excess(terms, lagrangian, measures), measures


def _search_cost(u, loop, clock, terms, lagrangian):
    """Return scaled cost + penalty of the excesses; absolute values in the cost are smoothed."""
    loop = _with_inputs(loop, u)
    names = _names(terms)
    run, zero = run_of(loop, clock), jnp.zeros((), u.dtype)
    smoothed = {m for m, _ in terms.objective} & {"input_travel", "iae"}

    def body(carry, xs):
        state, acc, (before, variation, absolute), penalty = carry
        now, multipliers = xs
        state, sample = step(loop, clock, state, now)
        acc = ms.update(run, acc, sample, now.context)
        if "input_travel" in smoothed:
            width = lagrangian.smoothing[0]
            change = sum(_smooth_absolute(a - b, width) for a, b in zip(sample.u, before))
            variation, before = variation + jnp.where(state.k == 1, 0.0, change), sample.u
        if "iae" in smoothed:
            size = sum(_smooth_absolute(e, lagrangian.smoothing[1]) for e in sample.e)
            absolute = absolute + run.lasting(sample, size)
        for multiplier, over in zip(multipliers, _pointwise_excess(terms, lagrangian, sample)):
            force = multiplier + lagrangian.weight * over
            penalty = penalty + jnp.where(force > 0.0, force * force, 0.0)
        return (state, acc, (before, variation, absolute), penalty), None

    extra = ((zero,) * loop.plant.pumps if "input_travel" in smoothed else (), zero, zero)
    carry = (initial(loop, clock), ms.start(run, names), extra, zero)
    xs = (inputs(loop, clock, names, None), lagrangian.multipliers)
    _, acc, (_, variation, absolute), penalty = checkpointed_scan(body, carry, xs, clock.samples)
    measures = ms.read(run, acc, names)
    smooth = {"input_travel": variation, "iae": absolute * clock.dt}
    cost = sum(w * (smooth[m] if m in smooth else jnp.sum(measures[m])) for m, w in terms.objective)
    total = (cost * cost if terms.squared else cost) / lagrangian.scale
    total = total + 0.5 * penalty / (lagrangian.weight * clock.samples)
    for j, over in enumerate(_integral_excess(terms, lagrangian, measures)):
        force = lagrangian.integral_multipliers[j] + lagrangian.weight * over
        total = total + 0.5 * jnp.where(force > 0.0, force * force, 0.0) / lagrangian.weight
    return total


def _names(terms):
    return tuple(dict.fromkeys([*(m for m, _ in terms.objective), *(m for m, _ in terms.integral)]))


def _with_inputs(loop, u):
    signal = dataclasses.replace(loop.controller.signal, values=u)
    return dataclasses.replace(loop, controller=dataclasses.replace(loop.controller, signal=signal))


def _smooth_absolute(x, width):
    """Return |x|, a parabola near 0: sqrt(x^2 + width^2) - width."""
    return jnp.sqrt(x * x + width * width) - width
