"""What can be said of a rig before it is run: steady states, linear models."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank.core.errors import EquilibriumError, InputError
from jaxtank.core.numerics import smooth_sqrt


def _balance(plant, xp=jnp):
    """(efflux, pumps): A_i h_i' = efflux @ speeds + pumps @ inputs, of a network without pipes; (n,
    n) [cm^2] and (n, m) [cm^3/(s V)].
    """
    n, m, eye = plant.tanks, plant.pumps, np.eye(plant.tanks)
    out = plant.drain
    for k, (source, _) in enumerate(plant.links):
        out = out + plant.orifice[k] * eye[source]
    efflux = -xp.diag(out)
    for k, (source, sink) in enumerate(plant.links):
        efflux = efflux + plant.orifice[k] * np.outer(eye[sink], eye[source])
    pumps = xp.zeros((n, m))
    for j, (first, second) in enumerate(plant.feeds):
        share = 1.0 if second is None else plant.split[j]
        pumps = pumps + share * plant.pump_gain[j] * np.outer(eye[first], np.eye(m)[j])
        if second is not None:
            pumps = pumps + (1.0 - share) * plant.pump_gain[j] * np.outer(eye[second], np.eye(m)[j])
    return efflux, pumps


def steady_flows(plant, y):
    """Solve the balance of every tank for steady outputs y; linear in the efflux speeds, so no
    iteration.

    plant: TankNetwork without pipes, with as many pumps as outputs; y: (outputs,) levels [cm].
    Returns (speeds (n) [cm/s], voltages (m) [V]), which may be negative: then no steady state
    exists. Differentiable in the plant's leaves and in y.
    """
    return _from_known_speeds(plant, jnp.sqrt(2.0 * plant.gravity) * jnp.sqrt(jnp.asarray(y)))


def _from_known_speeds(plant, known, xp=jnp):
    """`steady_flows` for the efflux speeds (outputs) [cm/s] of the controlled tanks, in which it is
    linear; xp: jax.numpy, or numpy where nothing is to be differentiated, which spares thirty
    little compilations.
    """
    if plant.pipes:
        raise InputError(
            "steady_flows is for networks whose orifices discharge freely; with pipes use"
            " equilibrium"
        )
    n, m = plant.tanks, plant.pumps
    if m != len(plant.outputs):
        raise InputError(
            f"equilibrium needs as many pumps as outputs: this rig has {m} and {len(plant.outputs)}"
        )
    eye, (efflux, pumps) = np.eye(n), _balance(plant, xp)
    free = [i for i in range(n) if i not in plant.outputs]
    columns = xp.concatenate([efflux[:, np.array(free, dtype=int)], pumps], axis=1)
    solution = xp.linalg.solve(columns, -efflux[:, np.array(plant.outputs)] @ known)
    speeds = xp.zeros(n)
    for value, i in [*zip(known, plant.outputs), *zip(solution[: len(free)], free)]:
        speeds = speeds + value * eye[i]
    return speeds, solution[len(free) :]


def steady_along(plant: Any, r: tuple[Any, ...]) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """The steady state of every sample of a reference: what a law of state feedback prepares before
    the loop.

    plant: as in `steady_flows`; r: tuple of arrays (samples,), one per output [cm]. Returns
    (levels, inputs): tuples of arrays (samples,) [cm], [V]. Each is linear in the roots of r, so
    the balance is solved once per output and not per sample. No check: where no steady state
    exists, an input or the flow behind a level is negative.
    """
    roots = [smooth_sqrt(v, plant.knee) for v in r]
    parts = [
        _from_known_speeds(plant, jnp.sqrt(2.0 * plant.gravity) * one) for one in np.eye(len(r))
    ]
    speeds = tuple(sum(part[0][i] * q for part, q in zip(parts, roots)) for i in range(plant.tanks))
    inputs = tuple(sum(part[1][j] * q for part, q in zip(parts, roots)) for j in range(plant.pumps))
    return tuple(v * v / (2.0 * plant.gravity) for v in speeds), inputs


def steady_levels(plant, u):
    """Levels (n) [cm] at which a network without pipes stands still while its pumps run at u (m) >=
    0 [V]. Differentiable.
    """
    if plant.pipes:
        raise InputError("steady_levels is for networks whose orifices discharge freely")
    efflux, pumps = _balance(plant)
    speeds = jnp.linalg.solve(efflux, -pumps @ jnp.asarray(u, dtype=float))
    return speeds * speeds / (2.0 * plant.gravity)


def equilibrium(plant, y):
    """Steady levels and voltages for outputs y: x' = 0 with h_outputs = y (gouta2015 notes S2.3).

    plant: TankNetwork; y: (outputs,) levels [cm]. Returns (levels (n) [cm], voltages (m) [V]) as
    host arrays. Raises EquilibriumError, naming the tank or the pump, where a steady state would
    need a negative flow.
    """
    y = np.asarray(y, dtype=float)
    length, drive = plant.units
    for i, level in zip(plant.outputs, y):
        if not (np.isfinite(level) and level >= 0):
            raise InputError(
                f"setpoint of tank {i + 1} = {level} {length}: must be a finite level at or above 0"
                f" {length}"
            )
    at = ", ".join(f"{v:g}" for v in y)
    if plant.pipes:
        x, u = _balanced(plant, y, f"outputs ({at}) {length}")
    else:
        with np.errstate(all="ignore"):  # what overflows is told below
            try:
                speeds, u = _from_known_speeds(
                    plant, np.sqrt(2.0 * float(plant.gravity)) * np.sqrt(y), np
                )
            except np.linalg.LinAlgError:
                speeds = u = np.array([np.nan])
            x = np.maximum(speeds, 0.0) ** 2 / (2.0 * float(plant.gravity))
        if not all(np.all(np.isfinite(v)) for v in (speeds, u, x)):
            raise EquilibriumError(
                f"outputs ({at}) {length} have no unique steady state: the pumps cannot move the"
                " outputs independently"
            )
        tolerance = 1e-9 * max(1.0, float(np.max(np.abs(speeds))))
        for i, v in enumerate(speeds):
            if v < -tolerance:
                raise EquilibriumError(
                    f"outputs ({at}) {length} have no steady state: tank {i + 1} would have to pour"
                    f" {-v:.3g} {length}/s backwards (below empty)"
                )
    for j, volts in enumerate(u):
        if volts < -1e-9 * max(1.0, float(np.max(np.abs(u)))):
            raise EquilibriumError(
                f"outputs ({at}) {length} have no steady state: pump {j + 1} would have to run at"
                f" {volts:.3g} {drive}"
            )
    return x, np.maximum(u, 0.0)


@jax.jit
def _rate(plant, x, u):
    """Rates (n) [cm/s] at levels x (n) and inputs u (m); the plant is an argument, so that rigs of
    one topology share a program.
    """
    return plant.rates(x, u)


_slope = jax.jit(jax.jacfwd(_rate, argnums=(1, 2)))


def _balanced(plant, y, words):
    """(levels, inputs) at which a network with pipes stands still, by damped Gauss-Newton in the
    roots of the unknown levels.
    """
    free = [i for i in range(plant.tanks) if i not in plant.outputs]
    if plant.pumps != len(plant.outputs):
        raise InputError(
            f"equilibrium needs as many pumps as outputs: this rig has {plant.pumps} and"
            f" {len(plant.outputs)}"
        )
    scale = float(np.max(y)) or 1.0
    # level rate per unit of input
    gain = float(np.min(plant.pump_gain)) / float(np.max(plant.area))

    def split(z):
        x = np.zeros(plant.tanks)
        x[list(plant.outputs)], x[free] = y, scale * z[: len(free)] ** 2
        return x, z[len(free) :] / gain

    def residual(z):
        with jax.enable_x64(True):
            return np.asarray(_rate(plant, *split(z)))

    def jacobian(z):
        with jax.enable_x64(True):
            by_x, by_u = (np.asarray(a) for a in _slope(plant, *split(z)))
        return np.concatenate([by_x[:, free] * (2.0 * scale * z[: len(free)]), by_u / gain], axis=1)

    start = np.concatenate([np.full(len(free), 0.9), np.full(plant.pumps, 1e-3 * scale)])
    try:
        # an area of 1e-300, say, overflows on the way: the answer below is all that need be said of
        # it
        with np.errstate(all="ignore"):
            found = scipy.optimize.least_squares(
                residual,
                start,
                jac=jacobian,
                xtol=1e-15,
                ftol=1e-15,
                gtol=1e-15,
                x_scale="jac",
                max_nfev=500,
            )
    except (ValueError, np.linalg.LinAlgError):  # not finite where it starts, or on the way
        raise EquilibriumError(f"{words} have no steady state") from None
    rough = (
        float(np.max(np.abs(plant.drain)))
        / float(np.min(plant.area))
        * np.sqrt(2.0 * float(plant.gravity) * scale)
    )
    if not np.max(np.abs(found.fun)) < 1e-9 * max(rough, 1e-12):
        raise EquilibriumError(f"{words} have no steady state")
    return split(found.x)


def linearise(plant, x, u):
    """(A (n, n), B (n, m), C (p, n)) of the rig at levels x (n) and inputs u (m): delta x' = A
    delta x + B delta u, y = C delta x.

    Exact derivatives of `plant.derivative`; differentiable in everything. A pipe between equal
    levels has slope sqrt(2 g / knee).
    """
    x, u = jnp.asarray(x, dtype=float), jnp.asarray(u, dtype=float)
    A, B = jax.jacfwd(
        lambda x, u: jnp.stack(plant.derivative(0.0, tuple(x), tuple(u), None)), argnums=(0, 1)
    )(x, u)
    return A, B, jnp.eye(plant.tanks)[np.array(plant.outputs)]


def steady_gain(A, B, C):
    """G(0) = -C A^-1 B (p, m) [cm/V], of a linear model without a pole at 0."""
    return -C @ jnp.linalg.solve(A, B)


def relative_gain_array(A, B, C):
    """Bristol's relative gains of the steady gain, G(0) o (G(0)^-1)' (m, m) [-], of a model with as
    many outputs as inputs.

    Entry (i, j): gain from input j to output i with the other loops open, over that with the other
    outputs held. A negative one forbids the pairing. For the quadruple tank the first is gamma1
    gamma2 / (gamma1 + gamma2 - 1) (Johansson 2000).
    """
    G = steady_gain(A, B, C)
    return G * jnp.linalg.inv(G).T


def transmission_zeros(A, B, C):
    """Finite transmission zeros [1/s] of a square linear model, by decreasing real part: host
    array, real where all are real.

    The finite generalised eigenvalues of ([[A, B], [C, 0]], diag(I, 0)), as many outputs as inputs.
    A zero in the right half plane limits how fast the outputs can be held, whatever the law.
    """
    A, B, C = (np.asarray(a, dtype=float) for a in (A, B, C))
    n, m = B.shape
    if C.shape[0] != m:
        raise InputError(
            f"transmission_zeros needs as many outputs as inputs: this model has {C.shape[0]}"
            f" and {m}"
        )
    pencil = np.block([[A, B], [C, np.zeros((m, m))]])
    mass = np.diag([1.0] * n + [0.0] * m)
    alpha, beta = scipy.linalg.eig(pencil, mass, right=False, homogeneous_eigvals=True)
    finite = np.abs(beta) > 1e-10 * np.abs(alpha)
    zeros = alpha[finite] / beta[finite]
    zeros = zeros[np.argsort(-zeros.real)]
    return (
        zeros.real
        if np.all(np.abs(zeros.imag) < 1e-9 * np.abs(zeros).max(initial=1e-300))
        else zeros
    )


def zero_direction(A, B, C, zero):
    """Output direction of a transmission zero [1/s]: the unit vector y (p) of y^H G(zero) = 0, its
    largest entry made positive.

    That combination of the outputs shows the zero; outputs across it need not.
    """
    A, B, C = (np.asarray(a) for a in (A, B, C))
    G = C @ np.linalg.solve(zero * np.eye(len(A)) - A, B)
    y = np.linalg.svd(G)[0][:, -1]
    largest = y[np.argmax(np.abs(y))]
    return y * np.conj(largest) / np.abs(largest)
