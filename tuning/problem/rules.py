"""Tuning rules of PI and PID controllers, from the linearised plant or a relay experiment.

SIMC: Skogestad, J. Process Control 13 (2003). AMIGO: Astrom and Hagglund, Advanced PID Control
(2006), ch. 7. Lambda: Dahlin (1968), integrating form by Chien and Fruehauf (1990). Ziegler and
Nichols (1942), ultimate cycle. Relay: Astrom and Hagglund, Automatica 20 (1984), with the gains of
Tyreus and Luyben (1992), made for levels.
"""

# the linear models of jaxtank.analysis have no types
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportMissingTypeStubs=false

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are imported when they are first used

import jaxtank
from jaxtank.analysis.frequency import OpenLoop
from jaxtank.analysis.linear_model import linearise_compiled, transmission_zeros
from jaxtank.analysis.margins import Margins, margins
from jaxtank.case import Case
from jaxtank.controllers import PID, Cascade, Controller, FlowCascade, Override, Ratio, SplitRange
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import component, leaf
from jaxtank.loop.steady import at_mean_inflow, steady_inflow
from jaxtank.plants.elements import input_flows
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.signals.base import Constant
from jaxtank.signals.setpoints import ramps
from tuning.problem.controllers import operating_point

CYCLES = 12  # ultimate periods of a relay experiment; the last half of them counts
EXCURSION = 0.2  # amplitude of a relay experiment, in distances to bottom and rim
REFERENCE_GAIN = 0.02  # gain, in 1/(initial slope x dead time), far below the ultimate one


class Process(NamedTuple):
    """A process gain exp(-delay s)/((s + 1/lag) (second s + 1)); lag is inf where it integrates."""

    gain: float  # initial slope of the level for a unit of the input [cm/(s V)]
    lag: float  # [s]
    second: float  # [s]
    delay: float  # [s]


class Ultimate(NamedTuple):
    """Where a proportional controller brings a loop to the edge of its stability."""

    gain: float  # Ku [V/cm]
    period: float  # Pu [s]


class Loop(NamedTuple):
    """The linear model of one loop of a PID: x' = A x + b v, level c x, and its instruments."""

    A: np.ndarray
    b: np.ndarray
    c: np.ndarray
    lag: float  # of its actuator [s]
    delay: float  # of its actuator [s]
    dt: float
    tank: int  # whose level is read
    filter: float = 0.0  # of the reading [s]
    nested: bool = False  # True where the input is the setpoint of an inner loop


def loop_of(case: Case, output: int, tank: int | None = None) -> Loop:
    """Return the linear model of one loop at the last plateau, of the level of `tank` if named."""
    case = case.replace(loop=at_mean_inflow(case.loop, case.clock))
    bank, plant = case.loop.actuator, case.loop.plant
    _, levels, inputs = operating_point(case, plant)
    linear = linearise_compiled(plant, levels, inputs, steady_inflow(case.loop))
    A, B, _ = (np.asarray(v, dtype=float) for v in linear)
    slopes = slopes_of(case, inputs, output)
    lags = np.broadcast_to(0.0 if bank.lag is None else np.asarray(bank.lag), slopes.shape)
    lag = float(np.max(lags[slopes != 0.0]))
    more = np.asarray(bank.delays or (0.0,) * len(slopes))
    delay = float(bank.delay + np.max(more[slopes != 0.0]))
    tank = int(plant.outputs[output]) if tank is None else tank
    times = getattr(case.loop.sensor, "filter", None)
    time = 0.0 if times is None else float(times[tank])
    slope = float(jax.grad(functools.partial(reading_of, case, tank))(float(levels[tank])))
    row = slope * np.eye(len(A))[tank]
    return Loop(A, B @ slopes, row, lag, delay, case.clock.dt, tank, time)


def reading_of(case: Case, tank: int, level: Any) -> Any:
    """Return what the sensor of a tank reads at a level; the level where a custom sensor has no
    `reading_of`.
    """
    sensor: Any = case.loop.sensor
    return sensor.reading_of(tank, level) if hasattr(sensor, "reading_of") else level


def closed_around(loop: Loop, inner: np.ndarray, gains: "Gains") -> Loop:
    """Return a loop whose input is the setpoint of an inner PI on the reading inner x."""
    n = len(loop.A)
    closed, b = loop.A - gains.Kc * np.outer(loop.b, inner), gains.Kc * loop.b
    if math.isinf(gains.Ti):
        return loop._replace(A=closed, b=b, nested=True)
    integral = gains.Kc / gains.Ti
    with_integral = np.zeros((n + 1, n + 1))
    with_integral[:n, :n], with_integral[:n, n] = closed, loop.b
    with_integral[n, :n] = -integral * inner
    b, c = np.append(b, integral), np.append(loop.c, 0.0)
    return loop._replace(A=with_integral, b=b, c=c, nested=True)


