"""Experiment design: candidate inputs, the standard deviations that each would leave, and which
experiment would identify what the data do not.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxtank.case import Case
from jaxtank.core.errors import EquilibriumError, InputError
from jaxtank.loop.steady import steady_state
from jaxtank.plants.runge_kutta import advance
from tuning.identification import simulation
from tuning.identification.confidence import VAGUE
from tuning.identification.problem import coordinates, nominal, specification
from tuning.identification.result import Experiments
from tuning.problem.bounds import bounds

REGISTER = 7
"""Length of the shift register of the pseudo-random binary sequence: 127 bits."""


def prbs(bits, channel):
    """Return (bits,) of +-1: a maximum-length sequence of x^7 + x^6 + 1."""
    state, out = [1] * REGISTER, []
    for _ in range(2**REGISTER - 1):
        out.append(state[-1])
        state = [state[-1] ^ state[-2], *state[:-1]]
    shift = channel * (len(out) // 3)
    return np.array([2 * out[(i + shift) % len(out)] - 1 for i in range(bits)], dtype=float)


def candidates(loop, *, duration, dt, size=None, voltage=None, bit=None):
    """Return inputs to compare, {description: (t (samples,) [s], u (samples, pumps), x0
    (tanks,))}.
    """
    plant = loop.plant
    t = np.arange(round(duration / dt) + 1) * dt
    low, high = np.asarray(loop.actuator.low), np.asarray(loop.actuator.high)
    if voltage is None:
        voltage = _operating_point(loop)
    voltage = np.broadcast_to(np.asarray(voltage, dtype=float), (plant.pumps,))
    steady = np.asarray(settled(plant, voltage), dtype=float)
    size = (
        0.1 * voltage
        if size is None
        else np.broadcast_to(np.asarray(size, dtype=float), (plant.pumps,))
    )
    bit = duration / 20 if bit is None else bit
    bits = int(duration / bit)
    at = np.minimum((t / bit + 1e-9).astype(int), bits)
    signs = np.stack([prbs(bits + 1, j)[at] for j in range(plant.pumps)], axis=1)
    empty, pumps = np.zeros(plant.tanks), np.arange(plant.pumps)
    later = (t[:, None] >= pumps * duration / max(plant.pumps, 1) - 1e-9).astype(float)
    third = duration / (plant.pumps + 1)
    up = (t[:, None] >= pumps * third - 1e-9) & (t[:, None] < (pumps + plant.pumps) * third - 1e-9)
    constant = np.ones((len(t), 1))
    found = {
        "step of every pump at once, from empty": (voltage * constant, empty),
        "steps one pump after the other, from empty": (voltage * later, empty),
        "small step of every pump at once, from steady state": (
            (voltage + size) * constant,
            steady,
        ),
        "small staggered steps, from steady state": (voltage + size * up, steady),
        "pseudo-random binary sequence about steady state": (voltage + size * signs, steady),
    }
    return {name: (t, np.clip(u, low, high), x0) for name, (u, x0) in found.items()}


def settled(plant, voltage):
    """Return (n,) steady levels at constant inputs, by simulation until nothing moves."""
    x, d = tuple(jnp.zeros(()) + 1.0 for _ in range(plant.tanks)), None
    u = tuple(jnp.asarray(v) for v in voltage)
    size = float(np.max(np.asarray(plant.rim)))
    half = tuple(jnp.asarray(0.5 * size) for _ in range(plant.tanks))
    rate = max(abs(float(v)) for v in plant.derivative(0.0, half, u, d))
    h = 0.02 * size / max(rate, 1e-12)

    def body(x, _):
        return advance(plant, "rk4", 0.0, x, u, d, h, 1).x, None

    x, _ = jax.lax.scan(body, x, None, length=20_000)
    return np.array([max(float(v), 0.0) for v in x])


def _operating_point(loop):
    """Return (pumps,) inputs at which the case's pumps run before it starts."""
    # Where they stand, those of its first setpoint, else half of their range; less where a tank
    # would come near its rim.
    plant, high = loop.plant, np.asarray(loop.actuator.high, dtype=float)
    high = np.where(np.isfinite(high), high, 2.0)
    found = np.asarray(loop.actuator.initial, dtype=float)
    try:
        if not np.all(found > 0.02 * high):
            found = np.asarray(steady_state(loop, np.asarray(loop.reference.initial))[1])
    except (AttributeError, EquilibriumError, InputError):
        pass
    if not (np.all(np.isfinite(found)) and np.all(found > 0.02 * high)):
        found = 0.5 * high
    for _ in range(20):
        if np.max(settled(plant, found) / np.asarray(plant.rim)) < 0.8:
            break
        found = 0.8 * found
    return found


