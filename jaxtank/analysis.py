"""What can be said of a rig before it is run: steady states, linear models."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from jaxtank.errors import EquilibriumError, InputError


def steady_flows(plant, y):
    """Solve the balance of every tank for steady outputs y; linear in the efflux speeds, so no iteration.

    plant: TankNetwork without pipes, with as many pumps as outputs; y: (outputs,) levels [cm]. Returns (speeds (n) [cm/s], voltages
    (m) [V]), which may be negative: then no steady state exists. Differentiable in the plant's leaves and in y.
    """
    if plant.pipes:
        raise InputError("steady_flows is for networks whose orifices discharge freely; with pipes use equilibrium")
    n, m = plant.tanks, plant.pumps
    if m != len(plant.outputs):
        raise InputError(f"equilibrium needs as many pumps as outputs: this rig has {m} and {len(plant.outputs)}")
    w = jnp.sqrt(2.0 * plant.gravity)
    eye = np.eye(n)
    out = plant.drain
    for k, (source, _) in enumerate(plant.links):
        out = out + plant.orifice[k] * eye[source]
    balance = -jnp.diag(out)
    for k, (source, sink) in enumerate(plant.links):
        balance = balance + plant.orifice[k] * np.outer(eye[sink], eye[source])
    pumps = jnp.zeros((n, m))
    for j, (first, second) in enumerate(plant.feeds):
        share = 1.0 if second is None else plant.split[j]
        pumps = pumps + share * plant.pump_gain[j] * np.outer(eye[first], np.eye(m)[j])
        if second is not None:
            pumps = pumps + (1.0 - share) * plant.pump_gain[j] * np.outer(eye[second], np.eye(m)[j])
    free = [i for i in range(n) if i not in plant.outputs]
    known = w * jnp.sqrt(jnp.asarray(y))
    columns = jnp.concatenate([balance[:, np.array(free, dtype=int)], pumps], axis=1)
    solution = jnp.linalg.solve(columns, -balance[:, np.array(plant.outputs)] @ known)
    speeds = jnp.zeros(n)
    for value, i in [*zip(known, plant.outputs), *zip(solution[: len(free)], free)]:
        speeds = speeds + value * eye[i]
    return speeds, solution[len(free) :]


def equilibrium(plant, y):
    """Steady levels and voltages for outputs y: x' = 0 with h_outputs = y (gouta2015: spec 2.1).

    plant: TankNetwork; y: (outputs,) levels [cm]. Returns (levels (n) [cm], voltages (m) [V]) as host arrays.
    Raises EquilibriumError, naming the tank or the pump, where a steady state would need a negative flow.
    """
    y = np.asarray(y, dtype=float)
    length, drive = plant.units
    for i, level in zip(plant.outputs, y):
        if not (np.isfinite(level) and level >= 0):
            raise InputError(f"setpoint of tank {i + 1} = {level} {length}: must be a finite level at or above 0 {length}")
    at = ", ".join(f"{v:g}" for v in y)
    if plant.pipes:
        x, u = _balanced(plant, y, f"outputs ({at}) {length}")
    else:
        speeds, u = (np.asarray(a, dtype=float) for a in steady_flows(plant, y))
        if not (np.all(np.isfinite(speeds)) and np.all(np.isfinite(u))):
            raise EquilibriumError(
                f"outputs ({at}) {length} have no unique steady state: the pumps cannot move the outputs independently"
            )
        tolerance = 1e-9 * max(1.0, float(np.max(np.abs(speeds))))
        for i, v in enumerate(speeds):
            if v < -tolerance:
                raise EquilibriumError(
                    f"outputs ({at}) {length} have no steady state: tank {i + 1} would have to pour {-v:.3g} {length}/s backwards "
                    "(below empty)"
                )
        x = np.maximum(speeds, 0.0) ** 2 / (2.0 * float(plant.gravity))
    for j, volts in enumerate(u):
        if volts < -1e-9 * max(1.0, float(np.max(np.abs(u)))):
            raise EquilibriumError(
                f"outputs ({at}) {length} have no steady state: pump {j + 1} would have to run at {volts:.3g} {drive}"
            )
    return x, np.maximum(u, 0.0)


def _balanced(plant, y, words):
    """(levels, inputs) at which a network with pipes stands still, by damped Gauss-Newton in the roots of the unknown levels."""
    free = [i for i in range(plant.tanks) if i not in plant.outputs]
    if plant.pumps != len(plant.outputs):
        raise InputError(f"equilibrium needs as many pumps as outputs: this rig has {plant.pumps} and {len(plant.outputs)}")
    with jax.enable_x64(True):
        rate = jax.jit(lambda x, u: jnp.stack(plant.derivative(0.0, tuple(x), tuple(u), None)))
        slope = jax.jit(jax.jacfwd(rate, argnums=(0, 1)))
    scale = float(np.max(y)) or 1.0
    gain = float(np.min(plant.pump_gain)) / float(np.max(plant.area))  # level rate per unit of input

    def split(z):
        x = np.zeros(plant.tanks)
        x[list(plant.outputs)], x[free] = y, scale * z[: len(free)] ** 2
        return x, z[len(free) :] / gain

    def residual(z):
        with jax.enable_x64(True):
            return np.asarray(rate(*split(z)))

    def jacobian(z):
        with jax.enable_x64(True):
            by_x, by_u = (np.asarray(a) for a in slope(*split(z)))
        return np.concatenate([by_x[:, free] * (2.0 * scale * z[: len(free)]), by_u / gain], axis=1)

    start = np.concatenate([np.full(len(free), 0.9), np.full(plant.pumps, 1e-3 * scale)])
    found = least_squares(residual, start, jac=jacobian, xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac", max_nfev=500)
    rough = float(np.max(np.abs(plant.drain))) / float(np.min(plant.area)) * np.sqrt(2.0 * float(plant.gravity) * scale)
    if not np.max(np.abs(found.fun)) < 1e-9 * max(rough, 1e-12):
        raise EquilibriumError(f"{words} have no steady state")
    return split(found.x)


def linearise(plant, x, u):
    """(A (n, n), B (n, m), C (p, n)) of the rig at levels x (n) and inputs u (m): delta x' = A delta x + B delta u, y = C delta x.

    Exact derivatives of `plant.derivative`; differentiable in everything. A pipe between equal levels has slope sqrt(2 g / knee).
    """
    x, u = jnp.asarray(x, dtype=float), jnp.asarray(u, dtype=float)
    A, B = jax.jacfwd(lambda x, u: jnp.stack(plant.derivative(0.0, tuple(x), tuple(u), None)), argnums=(0, 1))(x, u)
    return A, B, jnp.eye(plant.tanks)[np.array(plant.outputs)]