def slopes_of(case: Case, inputs: np.ndarray, output: int) -> np.ndarray:
    """Change of the inputs (m,) for a unit of the controller's output, at inputs (m,)."""
    controller = case.loop.controller
    if not isinstance(controller, SplitRange | Ratio):
        return np.eye(len(inputs))[output]

    def inputs_of(v: Any) -> Any:
        return jnp.stack(controller.shared(v))

    v = jnp.stack([jnp.asarray(total) for total in controller.total(inputs)])
    return np.asarray(jax.jacfwd(inputs_of)(v))[:, output]


def process_of(loop: Loop, order: int) -> Process:
    """Return the Process of a loop with one time constant (order 1) or two, by the half rule."""
    zeros, poles = _reduced(loop)
    gain = _initial_slope(loop)
    for zero in zeros:  # one in the right half plane turns the sign
        gain *= -zero
    # the slowest pole is the process's own lag; it stays in the initial slope
    lags: list[float] = sorted(
        (math.inf if p == 0.0 else 1.0 / abs(p) for p in poles), reverse=True
    )
    for lag in lags[1:]:
        gain *= lag if math.isfinite(lag) else 1.0
    delay = loop.delay + 0.5 * loop.dt
    for zero in zeros:
        time = 1.0 / abs(zero)
        if zero > 0.0:  # an inverse response counts as dead time
            delay += time
            continue
        near = min(range(len(lags)), key=lambda k: abs(math.log(min(lags[k], 1e9 * time) / time)))
        slow = lags.pop(near)
        gain *= time / (lags[0] if near == 0 else slow)  # without the slowest, by the next lag
    lags = sorted([*lags, *filter(None, (loop.lag, loop.filter))], reverse=True)
    dominant, rest = lags[:order], lags[order:]
    if rest:
        half = 0.5 * rest[0]
        if math.isfinite(dominant[-1]):
            if order == 1:  # the steady gain stays
                gain *= dominant[0] / (dominant[0] + half)
            dominant[-1] += half
        delay += half + sum(rest[1:])
    return Process(
        gain, dominant[0], dominant[1] if order == 2 and len(dominant) == 2 else 0.0, delay
    )


def _reduced(loop: Loop) -> tuple[list[float], list[float]]:
    """(zeros, poles) [1/s] of the transfer function, without those that cancel; real parts."""
    poles = [complex(p) for p in np.linalg.eigvals(loop.A)]
    zeros = [complex(z) for z in transmission_zeros(loop.A, loop.b[:, None], loop.c[None])]
    fastest = max([abs(p) for p in poles], default=0.0) or 1.0
    remaining: list[complex] = []
    for zero in zeros:
        near = min(poles, key=lambda p: abs(p - zero), default=None)
        if near is not None and abs(near - zero) < 1e-6 * max(abs(zero), 1e-6 * fastest):
            poles.remove(near)
        else:
            remaining.append(zero)

    def size(z: complex) -> float:
        return math.copysign(abs(z), z.real or -1.0)

    small = 1e-9 * fastest
    return [size(z) for z in remaining if abs(z) > small], [
        0.0 if abs(p) <= small else size(p) for p in poles
    ]


def _initial_slope(loop: Loop) -> float:
    """The first Markov parameter c A^r b that is not 0."""
    vector, scale = loop.b, float(np.abs(loop.b).max(initial=0.0))
    for _ in range(len(loop.A)):
        value = float(loop.c @ vector)
        if abs(value) > 1e-12 * scale and scale > 0.0:
            return value
        vector = loop.A @ vector
        scale = float(np.abs(vector).max())
    raise InputError("an input of the controller does not move its level")


