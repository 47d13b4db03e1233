"""Steady states of a rig."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank.analysis import elimination
from jaxtank.core import vectors
from jaxtank.core.errors import EquilibriumError, InputError
from jaxtank.core.labels import label_of, labels_of
from jaxtank.core.numerics import lower_clip, smooth_signed_sqrt, smooth_sqrt
from jaxtank.plants import elements
from jaxtank.plants.tank_network import TankNetwork

STEPS = 200  # steps at most; ten to thirty suffice where there is a steady state
STARTS = 8  # random levels at which it is tried whether inputs change a net inflow


class Balance:
    """Rates and Jacobian of a network at levels x (n,), inputs u (m,), inflow (n,) [cm^3/s]."""

    def __init__(self, plant: Any, inflow: Any = None):
        self.inflow = inflow
        self.knee, self.area = plant.knee, np.asarray(plant.area, dtype=float)
        w = np.sqrt(2.0 * float(plant.gravity))
        ends = lambda pairs: np.array(pairs, dtype=int).reshape(-1, 2).T
        (source, sink), (self.one, self.other) = ends(plant.links), ends(plant.pipes)
        n, self.pipe = plant.tanks, w * np.asarray(plant.pipe, dtype=float)
        drain, orifice = (w * np.asarray(v, dtype=float) for v in (plant.drain, plant.orifice))
        tanks, pipes = np.arange(n), np.arange(len(self.one))
        # what a unit of each root, pipe flow and input adds to the volume of each tank
        self.roots = _matrix(n, n, (tanks, tanks, -drain), (source, source, -orifice))
        self.roots = self.roots + _matrix(n, n, (sink, source, orifice))
        out, into = (self.one, pipes, -self.pipe), (self.other, pipes, self.pipe)
        self.flows = _matrix(n, len(pipes), out, into)
        unit = np.ones(len(pipes))
        self.apart = _matrix(len(pipes), n, (pipes, self.one, unit), (pipes, self.other, -unit))
        first = np.array([a for a, _ in plant.feeds])
        two = np.array([b is not None for _, b in plant.feeds])
        second = np.array([a if b is None else b for a, b in plant.feeds])
        gain, share = np.asarray(plant.pump_gain), np.where(two, np.asarray(plant.split), 1.0)
        pumps = np.arange(len(first))
        self.pumps = _matrix(
            n, len(first), (first, pumps, gain * share), (second, pumps, gain * (1.0 - share))
        )

    def rates(self, x: Any, u: Any) -> Any:
        """Return (n,) rates of the levels [cm/s]."""
        q, s = (np.asarray(v) for v in self._roots(x)[0])
        flow = self.roots @ q + self.flows @ s + self.pumps @ u
        return (flow if self.inflow is None else flow + self.inflow) / self.area

    def slopes(self, x: Any) -> tuple[Any, Any]:
        """Return their sparse derivatives by the levels (n, n) and by the inputs (n, m)."""
        diagonal = scipy.sparse.diags_array
        dq, ds = (diagonal(np.asarray(v)) for v in self._roots(x)[1])
        per_area = diagonal(1.0 / self.area)
        return per_area @ (self.roots @ dq + self.flows @ ds @ self.apart), per_area @ self.pumps

    def _roots(self, x: Any) -> Any:
        """((roots of the levels, roots of their differences), the slopes of both)."""
        h = (x, x[self.one] - x[self.other])

        def both(level: Any, apart: Any) -> Any:
            return smooth_sqrt(level, self.knee), smooth_signed_sqrt(apart, self.knee)

        with jax.enable_x64(True):
            return jax.jvp(both, h, tuple(np.ones_like(v) for v in h))


def _matrix(rows: int, columns: int, *parts: Any) -> Any:
    """Sparse matrix of (row, column, value) arrays, added up."""
    i, j, v = (np.concatenate([np.asarray(part[k]) for part in parts]) for k in range(3))
    return scipy.sparse.csr_array((v, (i.astype(int), j.astype(int))), shape=(rows, columns))


def balanced(plant: Any, y: Any, enough: float, inflow: Any) -> tuple[Any, Any, Any]:
    """Return (levels (n,), inputs (m,), rates (n,) left) of a network at rest with outputs y."""
    # Levenberg-Marquardt steps in the roots of the unknown levels, so that no level is negative,
    # until no rate is above `enough` [cm/s], or as near to rest as it comes
    system, (free, scale, gain, split, z) = Balance(plant, inflow), _roots_and_inputs(plant, y)
    rates, damping = system.rates(*split(z)), 1e-4
    for _ in range(STEPS):
        if np.max(np.abs(rates)) < enough:
            break
        by_x, by_u = system.slopes(split(z)[0])
        by_z = by_x[:, free] @ scipy.sparse.diags_array(2.0 * scale * z[: len(free)])
        jacobian = scipy.sparse.hstack([by_z, by_u / gain], format="csc")
        normal, slope = jacobian.T @ jacobian, jacobian.T @ rates
        diagonal = normal.diagonal()
        weights = scipy.sparse.diags_array(np.maximum(diagonal, 1e-12 * diagonal.max()))
        while damping < 1e12:
            step = scipy.sparse.linalg.spsolve((normal + damping * weights).tocsc(), slope)
            moved = z - step
            now = system.rates(*split(moved))
            if np.linalg.norm(now) < np.linalg.norm(rates):
                z, rates, damping = moved, now, max(1e-16, 0.1 * damping)
                break
            damping *= 10.0
        else:
            break
    return (*split(z), rates)


def _roots_and_inputs(plant, y):
    """(free tanks, scales of levels and inputs, z -> (levels, inputs), first z)."""
    free = np.setdiff1d(np.arange(plant.tanks), plant.outputs)
    scale = float(np.max(y)) or 1.0
    gain = float(np.min(plant.pump_gain)) / float(np.max(plant.area))

    def split(z):
        x = np.zeros(plant.tanks)
        x[list(plant.outputs)], x[free] = y, scale * z[: len(free)] ** 2
        return x, z[len(free) :] / gain

    start = np.concatenate([np.full(len(free), 0.9), np.full(plant.pumps, 1e-3 * scale)])
    return free, scale, gain, split, start


def responses(plant, xp, inflow=None):
    """(n, outputs) efflux speeds and (m, outputs) inputs by controlled speeds, without pipes."""
    # with an inflow (n,) [cm^3/s] a last column, what it does alone
    if plant.pipes:
        raise InputError(
            "steady_flows is for networks whose orifices discharge freely; with pipes use"
            " equilibrium"
        )
    m, outputs = plant.pumps, np.array(plant.outputs)
    if m != len(outputs):
        raise InputError(
            f"equilibrium needs as many pumps as outputs: this rig has {m} and {len(outputs)}"
        )
    free, columns, efflux = _unknowns(plant, xp)
    right, still = -efflux[:, outputs], xp.eye(m)
    if inflow is not None:
        right = xp.concatenate([right, -xp.asarray(inflow)[:, None]], axis=1)
        still = xp.concatenate([still, xp.zeros((m, 1))], axis=1)
    solve = np.linalg.solve if xp is np else elimination.solve_all
    solution = solve(columns, right)
    order = np.argsort(np.concatenate([outputs, free]))
    speeds = xp.concatenate([still, solution[: len(free)]])[order]
    return speeds, solution[len(free) :]


def at_rest(plant, y, inflow=None, start=None, shared=None, held=(), ignored=False):
    """Return (levels (n,), inputs (m,), largest net inflow left) of any network at rest."""
    # Levenberg-Marquardt in the roots of the free levels and in the inputs; the derivatives
    # follow from the implicit function theorem. start: (levels, inputs); held: `unregulated`
    # tanks, half full, which may fill or run empty meanwhile; ignored: the same as a
    # boolean mask (n,), which may be traced; no derivatives.
    free = [i for i in range(plant.tanks) if i not in {*plant.outputs, *held}]
    y, m = jnp.stack([jnp.asarray(v, dtype=float) for v in y]), len(free)
    scale = jax.lax.stop_gradient(jnp.max(y)) + plant.knee
    if start is None:
        inputs = _first_inputs(plant)
        if shared is not None:
            inputs = np.full(len(y), max(inputs[: len(plant.feeds)], default=0.0))
        shares = jnp.full(m, 0.9)
        if free and any(getattr(plant, name) is not None for name in elements.PORTS):
            first = _first_levels(plant, scale)
            shares = jnp.sqrt(jnp.stack([first[i] for i in free]) / scale)
        z = jnp.concatenate([shares, inputs]).astype(y.dtype)
    else:
        levels = jnp.stack([start[0][i] for i in free]) if free else jnp.zeros(0)
        z = jnp.concatenate([jnp.sqrt(jnp.maximum(levels / scale, 0.0)), jnp.stack([*start[1]])])

    def split(z):
        x = [0.5 * plant.rim[i] for i in range(plant.tanks)]
        for value, i in [*zip(y, plant.outputs), *zip(scale * z[:m] * z[:m], free)]:
            x[i] = value
        return tuple(x), tuple(z[m:] if shared is None else shared(z[m:]))

    def imbalance(z):
        x, u = split(z)
        rates = elements.net_flows(plant, x, u, inflow)
        rates = jnp.where(ignored, 0.0, jnp.stack(list(rates)))
        return rates if not held else jnp.stack([rates[i] for i in range(len(x)) if i not in held])

    def solve(residual, z):
        eps = float(jnp.finfo(z.dtype).eps)

        def on(carry):
            _, rates, damping, k, size = carry
            return (jnp.max(jnp.abs(rates)) > 4.0 * eps * size) & (k < STEPS) & (damping < 1e12)

        def step(carry):
            z, rates, damping, k, size = carry
            J = jax.jacfwd(residual)(z)
            normal = J.T @ J
            weights = jnp.maximum(jnp.diag(normal), 1e-12 * jnp.max(jnp.diag(normal)))
            moved = z - elimination.solve(normal + damping * jnp.diag(weights), J.T @ rates)
            now = residual(moved)
            better = jnp.sum(now * now) < jnp.sum(rates * rates)
            z, rates = jnp.where(better, moved, z), jnp.where(better, now, rates)
            damping = jnp.where(better, jnp.maximum(eps, 0.1 * damping), 10.0 * damping)
            return z, rates, damping, k + 1, size

        rates = residual(z)
        x, u = split(z)
        size = jnp.max(jnp.stack([jnp.abs(s.flow) for s in elements.streams(plant, x, u)]))
        return jax.lax.while_loop(on, step, (z, rates, 1e-4 + 0.0 * size, 0, size))[0]

    def tangent(linear, b):
        # a product with the inverse is linear in b, as its transpose in reverse mode must be
        return elimination.inverse(jax.jacfwd(linear)(jnp.zeros_like(b))) @ b

    z = jax.lax.custom_root(imbalance, jax.lax.stop_gradient(z), solve, tangent)
    return *split(z), jnp.max(jnp.abs(imbalance(z)))


def _first_levels(plant, scale):
    """Levels (n,) to begin with: below the largest output, above the ports of the outlets."""
    ends = {
        "drain_port": [(i,) for i in range(plant.tanks)],
        "orifice_port": [(source,) for source, _ in plant.links],
        "pipe_port": plant.pipes,
        "valve_port": [(source,) for source, *_ in plant.valves],
    }
    levels, ports = [0.81 * scale] * plant.tanks, [0.0] * plant.tanks
    for name, owners in ends.items():
        if (port := getattr(plant, name)) is not None:
            for k, tanks in enumerate(owners):
                for i in tanks:
                    ports[i] = jnp.maximum(ports[i], port[k])
    for i, port in enumerate(ports):
        above = port + jnp.minimum(levels[i], 0.5 * (plant.rim[i] - port))
        levels[i] = jnp.where(port > 0.0, above, levels[i])
    return jax.lax.stop_gradient(levels)


def _first_inputs(plant):
    """Inputs (m,) to begin with: pumps off, or where their curve is steepest; valves half open."""
    pumps = [0.0] * len(plant.feeds)
    for j, curve in enumerate(plant.curves or ()):
        if curve is not None:
            x, y = np.array(curve, dtype=float).T
            k = int(np.argmax(np.abs(np.diff(y) / np.diff(x))))
            pumps[j] = 0.5 * (x[k] + x[k + 1])
    return np.array([*pumps, *[0.5 * elements.full_open(plant.units)] * len(plant.valves)])


START_SHARES = (0.25, 0.75, 1.5, 2.5)
"""Inputs to begin with next, in largest inputs of the curves: one may be flat at the first [-]."""


def starts(plant, y, shared):
    """Yield the `start` of `at_rest` to try one after the other."""
    yield None
    inputs = [abs(x) for curve in plant.curves or () if curve for x, _ in curve]
    for share in START_SHARES if inputs else ():
        count = plant.pumps if shared is None else np.shape(y)[-1]
        yield np.full(plant.tanks, np.max(y)), np.full(count, share * max(inputs))


def check_rest(plant, name):
    """Raise InputError for a network whose steady states are not unique."""
    if tanks := elements.closed_circuit(plant, elements.unregulated(plant)):
        raise EquilibriumError(
            f"{name}: {labels_of(plant, 'tank', tanks)} exchange nothing with the basin,"
            " so that their steady levels depend on what they hold at the start"
        )
    if plant.pumps != len(plant.outputs):
        inputs = "pumps and valves" if plant.valves else "pumps"
        raise InputError(
            f"{name} needs as many {inputs} as outputs: this rig has {plant.pumps} and"
            f" {len(plant.outputs)}"
        )


def _balance(plant, xp=jnp):
    """Efflux (n, n) [cm^2], pumps (n, m): A_i h_i' = efflux @ speeds + pumps @ inputs, no pipes."""
    one = np.eye(plant.tanks)
    source, sink = (one[[pair[k] for pair in plant.links]] for k in (0, 1))
    first = one[[a for a, _ in plant.feeds]]
    second = one[[a if b is None else b for a, b in plant.feeds]]
    share = xp.where(np.array([b is None for _, b in plant.feeds]), 1.0, xp.asarray(plant.split))
    orifice, gain = xp.asarray(plant.orifice), xp.asarray(plant.pump_gain)
    efflux = (sink - source).T @ (orifice[:, None] * source) - xp.diag(xp.asarray(plant.drain))
    return efflux, (first.T * share + second.T * (1.0 - share)) * gain


