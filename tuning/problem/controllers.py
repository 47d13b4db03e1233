"""A case with a controller of another kind, with gains to start from."""

# the linear models of jaxtank.analysis and the readers of jaxtank.rig have no types
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportMissingParameterType=false
# pyright: reportMissingTypeStubs=false

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxtank import presets, rig
from jaxtank.analysis.linear_model import linearise
from jaxtank.analysis.riccati import lqr
from jaxtank.bounds import gain_ranges
from jaxtank.case import Case
from jaxtank.core.errors import EquilibriumError, InputError, unknown
from jaxtank.loop.steady import at_mean_inflow, circulating, steady_inflow, steady_state
from jaxtank.observers import Direct
from jaxtank.rig.components import REGISTERED, ROLES, controller_of, kind_of, model_of

NAMES = ("controller.kind", "law.kind")  # of Python, and of a rig file

FASTER = 10.0  # time constant of the rig / time constant of the first closed loop [-]

DEVIATION, EFFORT = 0.05, 0.25  # share of the height, of a pump's range (Bryson's rule)


class Rig(NamedTuple):
    """Data for the first gains: a linear model at a steady state, and sizes."""

    A: np.ndarray  # (n, n) [1/s]
    B: np.ndarray  # (n, m)
    C: np.ndarray  # (outputs, n)
    levels: np.ndarray  # (n,) [unit of length]
    setpoint: np.ndarray  # (outputs,)
    low: np.ndarray  # (m,) limits of the inputs
    high: np.ndarray
    off: float  # a level off by this much counts ...
    effort: np.ndarray  # (m,) ... as much as an input off by this much
    slowest: float  # largest time constant, at most the length of the run [s]

    @property
    def weights(self) -> tuple[np.ndarray, np.ndarray]:
        """Weights (n,) of the levels and (m,) of the inputs by Bryson's rule."""
        return np.full(len(self.A), self.off**-2.0), self.effort**-2.0


def with_kind(case: Case, kind: str) -> Case:
    """Return a case whose controller is replaced by one of another kind."""
    known = ROLES["controller"].classes
    if kind not in known:
        raise unknown("controller kind", str(kind), known)
    if _is_kind(case.loop.controller, kind):
        return case
    if kind in REGISTERED or kind not in START:
        raise InputError(
            f"controller kind {kind}: has no gains to start from; tune a rig file that has them"
        )
    controller, free = _published(case, kind) or (_computed(case, kind), {})
    loop = dataclasses.replace(case.loop, controller=controller)
    if others := {n: f for n, f in case.free.items() if not n.startswith("controller.")}:
        free = {**(free or gain_ranges(loop)), **others}
    return rig.check(rig.filtered(case.replace(loop=loop, free=free, symmetry=None)))


def _is_kind(controller: Any, kind: str) -> bool:
    """Whether a controller is of a kind: every PID is a "pid"."""
    other = kind_of("controller", controller)
    return other == kind or (kind == "pid" and other in ("pi", "p"))


def _published(case: Case, kind: str) -> tuple[Any, dict[str, Any]] | None:
    """Return (controller, ranges) of a case of the same paper on the same plant, None without."""
    paper = case.name.partition("/")[0]
    if paper not in presets.PAPERS:
        return None
    for other in presets.load(paper).cases.values():
        if _is_kind(other.loop.controller, kind) and same_rig(other, case):
            controller: Any = other.loop.controller
            if hasattr(controller, "model"):
                controller = dataclasses.replace(controller, model=model_of(case.loop))
            return controller, {n: f for n, f in other.free.items() if n.startswith("controller.")}
    return None


def same_rig(*cases: Case) -> bool:
    return equal(*((case.loop.plant, case.loop.actuator) for case in cases))


def equal(a: Any, b: Any) -> bool:
    """Return whether two parts of a loop are the same in structure and every number."""
    (leaves, form), (others, other) = jax.tree.flatten(a), jax.tree.flatten(b)
    return form == other and all(np.array_equal(x, y) for x, y in zip(leaves, others))


def _computed(case: Case, kind: str) -> Any:
    """Return a controller of a kind with the first gains of `START`."""
    case = case.replace(loop=at_mean_inflow(case.loop, case.clock))
    plant: Any = model_of(case.loop)
    pumps = (plant.pumps,)
    setpoint, levels, inputs = operating_point(case, plant)
    linear = linearise(plant, levels, inputs, steady_inflow(case.loop))
    A, B, C = (np.asarray(v, dtype=float) for v in linear)
    bank: Any = case.loop.actuator
    low, high = (np.broadcast_to(np.asarray(v, float), pumps) for v in (bank.low, bank.high))
    span = np.where(np.isfinite(high - low), high - low, 2.0 * np.abs(inputs) + 1e-9)
    rims = np.asarray(plant.rim, dtype=float)
    height = float(np.max(rims[np.isfinite(rims)], initial=0.0)) or float(np.max(levels))
    slow = float(np.min(-np.linalg.eigvals(A).real))
    slowest = min(1.0 / max(slow, 1e-300), case.clock.duration)
    known = Rig(A, B, C, levels, setpoint, low, high, DEVIATION * height, EFFORT * span, slowest)
    table = START[kind](known)
    inflow = steady_inflow(case.loop)
    if kind in WITH_INFLOW and isinstance(case.loop.observer, Direct) and inflow is not None:
        table["inflow"] = np.asarray(inflow, dtype=float)
    written = {name: np.asarray(value).tolist() for name, value in table.items()}
    return controller_of({"kind": kind, **written}, case.loop)