def ultimate_of(loop: Loop) -> Ultimate:
    """Return the ultimate gain and period of the sampled loop, from its gain margin."""
    process, n = process_of(loop, 1), len(loop.A)
    block = np.zeros((n + 2, n + 2))
    block[:n, :n], block[:n, n if loop.lag else n + 1] = loop.A, loop.b
    if loop.lag:
        block[n, n], block[n, n + 1] = -1.0 / loop.lag, 1.0 / loop.lag
    transition = scipy.linalg.expm(block * loop.dt)
    size = n + bool(loop.lag)
    gain = REFERENCE_GAIN / (process.gain * process.delay)
    with jax.enable_x64(True):
        a, b = transition[:size, :size], transition[:size, n + 1 :] * gain
        c = np.append(loop.c, np.zeros(size - n))[None]
        if loop.filter:  # it counts the level of this sample; the reading before is the last state
            decay = math.exp(-loop.dt / loop.filter)
            c = np.append((1.0 - decay) * c, [[decay]], axis=1)
            a = np.block([[a, np.zeros((size, 1))], [c]])
            b = np.append(b, [[0.0]], axis=0)
        matrices = a, b, c
        edge = _margins(*map(jnp.asarray, matrices), round(loop.delay / loop.dt), loop.dt)
    factor, frequency = float(edge.gain_margin[0]), float(edge.gain_frequency[0])
    if not (bool(edge.stable) and 0.0 < factor < math.inf and frequency > 0.0):
        raise InputError("the loop has no ultimate gain")
    if loop.filter and frequency > 0.9 * math.pi / loop.dt:
        raise InputError(
            "with the filter of its reading the loop has no ultimate gain below half the sampling"
            " frequency: choose another rule, such as simc"
        )
    return Ultimate(gain * factor, 2.0 * math.pi / frequency)


@functools.partial(jax.jit, static_argnums=(3, 4))
def _margins(A: Any, B: Any, C: Any, dead: int, dt: float) -> Margins:
    return margins(OpenLoop(A, B, C, dead, dt), False)


@component
class Relay(Controller):
    """One input between two values by the sign of its level's error, the others constant."""

    base: np.ndarray = leaf("V", "inputs at the operating point", shape="pump")
    step_up: np.ndarray = leaf("V", "inputs added where the level is too low", shape="pump")
    level: np.ndarray = leaf("cm", "level at which it switches")
    reads: np.ndarray = leaf("-", "1 for the tank whose level it reads, 0 for others", shape="tank")

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence[Any], Any]:
        level = sum(read * x for read, x in zip(self.reads, estimate.x))
        side = jnp.where(level < self.level, 1.0, -1.0)
        return tuple(b + side * s for b, s in zip(self.base, self.step_up)), state


def relay_experiment(case: Case, output: int, linear: Loop | None = None) -> Ultimate:
    """Return Ku = 4 d/(pi a) and Pu of a simulated relay experiment on one loop, others open."""
    linear = loop_of(case, output) if linear is None else linear
    if linear.nested:
        raise InputError(
            "a relay moves an input, and the outer loop of a cascade moves a setpoint: choose"
            " another rule"
        )
    expected = _usable(case, linear)
    case = case.replace(loop=at_mean_inflow(case.loop, case.clock))
    loop, plant, inflow = case.loop, case.loop.plant, steady_inflow(case.loop)
    setpoint, levels, inputs = operating_point(case, plant)
    bank: Any = loop.actuator
    low, high = (np.broadcast_to(np.asarray(v, float), inputs.shape) for v in (bank.low, bank.high))
    slopes, tank = slopes_of(case, inputs, output), linear.tank
    middle = setpoint[output] if tank == plant.outputs[output] else levels[tank]
    acting = slopes != 0.0
    room = 0.5 * np.min(np.minimum(high - inputs, inputs - low)[acting] / np.abs(slopes[acting]))
    near = min(middle, max(float(np.asarray(plant.rim)[tank]) - middle, 0.0))
    # by the describing function the level then moves by EXCURSION of the way
    size = float(min(room, EXCURSION * (near or middle) * math.pi * abs(expected.gain) / 4.0))
    if not 0.0 < size < math.inf:
        raise InputError("a relay has no room: the input is at a limit in the steady state")
    amplitude = slopes * math.copysign(size, expected.gain)
    middle = float(reading_of(case, tank, middle))
    dt = case.clock.dt
    duration = math.ceil(CYCLES * max(expected.period, 4.0 * dt) / dt) * dt
    reads = np.eye(plant.tanks)[tank]
    quiet = dataclasses.replace(
        loop,
        controller=Relay(base=inputs, step_up=amplitude, level=np.asarray(middle), reads=reads),
        observer=jaxtank.observers.Direct(),
        sensor=loop.sensor.without_noise(),
        reference=ramps([float(v) for v in setpoint], [], ramp=0.0),
        faults=None,
        disturbance=None if inflow is None else Constant(level=np.asarray(inflow, dtype=float)),
        safety_filter=None,
        x0=levels,
        actuator=dataclasses.replace(bank, initial=inputs),
    )
    # loops whose cycles are of nearly the same length share a program, and each is cut to its own
    samples = round(duration / dt)
    most = 2 ** math.ceil(math.log2(samples))
    run = jaxtank.simulate(quiet, dataclasses.replace(case.clock, duration=most * dt))
    y, t = np.asarray(run.y)[: samples + 1, tank], np.asarray(run.t)[: samples + 1]
    late = t >= 0.5 * duration
    below = y < middle
    rising = t[1:][late[1:] & ~below[:-1] & below[1:]]
    amplitude_of_reading = 0.5 * float(np.ptp(y[late]))
    if len(rising) < 2 or not amplitude_of_reading > 0.0:
        raise InputError("the relay makes no cycle")
    period = float(np.mean(np.diff(rising)))
    gain = 4.0 * size / (math.pi * amplitude_of_reading)
    return Ultimate(math.copysign(gain, expected.gain), period)


