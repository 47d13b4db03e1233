"""Stability margins of a sampled open loop: peaks of the sensitivity and of the complementary
sensitivity, gain, phase and delay margin.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.analysis import frequency as fr
from jaxtank.analysis.elimination import solve_all
from jaxtank.analysis.frequency import OpenLoop

POINTS = 224  # frequencies of the grid, evenly spaced in their logarithm

DELAYED, TURN = 96, 50.0
"""Further frequencies with a dead time, evenly spaced up to TURN rad of its phase."""

MANY, SHORT, LONG = 8, 100, 600
"""Samples of dead time of all inputs up to which stability is that of a matrix with a state for
each: SHORT, and LONG of more than MANY inputs."""

LOWEST = 1e-7  # lowest frequency of the grid, as a share of the Nyquist frequency [-]

PEAKS = 2  # of the sensitivity and of the complementary sensitivity

ZOOMS, ZOOM = 5, 15
"""The bracket of a peak is narrowed by a factor of 7 or more ZOOMS times, with ZOOM points."""

CLOSER = 10
"""The same, where no Newton step follows: it is then narrower than 1e-9 of a frequency."""

ASIDE = 0.02
"""A bracket of a crossover is cut in the middle, where a straight line through its ends crosses,
and at this share of its width on both sides of that: it shrinks by half, or by a factor of 25."""


class Margins(NamedTuple):
    """Margins of m loops; inf where nothing crosses, valid only if `stable`."""

    stable: Any  # True if the closed loop is stable
    sensitivity_peak: Any  # Ms: largest singular value of S = (I + L)^-1 over all frequencies [-]
    complementary_peak: Any  # Mt: that of T = I - S [-]
    gain_margin: Any  # (m,) least factor, up or down, on the gain that makes the loop unstable [-]
    phase_margin: Any  # (m,) least change of the phase, either way, that does [deg]
    delay_margin: Any  # (m,) least additional dead time that does [s]
    peak_frequency: Any  # where the sensitivity peaks [rad/s]
    complementary_frequency: Any  # where T peaks [rad/s]
    gain_frequency: Any  # (m,) where the phase is -180 deg [rad/s]
    phase_frequency: Any  # (m,) where the gain is 1, for the phase margin [rad/s]
    delay_frequency: Any  # (m,) the same for the delay margin [rad/s]


def margins(loop: OpenLoop, slopes: bool = True) -> Margins:
    """Return the Margins of a loop, with derivatives of the margins by A, B and C."""
    # Peaks and crossovers are bracketed on a grid of frequencies and narrowed down; a peak does not
    # move to first order, a crossover is followed by one Newton step. At the Nyquist frequency,
    # where L is real, a negative L counts as a crossover of the phase.
    still = jax.lax.stop_gradient(loop._replace(dead=0))._replace(dead=loop.dead)
    form = fr.hessenberg(still)
    w = _grid(still)
    L, _ = fr.response(form, jnp.exp(1j * w * loop.dt))
    brackets = _brackets(w, L)
    if not slopes:
        log, L = _narrowed(form, brackets, CLOSER)
        S, stable = _sensitivity(L), _is_stable(still, form)
        return _margins_of(brackets.exists, jnp.exp(log), S, _largest_gain(_both(S)), stable)
    stop = jax.lax.stop_gradient(brackets.low)
    w_narrow = jnp.exp(jax.lax.stop_gradient(_narrowed(form, brackets, ZOOMS)[0]))
    return _values(loop, still, brackets._replace(low=stop), w_narrow, _is_stable(still, form))


def _is_stable(still: OpenLoop, form: OpenLoop) -> Any:
    """True if the closed loop is stable; with much dead time by the winding at |z| = 1 + RADIUS."""
    # between two frequencies that of many loops, or beside a light damping, may exceed half a turn
    inputs = still.B.shape[1]
    dead = np.broadcast_to(still.dead, inputs)
    if dead.sum() <= (LONG if inputs > MANY else SHORT):
        return fr.is_stable(_closed(still, dead))
    slow = jnp.exp(jnp.linspace(np.log(1e-3 * fr.RADIUS), np.log(LOWEST * np.pi), 24)[:-1])
    angles = jnp.concatenate([slow, _grid(still) * still.dt])
    L, det = fr.response(form, (1.0 + fr.RADIUS) * jnp.exp(1j * angles))
    turning = det * _det(jnp.eye(L.shape[1]) + L)
    turns = jnp.sum(jnp.angle(turning[1:] / turning[:-1])) / np.pi
    # near z = 1 and at -1 the polynomial is real, so that the lower half mirrors the upper one
    return jnp.abs(turns) < 0.5


def _closed(loop: OpenLoop, dead: Any) -> Any:
    """Matrix of the closed loop, with a state for each sample of the dead times (m,)."""
    K = loop.C if loop.inputs is None else loop.inputs @ loop.C
    n, at_once, place = len(loop.A), dead == 0, len(loop.A)
    closed = loop.A - loop.B[:, at_once] @ K[at_once]
    M = jnp.zeros((n + int(dead.sum()),) * 2, closed.dtype).at[:n, :n].set(closed)
    for i in np.flatnonzero(dead):
        last = place + int(dead[i]) - 1
        M = M.at[place, :n].set(-K[i]).at[:n, last].set(loop.B[:, i])
        M = M.at[np.arange(place + 1, last + 1), np.arange(place, last)].set(1.0)
        place = last + 1
    return M


def _grid(loop: OpenLoop) -> Any:
    """Frequencies [rad/s] from LOWEST to the Nyquist frequency, in increasing order."""
    nyquist = np.pi / loop.dt
    grid = nyquist * jnp.exp(jnp.linspace(np.log(LOWEST), 0.0, POINTS))
    if not np.any(loop.dead):
        return grid
    most = min(TURN / (np.max(loop.dead) * np.pi), 1.0)
    even = nyquist * jnp.linspace(0.0, most, DELAYED + 2)[1:-1]
    return jnp.sort(jnp.concatenate([grid, even]))


def _det(M: Any) -> Any:
    """Determinants of M (F, m, m)."""
    m = M.shape[1]
    if m == 1:
        return M[:, 0, 0]
    if m == 2:
        return M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] * M[:, 1, 0]
    inner = M[:, 1:, 1:] - M[:, 1:, :1] * M[:, :1, 1:] / M[:, :1, :1]
    return M[:, 0, 0] * _det(inner)


def _sensitivity(L: Any) -> Any:
    """S = (I + L)^-1 (F, m, m)."""
    M = jnp.eye(L.shape[1]) + L
    if L.shape[1] == 1:
        return 1.0 / M
    if L.shape[1] == 2:
        rows = [[M[:, 1, 1], -M[:, 0, 1]], [-M[:, 1, 0], M[:, 0, 0]]]
        return jnp.stack([jnp.stack(r, -1) for r in rows], -2) / _det(M)[:, None, None]
    return jax.vmap(lambda M: solve_all(M, jnp.eye(M.shape[0], dtype=M.dtype)))(M)


def _both(S: Any) -> Any:
    """S at the first and T = I - S at the second of its frequencies (2, m, m)."""
    return jnp.stack([S[0], jnp.eye(S.shape[1]) - S[1]])


def _alone(S: Any) -> Any:
    """(F, m) open loops of one input each, with the others closed: 1/S_ii - 1."""
    return 1.0 / jnp.diagonal(S, axis1=1, axis2=2) - 1.0


def _largest_gain(S: Any) -> Any:
    """Largest singular values (F,): closed form up to m = 2, else a lower bound by powers."""
    m, square = S.shape[1], jnp.sum(jnp.abs(S) ** 2, axis=(1, 2))
    if m == 1:
        return jnp.sqrt(square)
    if m == 2:
        inside = square**2 - 4.0 * jnp.abs(_det(S)) ** 2
        return jnp.sqrt(0.5 * (square + jnp.sqrt(jnp.maximum(inside, 0.0))))
    return jnp.sqrt(jax.vmap(lambda S: _pair(S)[2])(S))


def _pair(S: Any) -> tuple[Any, Any, Any]:
    """(u, v, sigma^2) of the largest singular value of S (m, m), by squaring S^H S."""
    P = jnp.conj(S).T @ S

    def square(_, P):
        P = P @ P
        return P / jnp.sqrt(jnp.sum(jnp.abs(P) ** 2))

    P = jax.lax.fori_loop(0, 30, square, P / jnp.sqrt(jnp.sum(jnp.abs(P) ** 2)))
    v = P[:, jnp.argmax(jnp.real(jnp.diagonal(P)))]
    v = v / jnp.sqrt(jnp.sum(jnp.abs(v) ** 2))
    u = S @ v
    size = jnp.sum(jnp.abs(u) ** 2)
    return u / jnp.sqrt(size), v, size


class _Brackets(NamedTuple):
    """Where the peaks, m phase crossovers, m gain crossovers (phase, delay) are: (2 + 3 m,)."""

    low: Any  # logarithm of a frequency [rad/s]
    high: Any
    at_low: Any  # what is 0 at a crossover, at both ends
    at_high: Any
    exists: Any  # False where nothing crosses
    inside: Any  # False for an end of the grid, which is no bracket


def _brackets(w: Any, L: Any) -> _Brackets:
    """Brackets of all that is looked for, from L (F, m, m) on the grid w (F,)."""
    log, S = jnp.log(w), _sensitivity(L)
    alone, last, zero = _alone(S), len(w) - 1, jnp.zeros_like(log[0])
    brackets = []
    for closed in (S, jnp.eye(S.shape[1]) - S):
        k = jnp.argmax(_largest_gain(closed))
        ends = log[jnp.maximum(k - 1, 0)], log[jnp.minimum(k + 1, last)]
        brackets.append((*ends, zero, zero, jnp.array(True), last > 0))
    rows = ([], [], [])
    for i in range(L.shape[1]):
        gain_of_input = alone[:, i]
        before, after = gain_of_input[:-1], gain_of_input[1:]
        rows[0].append(_phase_crossover(log, gain_of_input))
        size = jnp.log(jnp.maximum(jnp.abs(gain_of_input), 1e-300))
        crosses = (size[:-1] < 0.0) != (size[1:] < 0.0)
        share = size[:-1] / jnp.where(crosses, size[:-1] - size[1:], 1.0)
        middle = before + share * (after - before)
        angle = jnp.angle(middle)
        for row, worst in (
            (1, jnp.pi - jnp.abs(angle)),
            (2, jnp.mod(angle + jnp.pi, 2.0 * jnp.pi) / jnp.exp(0.5 * (log[1:] + log[:-1]))),
        ):
            j = jnp.argmin(jnp.where(crosses, worst, jnp.inf))
            rows[row].append((log[j], log[j + 1], size[j], size[j + 1], jnp.any(crosses), True))
    brackets += [bracket for row in rows for bracket in row]
    return _Brackets(*(jnp.stack([jnp.asarray(v) for v in column]) for column in zip(*brackets)))


def _phase_crossover(log: Any, L: Any) -> tuple[Any, ...]:
    """Bracket of the crossover of the phase of L (F,) whose gain is nearest to 1."""
    up, re = jnp.imag(L), jnp.real(L)
    crosses = (up[:-1] < 0.0) != (up[1:] < 0.0)
    share = up[:-1] / jnp.where(crosses, up[:-1] - up[1:], 1.0)
    there = re[:-1] + share * (re[1:] - re[:-1])
    crosses = crosses & (there < 0.0) & (re[:-1] < 0.0) & (re[1:] < 0.0)
    # the Nyquist frequency, and the lowest one where L is real there
    ends = jnp.stack([re[0], re[-1]])
    real = (ends < 0.0) & (jnp.abs(jnp.stack([up[0], 0.0 * up[-1]])) < 1e-3 * jnp.abs(ends))
    apart = jnp.concatenate([jnp.where(crosses, there, -jnp.inf), jnp.where(real, ends, -jnp.inf)])
    apart = jnp.abs(jnp.log(jnp.maximum(-apart, 1e-300)))
    j, last = jnp.argmin(apart), len(log) - 1
    end = j >= last
    where = jnp.where(j == last, 0, last)
    i, k = (jnp.where(end, where, jnp.minimum(v, last)) for v in (j, j + 1))
    return log[i], log[k], up[i], up[k], jnp.isfinite(apart[j]), ~end


def _alone_at(L: Any, which: Any) -> Any:
    """(F,) open loops of the inputs `which` (F,), with the others closed, of L (F, m, m)."""
    if L.shape[1] <= 2:
        return _alone(_sensitivity(L))[np.arange(len(which)), which]
    eye = np.eye(L.shape[1])

    def inverse(M: Any, column: Any) -> Any:
        return column @ solve_all(M, column[:, None].astype(M.dtype))[:, 0]

    return 1.0 / jax.vmap(inverse)(eye + L, eye[which]) - 1.0


class _Cut(NamedTuple):
    """Brackets of the crossovers while they shrink, and the best point of each up to now."""

    low: Any  # (3 m,) logarithm of a frequency [rad/s]
    high: Any
    at_low: Any  # what is 0 at the crossover, at both ends
    at_high: Any
    best: Any  # its least size at a point that was tried
    log: Any  # that point
    L: Any  # (3 m, m, m) the open loop there


def _narrowed(form: OpenLoop, brackets: _Brackets, rounds: int) -> tuple[Any, Any]:
    """(log frequencies of the peaks and of each crossover, L (2 + 3 m, m, m) there)."""
    m = form.C.shape[0]
    count, dtype = 3 * m, jnp.result_type(form.A, jnp.complex64)
    which = np.tile(np.arange(m), 3)

    def once(_: Any, state: Any) -> Any:
        low, high, _, _, cut = state
        shares, points = jnp.linspace(0.0, 1.0, ZOOM), _cuts(cut)
        peaks = low[:, None] + (high - low)[:, None] * shares
        log = jnp.concatenate([jnp.ravel(peaks), jnp.ravel(points)])
        L, _ = fr.response(form, jnp.exp(1j * form.dt * jnp.exp(log)))
        at_peaks, L = L[: PEAKS * ZOOM], L[PEAKS * ZOOM :]
        S = _sensitivity(at_peaks)
        closed = jnp.concatenate([S[:ZOOM], jnp.eye(m) - S[ZOOM:]])
        k = jnp.argmax(_largest_gain(closed).reshape(PEAKS, ZOOM), axis=1)
        each = np.arange(PEAKS)
        ends = peaks[each, jnp.maximum(k - 1, 0)], peaks[each, jnp.minimum(k + 1, ZOOM - 1)]
        alone = _alone_at(L, np.repeat(which, points.shape[1])).reshape(points.shape)
        size = jnp.log(jnp.maximum(jnp.abs(alone), 1e-300))
        values = jnp.where(np.arange(count)[:, None] < m, jnp.imag(alone), size)
        return *ends, peaks[each, k], at_peaks[each * ZOOM + k], _shrunk(cut, points, values, L)

    parts = slice(None, PEAKS), slice(PEAKS, None)
    first, rest = (_Brackets(*(v[part] for v in brackets)) for part in parts)
    none = jnp.zeros((PEAKS + count, m, m), dtype)
    far = jnp.full(count, jnp.inf, form.A.dtype)
    cut = _Cut(rest.low, rest.high, rest.at_low, rest.at_high, far, rest.low, none[PEAKS:])
    start = (first.low, first.high, first.low, none[:PEAKS], cut)
    _, _, log, L, cut = jax.lax.fori_loop(0, rounds, once, start)
    return jnp.concatenate([log, cut.log]), jnp.concatenate([L, cut.L])


def _cuts(cut: _Cut) -> Any:
    """(3 m, 4) logarithms of frequencies at which brackets are cut, in increasing order."""
    apart = cut.at_low - cut.at_high
    straight = jnp.clip(cut.at_low / jnp.where(apart != 0.0, apart, 1.0), 0.0, 1.0)
    shares = [0.5 + 0.0 * straight, straight - ASIDE, straight, straight + ASIDE]
    shares = jnp.sort(jnp.clip(jnp.stack(shares, axis=1), 0.0, 1.0), axis=1)
    return cut.low[:, None] + (cut.high - cut.low)[:, None] * shares


def _shrunk(cut: _Cut, points: Any, values: Any, L: Any) -> _Cut:
    """The first part of each bracket in which values (3 m, 4) at the points change their sign."""
    index, ends = np.arange(len(points)), lambda a, v, b: jnp.column_stack([a, v, b])
    log, value = ends(cut.low, points, cut.high), ends(cut.at_low, values, cut.at_high)
    k = jnp.argmax((value[:, :-1] < 0.0) != (value[:, 1:] < 0.0), axis=1)
    size = jnp.abs(values)
    j = jnp.argmin(size, axis=1)
    least, better = size[index, j], size[index, j] < cut.best
    L = L.reshape(*points.shape, *L.shape[1:])[index, j]
    return _Cut(
        log[index, k],
        log[index, k + 1],
        value[index, k],
        value[index, k + 1],
        jnp.where(better, least, cut.best),
        jnp.where(better, points[index, j], cut.log),
        jnp.where(better[:, None, None], L, cut.L),
    )


def _values(loop: OpenLoop, still: OpenLoop, brackets: _Brackets, w: Any, stable: Any) -> Margins:
    """The Margins at the frequencies w (2 + 3m,), with derivatives."""
    m = loop.C.shape[0]
    which = np.concatenate([[0] * PEAKS, np.tile(np.arange(m), 3)])
    rows = np.arange(len(which))
    index = rows - PEAKS  # of the crossovers

    base = fr.held(still, w)

    def zero(loop, w):
        L = _alone(_sensitivity(fr.near(loop, base, w)))[rows, which]
        size = jnp.log(jnp.where(jnp.abs(L) > 0.0, jnp.abs(L), 1.0))
        return jnp.where(index < m, jnp.imag(L), size)

    steep = jax.jvp(lambda w: zero(still, w), (w,), (jnp.ones_like(w),))[1]
    steep = jax.lax.stop_gradient(steep)
    moves = brackets.exists & brackets.inside & (index >= 0) & (steep != 0.0)
    w = w - jnp.where(moves, zero(loop, w) / jnp.where(steep != 0.0, steep, 1.0), 0.0)

    every = _sensitivity(fr.near(loop, base, w))
    closed = _both(every)
    u, v, _ = jax.vmap(_pair)(jax.lax.stop_gradient(closed))
    peaks = jnp.real(jnp.einsum("pi,pij,pj->p", jnp.conj(u), closed, v))
    return _margins_of(brackets.exists, w, every, peaks, stable)


def _margins_of(exists: Any, w: Any, S: Any, peaks: Any, stable: Any) -> Margins:
    """The Margins of S (2 + 3m, m, m) at the frequencies w (2 + 3m,), of which some `exists`."""
    m = S.shape[1]
    which = np.concatenate([[0] * PEAKS, np.tile(np.arange(m), 3)])
    rows = np.arange(len(which))
    index = rows - PEAKS  # of the crossovers
    L = jnp.where(exists, _alone(S)[rows, which], 1.0)  # no zero to divide by
    size, angle = jnp.log(jnp.abs(L)), jnp.angle(L)
    wrapped = jnp.mod(angle + jnp.pi, 2.0 * jnp.pi)
    values = jnp.where(
        index < m,
        jnp.exp(jnp.abs(size)),
        jnp.where(index < 2 * m, jnp.degrees(jnp.pi - jnp.abs(angle)), wrapped / w),
    )
    values = jnp.where(exists, values, jnp.inf)
    parts = lambda v: jnp.split(v[PEAKS:], 3)
    return Margins(stable, *peaks, *parts(values), *w[:PEAKS], *parts(w))
