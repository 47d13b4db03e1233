"""The four-tank under backstepping as a user would write it, without jaxtank: for numpy, jax.numpy,
casadi and numba.
"""

import numpy as np


def coefficients(A, d, o, g, gravity):
    """(c (10,) of the rates, (6,) of the decoupling) of areas, drains, orifices and pump gains."""
    w = np.sqrt(2 * gravity)
    c = np.array(
        [
            d[0] * w / A[0], o[0] * w / A[0], o[2] * w / A[0], d[1] * w / A[1], o[1] * w / A[1],
            o[3] * w / A[1],
            (o[0] + o[1]) * w / A[2], g[0] / A[2], (o[2] + o[3]) * w / A[3], g[1] / A[3],
        ]
    )  # fmt: skip
    alpha = 0.5 * (c[1] * c[5] - c[2] * c[4])
    b = np.array([c[5], c[2], c[4], c[1]]) / (alpha * np.array([c[7], c[7], c[9], c[9]]))
    return c, np.append(b, [c[6] / c[7], c[8] / c[9]])


def controller(c, gain, k1, b, floor, high, x, r, np):
    """(2) voltages of the law, with the roots and clips of `np` (numpy or jax.numpy)."""
    s3, s4 = np.sqrt(np.maximum(x[2], floor)), np.sqrt(np.maximum(x[3], floor))
    v1 = -gain * (c[1] * s3 + c[2] * s4 - c[0] * np.sqrt(r[0]) + k1 * (x[0] - r[0]))
    v2 = -gain * (c[4] * s3 + c[5] * s4 - c[3] * np.sqrt(r[1]) + k1 * (x[1] - r[1]))
    u1, u2 = s3 * (b[0] * v1 - b[1] * v2 + b[4]), s4 * (b[3] * v2 - b[2] * v1 + b[5])
    return np.clip(u1, 0.0, high), np.clip(u2, 0.0, high)


def field(c, x, u, np):
    """(4) rates of the levels."""
    s1, s2, s3, s4 = (np.sqrt(np.maximum(h, 0.0)) for h in x)
    return (
        c[1] * s3 + c[2] * s4 - c[0] * s1,
        c[4] * s3 + c[5] * s4 - c[3] * s2,
        c[7] * u[0] - c[6] * s3,
        c[9] * u[1] - c[8] * s4,
    )


def runge_kutta(f, x, h):
    """Four stages, as tuples."""
    along = lambda k, by: tuple(a + by * q for a, q in zip(x, k))
    k1 = f(x)
    k2 = f(along(k1, 0.5 * h))
    k3 = f(along(k2, 0.5 * h))
    k4 = f(along(k3, h))
    return tuple(a + h / 6 * (p + 2 * (q + s) + t) for a, p, q, s, t in zip(x, k1, k2, k3, k4))


def numba_loop(c, b, floor, high):
    """run(r (2, samples), k + k1, k1, four levels, dt): (RMS error, four highest levels)."""
    import numba

    @numba.njit(fastmath=False)
    def rates(x1, x2, x3, x4, u1, u2):
        s1, s2, s3, s4 = (
            np.sqrt(max(x1, 0.0)),
            np.sqrt(max(x2, 0.0)),
            np.sqrt(max(x3, 0.0)),
            np.sqrt(max(x4, 0.0)),
        )
        return (
            c[1] * s3 + c[2] * s4 - c[0] * s1,
            c[4] * s3 + c[5] * s4 - c[3] * s2,
            c[7] * u1 - c[6] * s3,
            c[9] * u2 - c[8] * s4,
        )

    @numba.njit(fastmath=False)
    def run(r, gain, k1, x1, x2, x3, x4, h):
        total, top1, top2, top3, top4 = 0.0, x1, x2, x3, x4
        for i in range(r.shape[1]):
            r1, r2 = r[0, i], r[1, i]
            s3, s4 = np.sqrt(max(x3, floor)), np.sqrt(max(x4, floor))
            v1 = -gain * (c[1] * s3 + c[2] * s4 - c[0] * np.sqrt(r1) + k1 * (x1 - r1))
            v2 = -gain * (c[4] * s3 + c[5] * s4 - c[3] * np.sqrt(r2) + k1 * (x2 - r2))
            u1 = min(max(s3 * (b[0] * v1 - b[1] * v2 + b[4]), 0.0), high)
            u2 = min(max(s4 * (b[3] * v2 - b[2] * v1 + b[5]), 0.0), high)
            total += (x1 - r1) ** 2 + (x2 - r2) ** 2
            top1, top2, top3, top4 = max(top1, x1), max(top2, x2), max(top3, x3), max(top4, x4)
            a1, a2, a3, a4 = rates(x1, x2, x3, x4, u1, u2)
            b1, b2, b3, b4 = rates(
                x1 + 0.5 * h * a1, x2 + 0.5 * h * a2, x3 + 0.5 * h * a3, x4 + 0.5 * h * a4, u1, u2
            )
            c1, c2, c3, c4 = rates(
                x1 + 0.5 * h * b1, x2 + 0.5 * h * b2, x3 + 0.5 * h * b3, x4 + 0.5 * h * b4, u1, u2
            )
            d1, d2, d3, d4 = rates(x1 + h * c1, x2 + h * c2, x3 + h * c3, x4 + h * c4, u1, u2)
            x1 += h / 6 * (a1 + 2 * (b1 + c1) + d1)
            x2 += h / 6 * (a2 + 2 * (b2 + c2) + d2)
            x3 += h / 6 * (a3 + 2 * (b3 + c3) + d3)
            x4 += h / 6 * (a4 + 2 * (b4 + c4) + d4)
        return np.sqrt(total / r.shape[1]), top1, top2, top3, top4

    return run


def casadi_names():
    """What `controller` and `field` call, as of casadi."""
    import casadi as ca

    class Names:
        sqrt, maximum = staticmethod(ca.sqrt), staticmethod(ca.fmax)
        clip = staticmethod(lambda v, low, top: ca.fmin(ca.fmax(v, low), top))

    return Names
