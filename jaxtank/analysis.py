"""What can be said of a rig before it is run: steady states."""

import jax.numpy as jnp
import numpy as np

from jaxtank.errors import EquilibriumError, InputError


def steady_flows(plant, y):
    """Solve the balance of every tank for steady outputs y; linear in the efflux speeds, so no iteration.

    plant: TankNetwork with as many pumps as outputs; y: (outputs,) levels [cm]. Returns (speeds (n) [cm/s], voltages (m) [V]),
    which may be negative: then no steady state exists. Differentiable in the plant's leaves and in y.
    """
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
    for i, level in zip(plant.outputs, y):
        if not (np.isfinite(level) and level >= 0):
            raise InputError(f"setpoint of tank {i + 1} = {level} cm: must be a finite level at or above 0 cm")
    speeds, u = (np.asarray(a, dtype=float) for a in steady_flows(plant, y))
    at = ", ".join(f"{v:g}" for v in y)
    if not (np.all(np.isfinite(speeds)) and np.all(np.isfinite(u))):
        raise EquilibriumError(f"outputs ({at}) cm have no unique steady state: the pumps cannot move the outputs independently")
    tolerance = 1e-9 * max(1.0, float(np.max(np.abs(speeds))))
    for i, v in enumerate(speeds):
        if v < -tolerance:
            raise EquilibriumError(
                f"outputs ({at}) cm have no steady state: tank {i + 1} would have to pour {-v:.3g} cm/s backwards (below empty)"
            )
    for j, volts in enumerate(u):
        if volts < -1e-9 * max(1.0, float(np.max(np.abs(u)))):
            raise EquilibriumError(f"outputs ({at}) cm have no steady state: pump {j + 1} would have to run at {volts:.3g} V")
    return np.maximum(speeds, 0.0) ** 2 / (2.0 * float(plant.gravity)), np.maximum(u, 0.0)