def steady_flows(plant, y):
    """Return efflux speeds and inputs of the steady state with outputs y, differentiably.

    The balance of every tank is linear in the efflux speeds, so there is no iteration.

    Parameters
    ----------
    plant : TankNetwork without pipes or with valves and the like, with as many inputs as outputs
    y : (outputs,) levels [cm]

    Returns
    -------
    (speeds (n,) [cm/s], inputs (m,) [V]); negative where no steady state exists

    Raises
    ------
    InputError for another plant.

    Examples
    --------
    >>> from jaxtank.plants import state_coupled_four_tank
    >>> speeds, inputs = steady_flows(state_coupled_four_tank(15.0), (8.0, 8.0))
    >>> [round(float(u), 3) for u in inputs]
    [2.949, 2.949]
    """
    if not plant.plain:
        check_rest(plant, "steady_flows")
        x, u, _ = at_rest(plant, y)
        return jnp.sqrt(2.0 * plant.gravity * jnp.stack(x)), jnp.stack(u)
    return _from_known_speeds(plant, jnp.sqrt(2.0 * plant.gravity) * jnp.sqrt(jnp.asarray(y)))


def _from_known_speeds(plant, known, xp=jnp, inflow=None):
    """`steady_flows` for efflux speeds (outputs,) of the controlled tanks and an inflow (n,)."""
    # xp: numpy, where nothing is differentiated, spares thirty small compilations
    speeds, inputs = responses(plant, xp, inflow)
    known = known if inflow is None else xp.append(known, 1.0)
    return speeds @ known, inputs @ known


