"""Experiment design: candidate inputs, and the standard deviations that each would give."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import max_len_seq

from jaxtank.case import Case, check_case
from jaxtank.core.errors import EquilibriumError, InputError
from jaxtank.core.labels import input_unit, label_of
from jaxtank.loop.steady import steady_state
from jaxtank.plants.runge_kutta import advance
from tuning.identification import simulation
from tuning.identification.confidence import LARGEST_DEVIATION
from tuning.identification.coordinates import coordinates_of, free_bounds, nominal
from tuning.identification.experiment import log as experiment_data
from tuning.identification.result import Experiments

AT_ONCE = "step of every pump at once, from empty"
IN_TURN = "steps one pump after the other, from empty"
SMALL = "small step of every pump at once, from steady state"
STAGGERED = "small staggered steps, from steady state"
BINARY = "pseudo-random binary sequence about steady state"
REGISTER = 7  # length of the shift register of the pseudo-random binary sequence: 127 bits


def prbs(bits, channel):
    """Return (bits,) of +-1: the maximum-length sequence of x^7 + x^6 + 1, shifted by channel."""
    sequence = max_len_seq(REGISTER, taps=[1])[0]
    places = np.arange(bits) + channel * (len(sequence) // 3)
    return 2.0 * np.take(sequence, places, mode="wrap") - 1.0


def candidates(loop, *, duration, dt, size=None, voltage=None, bit=None):
    """Return {description: (t (samples,) [s], u (samples, pumps), x0 (tanks,))} to compare."""
    pumps = loop.plant.pumps
    t = np.arange(round(duration / dt) + 1) * dt
    low, high = np.asarray(loop.actuator.low), np.asarray(loop.actuator.high)
    voltage, size = working_inputs(loop, voltage, size)
    steady = np.asarray(settled_levels(loop.plant, voltage), float)
    empty = np.zeros(loop.plant.tanks)
    bit = duration / 20 if bit is None else bit
    bits = int(duration / bit)
    current_bit = np.minimum((t / bit + 1e-9).astype(int), bits)
    signs = np.stack([prbs(bits + 1, j)[current_bit] for j in range(pumps)], axis=1)
    pump, time, part = np.arange(pumps), t[:, None] + 1e-9, duration / (pumps + 1)
    in_turn = (time >= pump * duration / max(pumps, 1)).astype(float)
    staggered = (time >= pump * part) & (time < (pump + pumps) * part)
    constant = np.ones((len(t), 1))
    inputs = {
        AT_ONCE: (voltage * constant, empty),
        IN_TURN: (voltage * in_turn, empty),
        SMALL: ((voltage + size) * constant, steady),
        STAGGERED: (voltage + size * staggered, steady),
        BINARY: (voltage + size * signs, steady),
    }
    return {name: (t, np.clip(u, low, high), x0) for name, (u, x0) in inputs.items()}


def settled_levels(plant, voltage):
    """Return (n,) levels after a long simulation with constant inputs: the steady levels."""
    x = tuple(jnp.zeros(()) + 1.0 for _ in range(plant.tanks))
    u = tuple(jnp.asarray(v) for v in voltage)
    height = float(np.max(np.asarray(plant.rim)))
    half = tuple(jnp.asarray(0.5 * height) for _ in range(plant.tanks))
    rate = max(abs(float(v)) for v in plant.derivative(0.0, half, u, None))
    h = 0.02 * height / max(rate, 1e-12)
    step = lambda x, _: (advance(plant, "rk4", 0.0, x, u, None, h, 1).x, None)
    x, _ = jax.lax.scan(step, x, None, length=20_000)
    return np.array([max(float(v), 0.0) for v in x])


def working_inputs(loop, voltage=None, size=None):
    """Return ((pumps,) inputs about which the candidates work, (pumps,) their small changes)."""
    voltage = _operating_point(loop) if voltage is None else voltage
    voltage = np.broadcast_to(np.asarray(voltage, dtype=float), (loop.plant.pumps,))
    size = 0.1 * voltage if size is None else np.asarray(size, dtype=float)
    return voltage, np.broadcast_to(size, voltage.shape)


def _operating_point(loop):
    """Return (pumps,) inputs about which a candidate experiment varies the pumps."""
    # initial inputs, else those of the first setpoint, else half of the range; less at high levels
    plant, high = loop.plant, np.asarray(loop.actuator.high, dtype=float)
    high = np.where(np.isfinite(high), high, 2.0)
    inputs = np.asarray(loop.actuator.initial, dtype=float)
    with contextlib.suppress(AttributeError, EquilibriumError, InputError):
        if not np.all(inputs > 0.02 * high):
            inputs = np.asarray(steady_state(loop, np.asarray(loop.reference.initial))[1])
    if not (np.all(np.isfinite(inputs)) and np.all(inputs > 0.02 * high)):
        inputs = 0.5 * high
    for _ in range(20):
        if np.max(settled_levels(plant, inputs) / np.asarray(plant.rim)) < 0.8:
            break
        inputs = 0.8 * inputs
    return inputs


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
    """Predict the standard deviations of the free parameters after each candidate experiment.

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
        Inputs of the operating point; by default `actuator.initial`, or where an input of it is
        about 0 those that hold the first setpoints, or half of the range; all of them reduced
        until every steady level is below 80 % of its rim.
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
        A dict {description: {"sd": {name: value or None}, "condition", "open"}}. "condition" is
        the condition number of J'J for parameters relative to their values, "open" lists the
        parameters that are not identifiable. Its attribute `inputs` lists the operating point of
        the candidates: {"input": name, "value", "change": of the small steps, "unit"}.

    Raises
    ------
    InputError
        If a parameter is unknown, or the simulation diverges.

    Examples
    --------
    >>> import jax, numpy as np, tuning
    >>> from jaxtank import presets
    >>> jax.config.update("jax_enable_x64", True)
    >>> case = presets.load("cascaded").cases["open-loop"]
    >>> t = np.arange(0.0, 60.0, 4.0)
    >>> step = {"step": (t, np.full((15, 1), 3.0), np.zeros(2))}
    >>> experiments = tuning.compare_experiments(
    ...     case, {"plant.pump_gain": (0.01, 0.2)}, noise=0.05, duration=56, dt=4, inputs=step
    ... )
    >>> experiments["step"]["open"], experiments["step"]["sd"]["plant.pump_gain[0]"] < 0.1
    ([], True)
    """
    check_case(case)
    loop, count = case.loop, 1
    tanks = tuple(range(loop.plant.tanks)) if levels is None else tuple(levels)
    coordinates = coordinates_of(free_bounds(loop, free))
    working = []
    if inputs is None:
        voltage, size = working_inputs(loop, voltage, size)
        working = [
            {
                "input": label_of(loop.plant, "pump", j),
                "value": float(voltage[j]),
                "change": float(size[j]),
                "unit": input_unit(loop.plant, j, loop.units[1]),
            }
            for j in range(loop.plant.pumps)
        ]
        inputs = candidates(loop, duration=duration, dt=dt, voltage=voltage, size=size, bit=bit)
    values = nominal(loop, coordinates.names)
    p, rig, rows = coordinates.point(values), simulation.rig_of(loop), {}
    runs = [(_data(t, u, tanks, case), np.asarray(x0, float)) for t, u, x0 in inputs.values()]
    error = 1e-5 * float(np.max(np.asarray(rig.plant.rim)))
    for data, x0 in runs:
        count = max(count, simulation.substeps_for(rig, data, x0[None], error)[0])
    for name, (data, x0) in zip(inputs, runs):
        weight = np.broadcast_to(noise, (len(tanks),))
        jacobian = _jacobian(rig, coordinates, p, data, x0, count, weight)
        if start == "known":
            jacobian = jacobian[:, : coordinates.size].copy()
        if not np.all(np.isfinite(jacobian)):
            raise InputError(
                f"{name}: the simulation diverges with samples every {data.steps[0, 0]:g} s; take a"
                " shorter duration"
            )
        deviations, names = coordinates.size, coordinates.names
        _, s, vt = np.linalg.svd(jacobian, full_matrices=False)
        slopes = coordinates.slopes(p)
        determined = s > 1e-9 * s.max()
        inverse = (vt[determined].T / s[determined] ** 2) @ vt[determined]
        sd = np.sqrt(np.diag(slopes @ inverse[:deviations, :deviations] @ slopes.T))
        unidentifiable = np.abs(vt[~determined]).max(axis=0, initial=0.0)[:deviations] > 0.1
        scaled = jacobian[:, :deviations] @ np.linalg.inv(slopes) * [values[n] for n in names]
        singular = np.linalg.svd(scaled, compute_uv=False)
        rows[name] = {
            "sd": {n: None if u else float(v) for n, v, u in zip(names, sd, unidentifiable)},
            "condition": float((singular[0] / singular[-1]) ** 2) if singular[-1] > 0 else None,
            "open": [n for n, u in zip(names, unidentifiable) if u],
        }
    return Experiments(case, rows, working)


def _data(t, u, tanks, case):
    """Return PaddedData of an experiment, without readings."""
    channels = tuple((i, False) for i in tanks)
    if case.loop.actuator.rate is not None:
        run = experiment_data(t=t, u=u, y=np.zeros((len(t), len(tanks))), tanks=tanks)
        courses = simulation.courses_of([run], case.loop.actuator, case.clock.dt)
        return simulation.padded([run], courses=courses)._replace(channels=channels)
    y = np.zeros((1, len(t), len(tanks)))
    return simulation.PaddedData(np.append(np.diff(t), 0.0)[None], u[None], y, channels)


def _jacobian(rig, coordinates, p, data, x0, substeps, noise):
    """Return (readings, unknowns) sensitivities of the readings of one run, in their noise."""
    static = {"channels": data.channels, "tanks": tuple(range(x0.size)), "substeps": substeps}
    run = (rig, data.dt, data.u, p, x0[None])
    slopes = np.asarray(simulation.sensitivities(*run, coordinates=coordinates, **static)[1])[0]
    return (slopes / noise[:, None]).reshape(-1, slopes.shape[-1])


def most_informative(experiments):
    """Return the experiment with the least product of deviations; None if none identifies all."""
    sd = {name: list(row["sd"].values()) for name, row in experiments.items()}
    complete = {name: np.sum(np.log(values)) for name, values in sd.items() if None not in values}
    return min(complete, key=complete.__getitem__) if complete else None


def remedies(estimation, fit, spread):
    """Return sentences: experiments that would identify the directions that `spread` has open."""
    z, sentences = estimation.unknowns(fit), []
    noise = np.sqrt(max(spread.scale, 1e-12))
    for name, experiment in _alternatives(estimation, z):
        t, u, x0, tanks = experiment
        expected = dict.fromkeys(tanks, float(np.mean(estimation.noise)))
        channels = zip(estimation.data.channels, estimation.noise)
        expected |= {tank: float(sd) for (tank, volts), sd in channels if not volts}
        # without dead times and the like of pumps, which no leaf of a rig has
        coordinates, steps = estimation.coordinates.leaves, 2 * estimation.substeps
        data = _data(t, u, tanks, estimation.case)
        run = (estimation.rig, coordinates, z[: coordinates.size], data, x0, steps)
        jacobian = _jacobian(*run, noise * np.array([expected[i] for i in tanks]))
        s = np.linalg.svd(jacobian[:, : coordinates.size].copy(), compute_uv=False)
        sd = float(1 / s[-1]) if s[-1] > 1e-9 * s[0] else None
        if sd is not None and sd < LARGEST_DEVIATION:
            sentences.append(f"{name} (largest standard deviation of a direction {100 * sd:.2g} %)")
    directions = spread.directions()
    names = [n for n in estimation.coordinates.names for d in directions if n in d["parameters"]]
    if names:
        which = names[0] if len(set(names)) == 1 else f"one of them directly, such as {names[0]},"
        sentences.append(f"measure {which} and remove it from --free")
    return sentences


def _alternatives(estimation, z):
    """Yield (description, (t, u, x0, tanks)) of other experiments as long as the first log."""
    log, loop = estimation.logs[0], estimation.case.loop
    measured = tuple(sorted({tank for tank, _ in estimation.data.channels}))
    tanks = tuple(range(loop.plant.tanks))
    others = ", ".join(f"h{i + 1}" for i in tanks if i not in measured)
    if others:
        yield f"measure {others} as well", (log.t, log.u, estimation.first_levels(z)[0], tanks)
    duration = log.t[-1] - log.t[0]
    dt = max(float(np.median(np.diff(log.t))), duration / 2000)
    mean = log.u.mean(axis=0)
    voltage = np.where(mean > 0, mean, _operating_point(loop))
    fitted = dataclasses.replace(loop, plant=estimation.rig_at(z).plant)
    inputs = candidates(fitted, duration=duration, dt=dt, voltage=voltage, size=0.3 * voltage)
    for name in (STAGGERED, IN_TURN):
        yield name.replace("small ", ""), (*inputs[name], measured)