def compare_experiments(
    case: Case,
    free: Mapping[str, Any] | None = None,
    *,
    noise: ArrayLike,
    duration: float,
    dt: float,
    levels: Sequence[int] | None = None,
    start: str = "known",
    voltage: ArrayLike | None = None,
    size: ArrayLike | None = None,
    bit: float | None = None,
    inputs: Mapping[str, Any] | None = None,
) -> Experiments:
    """Predict the standard deviations of the free parameters that each candidate experiment leaves.

        covariance = (J' J / noise^2)^-1,   J the sensitivities of the readings (Fisher information)

    Parameters
    ----------
    case : Case
        The rig, with the values at which the sensitivities are taken.
    free : mapping, optional
        As in `identify`.
    noise : float or (measured tanks,) array
        Standard deviation of the readings in the rig's unit of length.
    duration, dt : float
        Length of an experiment and time between samples [s].
    levels : sequence of int, optional
        Tanks that are measured, counted from 0; all by default.
    start : {"known", "free"}
        Levels at the first sample: known, or estimated too.
    voltage : (pumps,) array, optional
        Inputs of the operating point; the case's own by default.
    size : (pumps,) array, optional
        Small changes of the inputs; a tenth of `voltage` by default.
    bit : float, optional
        Length of a bit of the pseudo-random sequence [s]; a twentieth of `duration` by default.
    inputs : mapping, optional
        {description: (t (samples,) [s], u (samples, pumps), x0 (tanks,))} in place of the
        candidates.

    Returns
    -------
    Experiments
        A dict {description: {"sd" {name: value or None}, "condition", "open": names that are not
        identifiable}}, the condition number of J'J for parameters relative to their values.

    Raises
    ------
    InputError
        For unknown parameters, and where the simulation diverges.

    Examples
    --------
    >>> import jax, numpy as np, tuning
    >>> from jaxtank import presets
    >>> jax.config.update("jax_enable_x64", True)
    >>> case = presets.load("cascaded").cases["open-loop"]
    >>> t = np.arange(0.0, 60.0, 4.0)
    >>> step = {"step": (t, np.full((15, 1), 3.0), np.zeros(2))}
    >>> found = tuning.compare_experiments(
    ...     case, {"plant.pump_gain": (0.01, 0.2)}, noise=0.05, duration=56, dt=4, inputs=step
    ... )
    >>> found["step"]["open"], found["step"]["sd"]["plant.pump_gain[0]"] < 0.1
    ([], True)
    """
    loop = case.loop
    tanks = tuple(range(loop.plant.tanks)) if levels is None else tuple(levels)
    moved = coordinates(bounds(loop, specification(loop, free)))
    if inputs is None:
        inputs = candidates(loop, duration=duration, dt=dt, voltage=voltage, size=size, bit=bit)
    values = nominal(loop, moved.names)
    p, rig = moved.point(values), simulation.rig_of(loop)
    count = max((_substeps(rig, t, u, x0, tanks) for t, u, x0 in inputs.values()), default=1)
    found = {}
    for name, (t, u, x0) in inputs.items():
        jacobian = (
            _jacobian(rig, moved, p, t, u, x0, tanks, start, count)
            / np.tile(np.broadcast_to(noise, (len(tanks),)), len(t))[:, None]
        )
        if not np.all(np.isfinite(jacobian)):
            raise InputError(
                f"{name}: the simulation diverges with samples every {t[1] - t[0]:g} s; take a"
                " shorter duration"
            )
        found[name] = _precision(moved, p, values, jacobian)
    return Experiments(case, found)


def _precision(moved, p, values, jacobian):
    """Return {"sd", "condition", "open"} of the weighted sensitivities of one experiment."""
    _, s, vt = np.linalg.svd(jacobian, full_matrices=False)
    slopes = moved.slopes(p)
    good = s > 1e-9 * s.max()
    inverse = (vt[good].T / s[good] ** 2) @ vt[good]
    sd = np.sqrt(np.diag(slopes @ inverse[: moved.size, : moved.size] @ slopes.T))
    vague = np.abs(vt[~good]).max(axis=0, initial=0.0)[: moved.size] > 0.1
    scaled = jacobian[:, : moved.size] @ np.linalg.inv(slopes) * [values[n] for n in moved.names]
    singular = np.linalg.svd(scaled, compute_uv=False)
    return {
        "sd": {n: None if vague[i] else float(v) for i, (n, v) in enumerate(zip(moved.names, sd))},
        "condition": float((singular[0] / singular[-1]) ** 2) if singular[-1] > 0 else None,
        "open": [n for i, n in enumerate(moved.names) if vague[i]],
    }