def _unknowns(plant, xp=jnp):
    """(free tanks, columns of their speeds and of the inputs in the balance, efflux)."""
    efflux, pumps = _balance(plant, xp)
    free = [i for i in range(plant.tanks) if i not in plant.outputs]
    return free, xp.concatenate([efflux[:, np.array(free, dtype=int)], pumps], axis=1), efflux


def steady_under(plant: Any, h0: Any, u0: Any, d: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Return the steady state with the same outputs under disturbances of the level rates."""
    if not plant.plain:
        inflow = tuple(a * v for a, v in zip(plant.sections(h0), d))
        return at_rest(plant, [h0[i] for i in plant.outputs], inflow, (h0, u0))[:2]
    # 0 = efflux v + pumps u + A d, v_outputs as before: the balance is linear in v, u and d
    # so the matrix of d is solved once, in front of the time loop. A tank that would have to flow
    # backwards is empty.
    free, columns, _ = _unknowns(plant)
    moved = elimination.solve_all(columns, -jnp.diag(jnp.asarray(plant.area)))
    double = 2.0 * plant.gravity
    h, n = list(h0), range(plant.tanks)
    for k, i in enumerate(free):
        v = jnp.sqrt(double) * smooth_sqrt(h0[i], plant.knee) + sum(moved[k, j] * d[j] for j in n)
        v = lower_clip(v, 0.0)
        h[i] = v * v / double
    rows = moved[len(free) :]
    return tuple(h), tuple(u + sum(rows[k, j] * d[j] for j in n) for k, u in enumerate(u0))


def steady_along(
    plant: Any, r: tuple[Any, ...], inflow: Any = None
) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Return the steady state of every sample of a reference, as state feedback prepares it.

    Speeds and inputs are linear in the roots of r, so the balance is solved once per output and not
    per sample. No check: where no steady state exists, an input or the flow behind a level is
    negative.

    Parameters
    ----------
    plant : as in `steady_flows`
    r : tuple of arrays (samples,), one per output [cm]
    inflow : (n,) steady inflow of each tank that no pump brings [cm^3/s], or None

    Returns
    -------
    (levels [cm], inputs [V]): tuples of arrays (samples,)

    Examples
    --------
    >>> from jaxtank.plants import state_coupled_four_tank
    >>> r = jnp.array([8.0, 10.0])
    >>> x, u = steady_along(state_coupled_four_tank(15.0), (r, r))
    >>> [round(float(v), 3) for v in u[0]]
    [2.949, 3.297]
    """
    if not plant.plain:
        check_rest(plant, "steady_along")
        return jax.vmap(lambda *y: at_rest(plant, y, inflow)[:2])(*r)
    roots, w = [smooth_sqrt(v, plant.knee) for v in r], jnp.sqrt(2.0 * plant.gravity)
    if inflow is not None:  # one more column: what it does alone
        roots.append(jnp.ones_like(roots[0]) / w)
    speeds, inputs = (part @ jnp.stack(roots) for part in responses(plant, jnp, inflow))
    return tuple((w * speeds) ** 2 / (2.0 * plant.gravity)), tuple(w * inputs)


def steady_levels(plant, u):
    """Return the steady levels of a network without pipes at given inputs, differentiably.

    Parameters
    ----------
    plant : TankNetwork without pipes
    u : (m,) inputs >= 0 [V]

    Returns
    -------
    (n,) levels [cm]

    Raises
    ------
    InputError for a network with pipes.

    Examples
    --------
    >>> from jaxtank.plants import network
    >>> tank = network(area=[25.0], drain=[0.3], pump_gain=[8.0], feeds=[(0, None)], rim=[30.0])
    >>> round(float(steady_levels(tank, (3.0,))[0]), 3)
    3.262
    """
    if plant.pipes:
        raise InputError("steady_levels is for networks whose orifices discharge freely")
    elements.check_plain(plant, "steady_levels", "equilibrium finds its steady states")
    efflux, pumps = _balance(plant)
    speeds = elimination.solve_all(efflux, -pumps @ jnp.asarray(u, dtype=float))
    return speeds * speeds / (2.0 * plant.gravity)


def _check_setpoints(plant: Any, y: Any) -> None:
    """Raise unless the plant is a network of tanks, and its setpoints y (outputs,) are levels."""
    if not hasattr(plant, "links"):
        kind = type(plant).__name__
        raise EquilibriumError(f"a {kind} is no TankNetwork: its steady states are not known")
    length = plant.units[0]
    for i, level in zip(plant.outputs, y):
        if not (np.isfinite(level) and level >= 0):
            raise InputError(
                f"setpoint of {label_of(plant, 'tank', i)} = {level} {length}: must be a finite"
                f" level at or above 0 {length}"
            )


def equilibrium(
    plant: Any, y: Any, inflow: Any = None, low: Any = 0.0, shared: Any = None
) -> tuple[Any, Any]:
    """Return levels and inputs of the steady state with outputs y (gouta2015 notes S2.3).

    Of the plant alone: `loop.steady.steady_state` takes inflow, dead zone and limits of a loop.

    Parameters
    ----------
    plant : TankNetwork
    y : (outputs,) levels [cm]
    inflow : (n,) steady inflow of each tank that no pump brings [cm^3/s], or None
    low : (m,) least input of each pump [V]; above 0 it counts as 0
    shared : where there are more inputs than outputs, (outputs,) numbers -> (m,) inputs, each of
        which rises or falls with the number of its output: a jax.tree_util.Partial

    Returns
    -------
    (levels (n,) [cm], inputs (m,) [V]) as host arrays: x' = 0 with h_outputs = y

    Raises
    ------
    EquilibriumError, naming the tank or the pump, where a steady state needs a flow backwards or an
    input below `low`.

    Examples
    --------
    >>> from jaxtank.plants import state_coupled_four_tank
    >>> x, u = equilibrium(state_coupled_four_tank(15.0), (8.0, 8.0))
    >>> u.round(3).tolist()
    [2.949, 2.949]
    """
    y = np.asarray(y, dtype=float)
    length, drive = plant.units
    _check_setpoints(plant, y)
    at = ", ".join(f"{v:g}" for v in y)
    words = f"outputs ({at}) {length}"
    if inflow is not None:
        inflow = np.asarray(inflow, dtype=float)
        words += " with inflow (" + ", ".join(f"{v:g}" for v in inflow) + f") {length}^3/s"
    held = tuple(elements.unregulated(plant))
    if plant.plain and not plant.pipes and shared is None and not held:
        x, u = _free_discharge(plant, y, words, inflow)
    else:
        x, u = _balanced(plant, y, words, inflow, shared, held)
    low = np.minimum(np.broadcast_to(np.asarray(low, dtype=float), u.shape), 0.0)
    for j, volts in enumerate(u):
        if volts < low[j] - 1e-9 * max(1.0, float(np.max(np.abs(u)))):
            least = f", below its low limit of {low[j]:g} {drive}" if low[j] < 0.0 else ""
            name = label_of(plant, "pump", j)
            needs, unit = "run at", f" {drive}"
            if j >= plant.pumps - len(plant.valves):
                needs, unit = "open to", "" if elements.full_open(plant.units) == 1.0 else " %"
            raise EquilibriumError(
                f"{words} have no steady state: {name} would have to {needs}"
                f" {volts:.3g}{unit}{least}"
            )
    return x, np.maximum(u, low)


def _free_discharge(plant, y, words, inflow):
    """(levels, inputs) of a network without pipes in its steady state; inputs may be negative."""
    with np.errstate(all="ignore"):  # an overflow is reported below
        try:
            known = _roots_of(np.asarray(y, dtype=float), float(plant.knee))
            known = np.sqrt(2.0 * float(plant.gravity)) * known
            speeds, u = _from_known_speeds(plant, known, np, inflow)
        except np.linalg.LinAlgError:
            speeds = u = np.array([np.nan])
        x = levels_of(np.maximum(speeds, 0.0), 2.0 * float(plant.gravity), plant.knee)
    if not all(np.all(np.isfinite(v)) for v in (speeds, u, x)):
        raise EquilibriumError(
            f"{words} have no unique steady state: the pumps cannot move the outputs independently"
        )
    tolerance = 1e-9 * max(1.0, float(np.max(np.abs(speeds))))
    for i, v in enumerate(speeds):
        if v < -tolerance:
            raise EquilibriumError(
                f"{words} have no steady state: the outflow of"
                f" {label_of(plant, 'tank', i)} would be"
                f" {-v:.3g} {plant.units[0]}/s backwards (below empty)"
            )
    return x, u


def _roots_of(levels, knee):
    """`smooth_sqrt` of numbers, for which nothing is compiled."""
    laminar = levels * (1.5 * knee**-0.5 - 0.5 * knee**-1.5 * np.maximum(levels, 0.0))
    return np.where(levels >= knee, np.sqrt(np.maximum(levels, 0.0)), laminar)


def levels_of(speeds: Any, weight: Any, knee: Any) -> Any:
    """Return the levels of efflux speeds v: v |v|/weight; of roots below the knee their inverse."""
    root = np.clip(np.abs(speeds) / np.sqrt(weight * knee), 0.0, 1.0)
    laminar = knee * np.sign(speeds) * (1.5 - np.sqrt(2.25 - 2.0 * root))
    return np.where(root < 1.0, laminar, speeds * np.abs(speeds) / weight)


def _balanced(plant, y, words, inflow, shared, held):
    """(levels, inputs) at rest of a network with pipes or other elements."""
    alone = plant.plain and shared is None and not held
    if alone:
        check_rest(plant, "equilibrium")
    if not alone or plant.tanks < vectors.FROM:
        return _rest_of_elements(plant, y, words, inflow, shared, held)
    speed = np.sqrt(2.0 * float(plant.gravity) * (float(np.max(y)) or 1.0))
    speed = float(np.max(np.abs(plant.drain))) / float(np.min(plant.area)) * speed
    tolerance = 1e-9 * max(speed, 1e-12)
    try:
        # an area of 1e-300, say, overflows on the way: the check below reports it
        with np.errstate(all="ignore"):
            x, u, rates = balanced(plant, y, 1e-5 * tolerance, inflow)
    except (ValueError, np.linalg.LinAlgError):  # not finite where it starts, or on the way
        raise EquilibriumError(f"{words} have no steady state") from None
    if not np.max(np.abs(rates)) < tolerance:
        raise _no_steady_state(words, plant, shared, held)
    return x, u


def rest(plant, y, inflow=None, start=None, shared=None, held=()):
    """`at_rest` with closed valves at 0 or above; last, whether that is a steady state."""
    x, u, imbalance = at_rest(plant, y, inflow, start, shared, held)
    first = tuple(_first_inputs(plant))
    # the flows at rest may all be 0: a valve closed, a pump off
    level = jnp.maximum(jnp.max(jnp.stack([*y])), plant.knee)
    at = (x, u), (x, first), ((level,) * plant.tanks, first)
    flows = jnp.stack([jnp.abs(s.flow) for pair in at for s in elements.streams(plant, *pair)])
    allowed, pumps = 1e-9 * jnp.max(flows), len(plant.feeds)
    # nothing flows through a check valve at an opening below 0 either
    closed = (*u[:pumps], *(jnp.maximum(v, 0.0) for v in u[pumps:]))
    rates = elements.net_flows(plant, x, closed, inflow)
    rates = jnp.stack([rate for i, rate in enumerate(rates) if i not in held])
    as_well = jnp.max(jnp.abs(rates)) <= allowed
    u = tuple(jnp.where(as_well, a, b) for a, b in zip(closed, u))
    return x, u, imbalance <= allowed


_rest = jax.jit(rest, static_argnames="held")


def _rest_of_elements(plant, y, words, inflow, shared, held):
    """(levels, inputs) at rest of a network of any elements; an input may be below its limit."""
    if shared is None and not (plant.plain and plant.pipes):
        check_rest(plant, "steady state")
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda v: np.asarray(v, dtype=float), (plant, y, inflow, shared))
        for start in starts(plant, y, shared):
            x, u, still = _rest(*exact[:3], start, shared=exact[3], held=held)
            if still:
                return np.array(x), np.array(u)
    raise _no_steady_state(words, plant, shared, held)


