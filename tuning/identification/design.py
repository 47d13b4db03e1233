"""Which experiment tells most: candidate inputs compared by the standard deviations they would
leave.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxtank.analysis.steady_state import equilibrium
from jaxtank.case import Case
from jaxtank.core.errors import EquilibriumError, InputError
from tuning.identification import simulation as pb
from tuning.identification.parametrisation import coordinates, nominal, usual

REGISTER = 7
"""Length of the shift register of the pseudo-random binary sequence: 127 bits, different for each
pump.
"""


def prbs(bits, channel):
    """(bits,) of +-1: a maximum-length sequence of x^7 + x^6 + 1, begun `channel` thirds of its
    length later for each pump.
    """
    state, out = [1] * REGISTER, []
    for _ in range(2**REGISTER - 1):
        out.append(state[-1])
        state = [state[-1] ^ state[-2], *state[:-1]]
    shift = channel * (len(out) // 3)
    return np.array([2 * out[(i + shift) % len(out)] - 1 for i in range(bits)], dtype=float)


def candidates(loop, *, duration, dt, size=None, voltage=None, bit=None):
    """Inputs to compare, {words: (t (samples,) [s], u (samples, pumps), x0 (tanks,) levels to start
    from)}: steps of all pumps at once and one after the other from empty tanks, and from rest a
    small step of all, staggered steps and a pseudo-random binary sequence.

    duration, dt: [s]; voltage: (pumps,) about which to work, the case's own operating point where
    None; size: of the small changes, in the pumps' unit, a tenth of the voltage where None; bit:
    length of a bit of the sequence [s], a twentieth of the duration where None. The inputs stay
    within the pumps' limits.
    """
    plant = loop.plant
    t = np.arange(round(duration / dt) + 1) * dt
    low, high = np.asarray(loop.actuator.low), np.asarray(loop.actuator.high)
    if voltage is None:
        voltage = _operating(loop)
    voltage = np.broadcast_to(np.asarray(voltage, dtype=float), (plant.pumps,))
    rest = np.asarray(settled(plant, voltage), dtype=float)
    size = (
        0.1 * voltage
        if size is None
        else np.broadcast_to(np.asarray(size, dtype=float), (plant.pumps,))
    )
    bit = duration / 20 if bit is None else bit
    empty, starts = np.zeros(plant.tanks), np.arange(plant.pumps) * duration / max(plant.pumps, 1)
    later = (t[:, None] >= starts - 1e-9).astype(float)
    signs = np.stack(
        [
            prbs(int(duration / bit) + 1, j)[
                np.minimum((t / bit + 1e-9).astype(int), int(duration / bit))
            ]
            for j in range(plant.pumps)
        ],
        axis=1,
    )
    third = duration / (plant.pumps + 1)
    up = (t[:, None] >= np.arange(plant.pumps) * third - 1e-9) & (
        t[:, None] < (np.arange(plant.pumps) + plant.pumps) * third - 1e-9
    )
    made = {
        "step of every pump at once, from empty": (np.tile(voltage, (len(t), 1)), empty),
        "steps one pump after the other, from empty": (voltage * later, empty),
        "small step of every pump at once, from rest": (np.tile(voltage + size, (len(t), 1)), rest),
        "small staggered steps, from rest": (voltage + size * up, rest),
        "pseudo-random binary sequence about rest": (voltage + size * signs, rest),
    }
    return {words: (t, np.clip(u, low, high), x0) for words, (u, x0) in made.items()}


def settled(plant, voltage):
    """(n,) levels at which a plant rests with voltages held: found by playing it until nothing
    moves.
    """
    import jax.numpy as jnp

    x, d = tuple(jnp.zeros(()) + 1.0 for _ in range(plant.tanks)), None
    u = tuple(jnp.asarray(v) for v in voltage)
    import jax

    from jaxtank.plants.runge_kutta import advance

    size = float(np.max(np.asarray(plant.rim)))
    rate = max(
        abs(float(v))
        for v in plant.derivative(
            0.0, tuple(jnp.asarray(0.5 * size) for _ in range(plant.tanks)), u, d
        )
    )
    h = 0.02 * size / max(rate, 1e-12)

    def body(x, _):
        return advance(plant, "rk4", 0.0, x, u, d, h, 1).x, None

    x, _ = jax.lax.scan(body, x, None, length=20_000)
    return np.array([max(float(v), 0.0) for v in x])


def _operating(loop):
    """(pumps,) inputs at which the case's pumps run before it starts, or those of its first
    setpoint, or half of their range; less where a tank would come near its rim.
    """
    plant, high = loop.plant, np.asarray(loop.actuator.high, dtype=float)
    high = np.where(np.isfinite(high), high, 2.0)
    found = np.asarray(loop.actuator.initial, dtype=float)
    try:
        if not np.all(found > 0.02 * high):
            found = np.asarray(
                equilibrium(plant, np.asarray(loop.reference.initial))[1], dtype=float
            )
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
) -> dict[str, dict[str, Any]]:
    """Predicted standard deviations of the free parameters for each candidate experiment (of
    `candidates`, or `inputs`: {words: (t (samples,) [s], u (samples, pumps), x0 (tanks,))}).

    free: as in `identify`; noise: standard deviation of the readings in the rig's unit of length,
    one or one per measured tank; levels: tanks that are measured, counted from 0, all where None;
    start: "known" levels at the beginning, or "free" ones, estimated too. Returns
    {words: {"sd" {name: value}, "condition", "open": [words of the directions it leaves open]}},
    condition of J'J with every parameter counted as a share of itself.
    """
    loop = case.loop
    tanks = tuple(range(loop.plant.tanks)) if levels is None else tuple(levels)
    spec = (
        usual(loop)
        if free is None
        else {n: (*v, "log" if v[0] > 0 else "linear")[:3] for n, v in free.items()}
    )
    from tuning.problem.bounds import bounds

    moved = coordinates(bounds(loop, spec))
    made = (
        candidates(loop, duration=duration, dt=dt, voltage=voltage, size=size, bit=bit)
        if inputs is None
        else inputs
    )
    values = nominal(loop, moved.names)
    p, rig = moved.point(values), pb.rig_of(loop)
    found = {}
    count = max((_substeps(rig, t, u, x0, tanks) for t, u, x0 in made.values()), default=1)
    for words, (t, u, x0) in made.items():
        jacobian = (
            _jacobian(rig, moved, p, t, u, x0, tanks, start, count)
            / np.tile(np.broadcast_to(noise, (len(tanks),)), len(t))[:, None]
        )
        if not np.all(np.isfinite(jacobian)):
            raise InputError(
                f"{words}: the integration breaks down with samples every {t[1] - t[0]:g} s; take a"
                " shorter duration"
            )
        _, s, vt = np.linalg.svd(jacobian, full_matrices=False)
        slopes = moved.slopes(p)
        good = s > 1e-9 * s.max()
        inverse = (vt[good].T / s[good] ** 2) @ vt[good]
        sd = np.sqrt(np.diag(slopes @ inverse[: moved.size, : moved.size] @ slopes.T))
        vague = np.abs(vt[~good]).max(axis=0, initial=0.0)[: moved.size] > 0.1
        scaled = (
            jacobian[:, : moved.size] @ np.linalg.inv(slopes) * [values[n] for n in moved.names]
        )
        singular = np.linalg.svd(scaled, compute_uv=False)
        found[words] = {
            "sd": {
                n: None if vague[i] else float(v) for i, (n, v) in enumerate(zip(moved.names, sd))
            },
            "condition": float((singular[0] / singular[-1]) ** 2) if singular[-1] > 0 else None,
            "open": [n for i, n in enumerate(moved.names) if vague[i]],
        }
    return found


def most_telling(found):
    """The words of the experiment, of those `compare_experiments` compared, whose standard
    deviations have the smallest product; None where each leaves something open.
    """
    whole = {
        words: np.sum(np.log(list(row["sd"].values())))
        for words, row in found.items()
        if None not in row["sd"].values()
    }
    return min(whole, key=whole.__getitem__) if whole else None


def _substeps(rig, t, u, x0, tanks):
    """How many steps each sample of an experiment needs."""
    channels, own = tuple((i, False) for i in tanks), np.asarray(x0, dtype=float)[None]
    blank = pb.Record(
        np.append(np.diff(t), 0.0)[None], u[None], np.zeros((1, len(t), len(tanks))), channels
    )
    return pb.substeps_for(rig, blank, own, 1e-5 * float(np.max(np.asarray(rig.plant.rim))))[0]


def _jacobian(rig, moved, p, t, u, x0, tanks, start, count=None):
    """(samples * measured tanks, unknowns) derivative of the readings."""
    dt = np.append(np.diff(t), 0.0)[None]
    channels, own = tuple((i, False) for i in tanks), np.asarray(x0, dtype=float)[None]
    count = _substeps(rig, t, u, x0, tanks) if count is None else count
    _, slopes = pb.passes(
        rig,
        dt,
        u[None],
        p,
        own,
        coordinates=moved,
        tanks=tuple(range(own.shape[1])),
        channels=channels,
        substeps=count,
    )
    slopes = np.asarray(slopes)[0].reshape(-1, moved.size + own.shape[1])
    return slopes if start == "free" else slopes[:, : moved.size]


def alternatives(estimation, z):
    """(words, (t, u, x0, tanks)) of experiments as long as the first log that could be made
    instead.
    """
    log, plant = estimation.logs[0], estimation.case.loop.plant
    seen = tuple(sorted({tank for tank, _ in estimation.record.channels}))
    x0, every = estimation.levels(z)[0], tuple(range(plant.tanks))
    rig = estimation.at(z)
    hidden = [i for i in every if i not in seen]
    found = []
    if hidden:
        found.append(
            (f"log {', '.join(f'h{i + 1}' for i in hidden)} as well", (log.t, log.u, x0, every))
        )
    duration = log.t[-1] - log.t[0]
    dt = max(float(np.median(np.diff(log.t))), duration / 2000)
    mean = log.u.mean(axis=0)
    loop = estimation.case.loop
    voltage = np.where(mean > 0, mean, _operating(loop))
    import dataclasses

    there = dataclasses.replace(loop, plant=rig.plant)
    made = candidates(there, duration=duration, dt=dt, voltage=voltage, size=0.3 * voltage)
    for words in ("small staggered steps, from rest", "steps one pump after the other, from empty"):
        t, u, start = made[words]
        found.append((words.replace("small ", ""), (t, u, start, seen)))
    return found


def open_directions(estimation, z, experiment, noise):
    """The largest standard deviation of a direction (of the coordinates) that an experiment would
    leave; None where it cannot be told.
    """
    t, u, x0, tanks = experiment
    channels = estimation.record.channels
    usual_noise = float(np.mean(estimation.noise)) * noise
    by_tank = {
        tank: float(estimation.noise[c]) * noise
        for c, (tank, volts) in enumerate(channels)
        if not volts
    }
    p, _ = estimation.parts(z)
    jacobian = _jacobian(
        estimation.rig, estimation.coordinates, p, t, u, x0, tanks, "known", 2 * estimation.substeps
    )
    jacobian = jacobian / np.tile([by_tank.get(i, usual_noise) for i in tanks], len(t))[:, None]
    s = np.linalg.svd(jacobian, compute_uv=False)
    return float(1 / s[-1]) if s[-1] > 1e-9 * s[0] else None


__all__ = [
    "alternatives",
    "candidates",
    "compare_experiments",
    "most_telling",
    "open_directions",
    "prbs",
    "settled",
]