def most_informative(found):
    """Return the experiment of `compare_experiments` with the least product of deviations."""
    whole = {
        name: np.sum(np.log(list(row["sd"].values())))
        for name, row in found.items()
        if None not in row["sd"].values()
    }
    return min(whole, key=whole.__getitem__) if whole else None


def _substeps(rig, t, u, x0, tanks):
    """Return how many Runge-Kutta steps each sample of an experiment needs."""
    channels, first = tuple((i, False) for i in tanks), np.asarray(x0, dtype=float)[None]
    no_readings = np.zeros((1, len(t), len(tanks)))
    data = simulation.PaddedData(np.append(np.diff(t), 0.0)[None], u[None], no_readings, channels)
    error = 1e-5 * float(np.max(np.asarray(rig.plant.rim)))
    return simulation.substeps_for(rig, data, first, error)[0]


def _jacobian(rig, moved, p, t, u, x0, tanks, start, count):
    """Return (samples * measured tanks, unknowns) sensitivities of the readings."""
    first = np.asarray(x0, dtype=float)[None]
    _, slopes = simulation.sensitivities(
        rig,
        np.append(np.diff(t), 0.0)[None],
        u[None],
        p,
        first,
        coordinates=moved,
        tanks=tuple(range(first.shape[1])),
        channels=tuple((i, False) for i in tanks),
        substeps=count,
    )
    slopes = np.asarray(slopes)[0].reshape(-1, moved.size + first.shape[1])
    return slopes if start == "free" else slopes[:, : moved.size]


def remedies(estimation, fit, spread):
    """Return sentences: which experiments would identify what is not identifiable from
    these data.
    """
    z = estimation.unknowns(fit)
    noise = np.sqrt(max(spread.scale, 1e-12))
    found = []
    for name, experiment in _alternatives(estimation, z):
        sd = _largest_deviation(estimation, z, experiment, noise)
        if sd is not None and sd < VAGUE:
            found.append(f"{name} (largest standard deviation of a direction {100 * sd:.2g} %)")
    names = [
        n for n in estimation.coordinates.names for d in spread.directions() if n in d["parameters"]
    ]
    if names:
        which = names[0] if len(set(names)) == 1 else f"one of them by itself, as {names[0]},"
        found.append(f"measure {which} and leave it out of --free")
    return found


def _alternatives(estimation, z):
    """Return [(description, (t, u, x0, tanks))] of other experiments as long as the first log."""
    log, plant = estimation.logs[0], estimation.case.loop.plant
    measured = tuple(sorted({tank for tank, _ in estimation.data.channels}))
    x0, every = estimation.first_levels(z)[0], tuple(range(plant.tanks))
    hidden = [f"h{i + 1}" for i in every if i not in measured]
    found = []
    if hidden:
        found.append((f"measure {', '.join(hidden)} as well", (log.t, log.u, x0, every)))
    duration = log.t[-1] - log.t[0]
    dt = max(float(np.median(np.diff(log.t))), duration / 2000)
    mean, loop = log.u.mean(axis=0), estimation.case.loop
    voltage = np.where(mean > 0, mean, _operating_point(loop))
    fitted = dataclasses.replace(loop, plant=estimation.rig_at(z).plant)
    others = candidates(fitted, duration=duration, dt=dt, voltage=voltage, size=0.3 * voltage)
    for name in (
        "small staggered steps, from steady state",
        "steps one pump after the other, from empty",
    ):
        found.append((name.replace("small ", ""), (*others[name], measured)))
    return found


def _largest_deviation(estimation, z, experiment, scale):
    """Return the largest standard deviation of a direction of the coordinates."""
    t, u, x0, tanks = experiment
    usual = float(np.mean(estimation.noise)) * scale
    noise: dict[int, float] = {i: usual for i in tanks}
    for c, (tank, volts) in enumerate(estimation.data.channels):
        if not volts:
            noise[tank] = float(estimation.noise[c]) * scale
    p, _ = estimation.split(z)
    steps = 2 * estimation.substeps
    moved = estimation.coordinates
    jacobian = _jacobian(estimation.rig, moved, p, t, u, x0, tanks, "known", steps)
    jacobian = jacobian / np.tile([noise[i] for i in tanks], len(t))[:, None]
    s = np.linalg.svd(jacobian, compute_uv=False)
    return float(1 / s[-1]) if s[-1] > 1e-9 * s[0] else None