def operating_point(case: Case, plant: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (setpoints, levels, inputs) of the last plateau with a steady state, or the mean."""
    plateaus = case.loop.reference.plateaus()
    if plateaus is None:
        plateaus = [np.array([np.mean(r) for r in case.loop.reference.sample(case.clock)[0]])]
    for setpoint in reversed(list(plateaus)):
        rest = circulating(case.loop, plant, np.asarray(setpoint, dtype=float))
        try:
            rest = rest or steady_state(case.loop, setpoint, plant)
        except EquilibriumError:
            continue
        levels, inputs = (np.asarray(v, float) for v in rest)
        return np.asarray(setpoint, dtype=float), levels, inputs
    without = " without overflow" if plant.overflow else ""
    raise InputError(
        f"no setpoint has a steady state{without} at which first gains could be computed"
    )


def _pid(known: Rig) -> Any:
    """SIMC (Skogestad, J. Process Control 13, 2003) of each pump's own output:"""
    # Kc = tau / (k (tau_c + theta)), Ti = min(tau, 4 (tau_c + theta)), tau_c = T / FASTER
    # with the steady gain k. A pump that fills its output directly has theta = 0; else half of the
    # other time constants is taken for a dead time.
    n, T = len(known.A), known.slowest
    # a rig that integrates has the gain of its first T seconds
    gain = known.C @ np.linalg.solve(np.eye(n) * (1e-3 / T) - known.A, known.B)
    steady, direct = np.diag(gain), np.diag(known.C @ known.B)
    if np.any(np.abs(steady) < 1e-9 * np.abs(gain).max()):
        raise InputError("controller kind pid: a pump does not change its output")
    rates = np.sort(np.abs(np.linalg.eigvals(known.A).real))
    others = float(np.sum(1.0 / rates[1:][rates[1:] > 0.0])) if n > 1 else 0.0
    lag = T / FASTER + np.where(np.abs(direct) > 0.0, 0.0, 0.5 * others)
    return {"Kc": T / (steady * lag), "Ti": np.minimum(T, 4.0 * lag)}


def _feedback(known: Rig) -> np.ndarray:
    """(m, n) linear-quadratic gain of the weights of Bryson's rule."""
    Q, R = known.weights
    gain = np.asarray(lqr(known.A, known.B, np.diag(Q), np.diag(R)), dtype=float)
    if not np.all(np.isfinite(gain)):
        raise InputError("the linear model of the rig has no linear-quadratic gain")
    return gain


def _lqi(known: Rig) -> Any:
    Q, R = known.weights
    integrals = np.full(len(known.C), (known.off * known.slowest / FASTER) ** -2.0)
    return {"Q": np.concatenate([Q, integrals]), "R": R, "operating_point": known.setpoint}


def _horizon(known: Rig) -> Any:
    return {"Tp": known.slowest / FASTER}


def _two_gains(first: str, second: str) -> Callable[[Rig], Any]:
    """Return the rule of two gains [1/s], each of which is a pole of the closed loop."""

    def rule(known: Rig) -> Any:
        rate = FASTER / known.slowest
        return {first: rate, second: rate}

    return rule


def _sliding(known: Rig) -> Any:
    surface = 1.0 / known.slowest
    phi = known.off * surface
    return {"surface": surface, "ks": FASTER * surface * phi, "phi": phi}


def _fuzzy(known: Rig) -> Any:
    if known.B.shape != (4, 2):
        n, m = known.B.shape
        raise InputError(
            f"controller kind fuzzy: is of the quadruple tank, with 4 tanks and 2 pumps; this rig"
            f" has {n} and {m}"
        )
    near = np.full(len(known.C), known.off)
    table = _sliding(known) | {"K": _feedback(known), "b": near, "w": 0.5 * near}
    return table | {"low": known.low, "high": known.high}


def _predictive(known: Rig) -> Any:
    """Levels that differ where pipes join them; the input limits of the pumps."""
    span = known.high - known.low
    return {
        "operating_point": known.levels,
        "r_w": (known.off / float(np.mean(known.effort))) ** 2,
        "q": np.ones(len(known.C)),
        "du_limit": np.where(np.isfinite(span), span, 4.0 * known.effort),
        "u_low": known.low,
        "u_high": known.high,
    }


def _laguerre(known: Rig) -> Any:
    return _predictive(known) | {"a": np.full(len(known.effort), 0.5)}


def _nonlinear(known: Rig) -> Any:
    """A horizon of the slowest time constant; moves that cost little."""
    effort = 0.01 * (known.off / known.effort) ** 2
    limits = {"low": known.low, "high": known.high}
    return {"horizon": known.slowest, "r_w": effort, **limits}


WITH_INFLOW = ("state-feedback", "lqi")  # kinds whose model has a steady inflow

START: dict[str, Callable[[Rig], Any]] = {
    "pid": _pid,
    "pi": _pid,
    "state-feedback": lambda known: {"K": _feedback(known)},
    "lqi": _lqi,
    "ngpc": _horizon,
    "backstepping": _two_gains("k", "k1"),
    "enmpc": _horizon,
    "two-tank-backstepping": _two_gains("K_phi", "K_y"),
    "sliding-mode": _sliding,
    "fuzzy": _fuzzy,
    "gpc": _predictive,
    "laguerre": _laguerre,
    "nmpc": _nonlinear,
}
"""{kind: rule (Rig) -> {field: first value}}."""