def _no_steady_state(words, plant, shared, held):
    """The EquilibriumError of outputs without a steady state: it names tanks without an input."""
    tanks = _without_input(plant, shared, held)
    if not tanks:
        return EquilibriumError(f"{words} have no steady state")
    together = " together" if len(tanks) > 1 else ""
    apart = ", so that the levels cannot be set independently" * (len(plant.outputs) > 1)
    return EquilibriumError(
        f"{words} have no steady state: no input that the controller moves changes the net inflow"
        f" of {labels_of(plant, 'tank', tanks)}{together}{apart}"
    )


def _without_input(plant, shared, held):
    if plant.tanks >= vectors.FROM:  # a program for each tank would be traced for minutes
        return []
    rows = [i for i in range(plant.tanks) if i not in held]
    free = [i for i in rows if i not in plant.outputs]
    first, random = _first_inputs(plant), np.random.default_rng(0)
    if shared is not None:
        first = np.full(len(plant.outputs), max(first, default=0.0))
    heights = np.minimum(np.asarray(plant.rim, dtype=float), 1e6)

    def slopes(levels):
        def rates(z):
            x = [*levels]
            for value, i in zip(z, free):
                x[i] = value
            u = z[len(free) :]
            u = tuple(u if shared is None else shared(u))
            net = elements.net_flows(plant, tuple(x), u, None)
            return jnp.stack([net[i] for i in rows])

        with jax.enable_x64(True):
            return np.asarray(jax.jacfwd(rates)(jnp.asarray([*(levels[i] for i in free), *first])))

    # at any levels: at those of the setpoints a port may be above one, or a check valve closed
    for _ in range(STARTS):
        matrix = slopes(random.uniform(0.02, 0.98, plant.tanks) * heights)
        if not np.all(np.isfinite(matrix)):
            return []
        largest = np.abs(matrix).max(axis=0)
        modes, sizes, _ = np.linalg.svd(matrix / np.where(largest > 0.0, largest, 1.0))
        null = np.abs(modes[:, sizes < 1e-9 * sizes[0]]).max(axis=1, initial=0.0) > 1e-6
        if not null.any():
            return []
    return [i for i, idle in zip(rows, null) if idle]