class Gains(NamedTuple):
    """Gains of one loop; inf and 0 where a controller has no such part."""

    Kc: float
    Ti: float = math.inf
    Td: float = 0.0


def simc(case: Case, output: int, parts: str, loop: Loop) -> Gains:
    """SIMC with tau_c = the dead time (improved SIMC, Td = theta/3, without a second lag)."""
    process = process_of(loop, 2 if "d" in parts else 1)
    theta = process.delay
    closed = 2.0 * theta
    Kc, Ti = 1.0 / (process.gain * closed), min(process.lag, 4.0 * closed)
    if "d" not in parts:
        return Gains(Kc, Ti)
    Td = process.second or theta / 3.0
    series = 1.0 + Td / Ti  # from the series form to the parallel one
    return Gains(Kc * series, Ti * series, Td / series)


def lambda_rule(case: Case, output: int, parts: str, loop: Loop) -> Gains:
    """A closed loop as fast as the open one; three dead times of a process that integrates."""
    process = process_of(loop, 1)
    theta, Td = process.delay, 0.5 * process.delay
    if math.isinf(process.lag):
        time = 3.0 * theta
        Ti = 2.0 * time + theta
        return Gains(Ti / (process.gain * (time + theta) ** 2), Ti, Td)
    time = max(process.lag, 3.0 * theta)
    return Gains(1.0 / (process.gain * (time + theta)), process.lag, Td)


def _usable(case: Case, loop: Loop) -> Ultimate:
    """`ultimate_of` a loop. Raises InputError where its period is longer than the run."""
    ultimate, duration = ultimate_of(loop), case.clock.duration
    if ultimate.period > duration:
        raise InputError(
            f"its ultimate period of {ultimate.period:.4g} s is longer than the run of"
            f" {duration:g} s: choose another rule, as simc"
        )
    return ultimate


def ziegler_nichols(case: Case, output: int, parts: str, loop: Loop) -> Gains:
    """Of the ultimate gain and period of the linearised loop."""
    gain, period = _usable(case, loop)
    if parts == "p":
        return Gains(0.5 * gain)
    if "d" in parts:
        return Gains(0.6 * gain, 0.5 * period, 0.125 * period)
    return Gains(0.45 * gain, period / 1.2)


def amigo(case: Case, output: int, parts: str, loop: Loop) -> Gains:
    """Astrom and Hagglund's approximate M-constrained integral gain optimisation."""
    process = process_of(loop, 1)
    theta, lag = process.delay, process.lag
    if math.isinf(lag):
        if "d" in parts:
            return Gains(0.45 / (process.gain * theta), 8.0 * theta, 0.5 * theta)
        return Gains(0.35 / (process.gain * theta), 13.4 * theta)
    steady = process.gain * lag
    if "d" in parts:
        return Gains(
            (0.2 + 0.45 * lag / theta) / steady,
            theta * (0.4 * theta + 0.8 * lag) / (theta + 0.1 * lag),
            0.5 * theta * lag / (0.3 * theta + lag),
        )
    return Gains(
        (0.15 + (0.35 - theta * lag / (theta + lag) ** 2) * lag / theta) / steady,
        0.35 * theta + 13.0 * theta * lag**2 / (lag**2 + 12.0 * theta * lag + 7.0 * theta**2),
    )


def relay(case: Case, output: int, parts: str, loop: Loop) -> Gains:
    """Tyreus and Luyben's gains of the cycle of a simulated relay experiment."""
    gain, period = relay_experiment(case, output, loop)
    if "d" in parts:
        return Gains(gain / 2.2, 2.2 * period, period / 6.3)
    return Gains(gain / 3.2, 2.2 * period)


