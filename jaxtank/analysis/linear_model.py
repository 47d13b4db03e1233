"""Linear models of a rig about a steady state: gains, interaction, transmission zeros."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank.analysis.elimination import inverse, solve_all
from jaxtank.core.errors import InputError


def linearise(plant, x, u, inflow=None):
    """Return the linear model of a rig: delta x' = A delta x + B delta u, y = C delta x.

    Exact derivatives of `plant.derivative`; differentiable in everything. A pipe between equal
    levels has slope sqrt(2 g / laminar threshold). Rates that depend on time are those of t = 0.

    Parameters
    ----------
    plant : Plant
    x : (n,) levels [cm]
    u : (m,) inputs [V]
    inflow : (n,) steady inflow that no pump brings [cm^3/s], None without any: it counts where the
        area of a tank changes with its level

    Returns
    -------
    (A (n, n) [1/s], B (n, m) [cm/(s V)], C (outputs, n) [-])

    Examples
    --------
    >>> from jaxtank.plants import network
    >>> tank = network(area=[25.0], drain=[0.3], pump_gain=[8.0], feeds=[(0, None)], rim=[30.0])
    >>> A, B, C = linearise(tank, (4.0,), (3.0,))
    >>> round(float(A[0, 0]), 4), round(float(B[0, 0]), 4)
    (-0.1329, 0.32)
    """
    x, u = jnp.asarray(x, dtype=float), jnp.asarray(u, dtype=float)
    d = None if inflow is None else tuple(inflow)
    rates = lambda x, u: jnp.stack(plant.derivative(0.0, tuple(x), tuple(u), d))
    A, B = jax.jacfwd(rates, argnums=(0, 1))(x, u)
    return A, B, jnp.eye(plant.tanks)[np.array(plant.outputs)]


linearise_compiled = jax.jit(linearise)
"""`linearise` of numbers, by one program instead of fifty small ones."""


def steady_gain(A, B, C):
    """Return G(0) = -C A^-1 B (p, m) [cm/V], of a linear model without a pole at 0.

    Examples
    --------
    >>> steady_gain(jnp.array([[-2.0]]), jnp.array([[4.0]]), jnp.array([[1.0]])).tolist()
    [[2.0]]
    """
    return -C @ solve_all(A, B)


def relative_gain_array(A, B, C):
    """Return Bristol's relative gains of the steady gain, G(0) o (G(0)^-1)' (m, m) [-].

    Entry (i, j): gain from input j to output i with the other loops open, over that with the other
    outputs held. A negative one forbids the pairing. For the quadruple tank the first is gamma1
    gamma2 / (gamma1 + gamma2 - 1) (Johansson 2000).

    Parameters
    ----------
    A, B, C : linear model with as many outputs as inputs

    Examples
    --------
    >>> A, B = -jnp.eye(2), jnp.array([[2.0, 1.0], [1.0, 2.0]])
    >>> [round(float(v), 3) for v in relative_gain_array(A, B, jnp.eye(2))[0]]
    [1.333, -0.333]
    """
    G = steady_gain(A, B, C)
    return G * inverse(G).T


def transmission_zeros(A, B, C):
    """Return the finite transmission zeros of a square linear model, by decreasing real part.

    The finite generalised eigenvalues of ([[A, B], [C, 0]], diag(I, 0)). A zero in the right half
    plane limits how fast the outputs can be held, whatever the controller.

    Parameters
    ----------
    A, B, C : linear model with as many outputs as inputs

    Returns
    -------
    (zeros,) host array [1/s], real where all are real

    Raises
    ------
    InputError for a model that is not square.

    Examples
    --------
    >>> A, B, C = [[-1.0, 0.0], [0.0, -2.0]], [[1.0], [-1.0]], [[1.0, 2.0]]
    >>> transmission_zeros(A, B, C).round(6).tolist()
    [0.0]
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
    real = np.all(np.abs(zeros.imag) < 1e-9 * np.abs(zeros).max(initial=1e-300))
    return zeros.real if real else zeros


def zero_direction(A, B, C, zero):
    """Return the output direction of a transmission zero: y of y^H G(zero) = 0.

    That combination of the outputs has the zero; outputs across it need not.

    Parameters
    ----------
    A, B, C : linear model
    zero : transmission zero [1/s]

    Returns
    -------
    (p,) unit vector, its largest entry positive

    Examples
    --------
    >>> A, B, C = -np.eye(2), np.array([[1.0, 0.0], [0.0, 0.0]]), np.eye(2)
    >>> zero_direction(A, B, C, 0.5).real.tolist()
    [0.0, 1.0]
    """
    A, B, C = (np.asarray(a) for a in (A, B, C))
    G = C @ np.linalg.solve(zero * np.eye(len(A)) - A, B)
    y = np.linalg.svd(G)[0][:, -1]
    largest = y[np.argmax(np.abs(y))]
    return y * np.conj(largest) / np.abs(largest)