def circuit_at_rest(plant: Any, y: Any, x0: Any, first: Any, inflow: Any = None) -> Any:
    """(levels, inputs) at rest with outputs y of tanks that keep the volume of levels x0, searched
    from inputs `first`; None of a plant that is no such circuit, and without a rest."""
    if not isinstance(plant, TankNetwork) or not (closed := elements.closed_circuit(plant)):
        return None
    start, outputs = np.asarray(x0, dtype=float), list(plant.outputs)
    free = [i for i in range(plant.tanks) if i not in outputs]
    flow = tuple(np.zeros(plant.tanks) if inflow is None else np.asarray(inflow))
    area = np.asarray(plant.area, dtype=float)
    total = lambda x: float(sum(elements.stored(plant, tuple(x))[i] for i in closed))

    def levels(z):
        x = start.copy()
        x[outputs], x[free] = y, z[: len(free)]
        return x

    def residual(z):
        x = levels(z)
        rates = plant.derivative(0.0, tuple(x), tuple(z[len(free) :]), flow)
        missing = (total(x) - volume) / volume
        return np.append(np.asarray(rates, dtype=float) * area / volume, missing)

    if (volume := total(start)) == 0.0:
        return None
    first = np.concatenate([start[free], np.asarray(first, dtype=float)])
    with jax.enable_x64(True):
        rest = scipy.optimize.least_squares(residual, first, x_scale="jac", xtol=1e-15, ftol=1e-15)
    if not np.max(np.abs(rest.fun)) < 1e-7 or np.any(rest.x[: len(free)] < 0.0):
        return None
    return levels(rest.x), rest.x[len(free) :]