RULES: dict[str, Callable[[Case, int, str, Loop], Gains]] = {
    "simc": simc,
    "lambda": lambda_rule,
    "ziegler-nichols": ziegler_nichols,
    "amigo": amigo,
    "relay": relay,
}
"""{name: rule (case, output, parts of the controller, "p", "pi" or "pid", its loop) -> Gains}."""


def refusal(case: Case) -> str:
    """Return why the rules have no gains for the controller of a case, "" where they have."""
    controller, plant = case.loop.controller, case.loop.plant
    if not isinstance(controller, PID) or not isinstance(plant, TankNetwork):
        return (
            "is for controllers of the kinds p, pi, pid, split-range, ratio, override, cascade and"
            f" reference-governor on a TankNetwork, and not for {type(controller).__name__} on"
            f" {type(plant).__name__}"
        )
    if controller.order is not None:
        return "has no gains for an integral of fractional order"
    if controller.Ti is not None and not np.all(np.isfinite(controller.Ti)):
        return "has no gains where some loops have integral action and others have none"
    return ""


def rule_gains(case: Case, rule: str) -> dict[str, float]:
    """Return {dotted name of an entry: value} of a rule for every loop of a PID."""
    if rule not in RULES:
        raise unknown("tuning rule", rule, RULES)
    if why := refusal(case):
        raise InputError(f"rule {rule}: {why}")
    outputs = []
    for i in range(len(case.loop.plant.outputs)):
        try:
            outputs.append(_gains_of(case, rule, i))
        except InputError as error:
            raise InputError(f"rule {rule}, output {i + 1}: {error}") from None
    return {
        f"controller.{name}[{i}]": gains[name]
        for name in ORDER
        for i, gains in enumerate(outputs)
        if name in gains and 0.0 < abs(gains[name]) < math.inf
    }


ORDER = ("Kc", "Ti", "Td", "Tt", "inner_Kc", "inner_Ti", "limit_Kc", "limit_Ti")
"""Gains of a rule in the order in which they are printed."""


def _gains_of(case: Case, rule: str, output: int) -> dict[str, float]:
    """Return {gain: value} of a rule for one output; of a cascade by the inner loop first."""
    controller: Any = case.loop.controller
    loop, values = loop_of(case, output), {}

    def second(prefix: str, tank: int) -> Gains:
        parts = "p" if getattr(controller, f"{prefix}_Ti") is None else "pi"
        gains = RULES[rule](case, output, parts, loop_of(case, output, tank))
        values.update(_present(controller, {f"{prefix}_Kc": gains.Kc, f"{prefix}_Ti": gains.Ti}))
        return gains

    if isinstance(controller, FlowCascade):
        plant: Any = case.loop.plant
        _, levels, inputs = operating_point(case, plant)

        def flows(u: Any) -> Any:
            return jnp.stack(list(input_flows(plant, tuple(levels), tuple(u))))

        with jax.enable_x64(True):
            slope = float(np.asarray(jax.jacfwd(flows)(jnp.asarray(inputs)))[output, output])
        if not slope:
            raise InputError("the input moves no flow at the last plateau")
        dead, lag = loop.delay + loop.dt, max(loop.lag, loop.dt)
        inner = Gains(lag / (slope * 2.0 * dead), lag)
        loop = loop._replace(b=loop.b / slope, lag=dead, nested=True)
        values |= _present(controller, {"inner_Kc": inner.Kc, "inner_Ti": inner.Ti})
    elif isinstance(controller, Cascade):
        tank = controller.inner[output]
        inside = loop_of(case, output, tank)
        loop = closed_around(loop, inside.c, second("inner", tank))
        loop = loop._replace(lag=loop.lag + inside.filter)
    elif isinstance(controller, Override):
        second("limit", controller.limited[output])
    parts = "p" + "i" * (controller.Ti is not None) + "d" * (controller.Td is not None)
    gains = RULES[rule](case, output, parts, loop)
    Kc = gains.Kc if controller.action == "reverse" else -gains.Kc
    numbers = {"Kc": Kc, "Ti": gains.Ti, "Td": gains.Td}
    if controller.Ti is not None:
        numbers["Tt"] = math.sqrt(gains.Ti * gains.Td) if "d" in parts else gains.Ti
    return _present(controller, numbers) | values


def _present(controller: Any, values: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in values.items() if getattr(controller, name) is not None}
