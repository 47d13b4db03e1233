"""Warnings about a case that can run but is hardly meant: reported, never refused."""

import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank import controllers, presets
from jaxtank.analysis.linear_model import linearise_compiled
from jaxtank.case import Case
from jaxtank.controllers.cascade import Cascade
from jaxtank.controllers.pid import PID, SharedPID
from jaxtank.controllers.reference_governor import ReferenceGovernor
from jaxtank.controllers.split_range import SplitRange
from jaxtank.core.clock import clock_warnings
from jaxtank.core.labels import input_unit, label_of, labels_of, name_of, with_input_unit
from jaxtank.core.tree import get_value, is_component, split_index, walk
from jaxtank.core.units import flow_per_input, local
from jaxtank.loop.estimate_notes import is_unused
from jaxtank.loop.steady import steady_inflow
from jaxtank.loop.tank_bottom import is_open
from jaxtank.observers import Direct, ExtendedKalman, FaultBank
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.rig.schema import SECTIONS
from jaxtank.rig.signals import parts_of, steps
from jaxtank.rig.values import has
from jaxtank.signals.setpoints import Sine, index

LEAST_SHARE = 0.01  # share of a measured inflow below which its gain is hardly meant [-]

STILL = 0.02  # share of a pump's range by which its input before t = 0 may miss the start's [-]

RANGEABILITY, EXPONENT = (  # what a file that says nothing has [-]
    SECTIONS[section][key].default
    for section, key in (("valve", "rangeability"), ("orifice", "exponent"))
)


def case_warnings(case: Case) -> list[str]:
    """Return sentences on what in a case is hardly meant: tables that a run does not reach, numbers
    that hardly fit, gains of the wrong sign, and what has no effect (`rules` below).

    Parameters
    ----------
    case : Case

    Returns
    -------
    Sentences, in the order of `rules`.

    Examples
    --------
    >>> from jaxtank import presets, rig
    >>> case = rig.set_values(presets.find("cascaded/pi"), {"actuator.initial": 11.0})
    >>> rig.case_warnings(case)
    ['pump 1 runs at 11 V before t = 0, outside its limits of 0 and 10 V']
    """
    rules = (
        *(_late_tables, _late, _inflow_unit, _short_tables, _overlapping, _unseen, _above_rims),
        *(_limits_of_levels, _pumps, _played, _standing, _openings, wrong_signs, _switches),
        *(_coarse_prediction, _ranges, _feed_forward, _open_bottoms, _constraints, model_warnings),
        *(_unknown_inflow, _freezes, _datum, _filtered, _unused, idle_parts),
    )
    return [*clock_warnings(case.clock), *(line for rule in rules for line in rule(case))]


def _ramps_of(loop):
    """{"reference" or "inputs": its Ramps}, of those that have some."""
    signals = {"reference": loop.reference, "inputs": getattr(loop.controller, "signal", None)}
    return {name: ramps for name, of in signals.items() if (ramps := steps(of)) is not None}


WITHOUT_INTEGRAL = (  # controllers that rest where their model does
    *(controllers.Backstepping, controllers.ENMPC, controllers.FuzzyBlend, controllers.NGPC),
    *(controllers.NMPC, controllers.SlidingMode, controllers.StateFeedback),
    controllers.TwoTankBackstepping,
)


def _unknown_inflow(case):
    """On a constant inflow that the model of a controller without integral action has not, or of
    an observer that takes it for something else.
    """
    loop = case.loop
    inflow = steady_inflow(loop)
    if inflow is None or not np.any(np.asarray(inflow) != 0.0):
        return
    size, flow = float(np.max(np.abs(np.asarray(inflow)))), local("cm^3/s", loop.units)
    law, observer = getattr(loop.controller, "law", loop.controller), loop.observer
    fits = isinstance(observer, ExtendedKalman) and observer.coefficients
    if fits or isinstance(observer, FaultBank):
        yield (
            f"the observer's model knows no inflow, and up to {size:.4g} {flow} enters: it is taken"
            f" for {'other coefficients' if fits else 'a fault'}; bring it by a pump with a"
            " constant input, which the model has"
        )
    known = getattr(law, "inflow", None) is not None
    if isinstance(law, WITHOUT_INTEGRAL) and isinstance(observer, Direct) and not known:
        stated = "; controller.inflow states it" * isinstance(law, controllers.StateFeedback)
        yield (
            f"the controller's model knows no inflow, and up to {size:.4g} {flow} enters: levels"
            f' may stay off their setpoints ([observer] kind = "disturbance" estimates it{stated})'
        )


def _freezes(case):
    """On faults that cannot be told from a level at rest."""
    loop = case.loop
    if not isinstance(loop.observer, FaultBank) or not loop.observer.freezes:
        return
    noise = np.broadcast_to(np.asarray(loop.sensor.noise), loop.plant.tanks)
    if still := [i for i in loop.observer.measured if noise[i] == 0.0]:
        yield (
            f"sensors without noise, of {labels_of(loop.plant, 'tank', still)}: a level at rest"
            " reads as a sensor that is frozen: state sensor.noise, or observer.freezes = false"
        )


def _datum(case):
    """On an offset of a sensor that can only be a datum."""
    plant, rim = case.loop.plant, np.asarray(case.loop.plant.rim)
    known = getattr(case.loop.sensor, "offset", None)
    offset = np.zeros_like(rim) if known is None else np.asarray(known)
    for i in np.flatnonzero(np.abs(offset) > rim).tolist():
        yield (
            f"the sensor of {label_of(plant, 'tank', i)} reads {offset[i]:g} {case.loop.units[0]}"
            " (offset) when it is empty, more than its height: controllers take readings as levels,"
            " and setpoints must be readings too"
        )


def _filtered(case):
    """On filters of readings below an observer, which takes readings as levels."""
    times = getattr(case.loop.sensor, "filter", None)
    if isinstance(case.loop.observer, Direct) or times is None or not np.any(times):
        return
    yield (
        f"sensor.filter = {np.max(times):g} s: the observer takes readings as levels; while levels"
        " change within this time, it estimates disturbances or faults that are not there"
    )


def _late_tables(case):
    """On tables of setpoints and inputs that begin after the run does."""
    for name, ramps in _ramps_of(case.loop).items():
        for begins in ramps.begins:
            if begins > 0.0:
                yield (
                    f"{name}: its table begins at {begins:g} s; until then `initial` holds, the"
                    " first row where it is left out"
                )


def _late(case):
    """On changes of the reference and inflow pulses after the end of the run."""
    loop, end = case.loop, case.clock.duration
    signal, *_ = parts_of(loop.disturbance)
    ramps = _ramps_of(loop).items()
    times = {f"changes of the {name}": [time for time, _ in of.changes] for name, of in ramps}
    times |= {
        "inflow pulses": () if signal is None else signal.onset,
        "faults": [start for _, start, _ in loop.faults.events] if loop.faults else (),
    }
    for name, events in times.items():
        late = sum(time >= end for time in events)
        if late:
            yield f"{late} of {len(events)} {name} come after the end of the run at {end:g} s"


MEASURED = 10  # rows from which on a table of inflow is taken as measured, and no list of steps


def _inflow_unit(case):
    """On inflows beyond what all pumps move, where inputs are flows in another unit."""
    (length, drive), plant = case.loop.units, case.loop.plant
    per = None if getattr(plant, "valves", ()) else flow_per_input(case.loop.units)
    _, steady, table = parts_of(case.loop.disturbance)
    tables = [] if table is None else table.tables()
    flows = [*enumerate(getattr(steady, "level", ()))]
    flows += [(tank, q) for tank, _, _, rows in tables if len(rows) < MEASURED for q in rows]
    tank, flow = max(flows, key=lambda row: abs(row[1]), default=(0, 0.0))
    if per not in (None, 1.0) and abs(flow) > 3.0 * per * np.sum(np.abs(case.loop.actuator.high)):
        yield (
            f"inflow of {label_of(plant, 'tank', tank)}: {flow:.5g} {length}^3/s is"
            f" {flow / per:.5g} {drive}, far more than all inputs together: a number without a unit"
            f' is in {length}^3/s; write "{flow:.5g} {drive}" if that is meant'
        )


def _short_tables(case):
    """On tables of inflow that begin after the run does, or end before it."""
    plant, end = case.loop.plant, case.clock.duration
    *_, table = parts_of(case.loop.disturbance)
    for k, (tank, _, times, flows) in enumerate([] if table is None else table.tables()):
        flow = f"{label_of(plant, 'tank', tank)}: the inflow of its table"
        unit, first, last = f"{case.loop.units[0]}^3/s", float(times[0]), float(times[-1])
        if first >= case.clock.dt:
            use = f"its first value, {flows[0]:.4g} {unit}, is also used from 0 s on"
            yield f"{flow} begins at {first:g} s: {use}; give a row at 0 s, or times from there"
        record = k in getattr(table, "records", ()) or len(times) >= MEASURED
        if record and end - last > max(np.diff(times), default=end):
            yield (
                f"{flow} ends at {last:g} s, and the run at {end:g} s: its last value,"
                f" {flows[-1]:.4g} {unit}, is held for {end - last:g} s; duration ="
                f" {last:g} ends the run with the table, repeat = ... begins its rows again"
            )


def _overlapping(case):
    """On changes of an output that begin before the one before is over."""
    reference = steps(case.loop.reference)
    if reference is None:
        return
    over, early = {}, []
    for time, output in reference.changes:
        if time < over.get(output, 0.0) - 1e-7 * case.clock.dt:
            early.append((output, time))
        over[output] = time + reference.ramp
    if early:
        yield (
            f"reference: {len(early)} of {len(reference.changes)} changes begin before the one"
            f" before is over (ramp {reference.ramp:g} s), the first of output {early[0][0] + 1} at"
            f" {early[0][1]:g} s: each starts from where that one has got to"
        )


def _unseen(case):
    """On faults, sines and pulses between two samples, and changes replaced before the next one."""
    loop, clock = case.loop, case.clock
    between = f"no sample, every {clock.dt:g} s, lies in it: it has no effect"
    if loop.faults is not None:
        for k in loop.faults.unseen(clock):
            of, start, end = loop.faults.events[k]
            if start < clock.duration:
                yield f"fault {k + 1} of {of} from {start:g} s to {end:g} s: {between}"
        for k, (of, *_) in enumerate(loop.faults.windows):
            if of.startswith(("rim[", "caught[")) and not loop.plant.overflow:
                yield f"fault {k + 1} of {of}: rims are limits here: it has no effect"
    sine = getattr(loop.reference, "second", None)
    if isinstance(sine, Sine) and not _holds_sample(sine.start, sine.end, clock):
        yield f"reference.sine from {sine.start:g} s to {sine.end:g} s: {between}"
    pulses, *_ = parts_of(loop.disturbance)
    if pulses is not None:
        window = pulses.window
        for time in pulses.onset:
            if time < clock.duration and not _holds_sample(time, time + window, clock):
                yield f"disturbance.window = {window:g} s after the pulse at {time:g} s: {between}"
    for name, signal in _ramps_of(loop).items():
        yield from _replaced(name, signal, clock)


def _replaced(name, signal, clock):
    """On changes of a channel that another one follows before the next sample."""
    before = {}
    for time, channel in () if signal.ramp > 0.0 else signal.changes:
        last = before.get(channel)
        if last is not None and index(last, clock) == index(time, clock):
            yield (
                f"{name}: the change of {channel + 1} at {last:g} s is followed by another one at"
                f" {time:g} s before the next sample, every {clock.dt:g} s: it has no effect"
            )
        before[channel] = time


def _holds_sample(start, end, clock):
    """Whether a sample of the run is at or after `start` [s] and before `end` [s]."""
    first = index(start, clock)
    return first * clock.dt < end - 1e-7 * clock.dt and first < clock.samples


def _above_rims(case):
    """On levels at t = 0 and setpoints above a rim."""
    plant, length, reference = case.loop.plant, case.loop.units[0], steps(case.loop.reference)
    rim, tanks = np.asarray(plant.rim), [label_of(plant, "tank", i) for i in range(plant.tanks)]
    limits = "rims are limits here and not physics"
    for i, level in enumerate(np.asarray(case.loop.x0)):
        if level > rim[i]:
            yield (
                f"{tanks[i]} starts at {level:g} {length}, above its rim at {rim[i]:g} {length}: "
                + ("what is above it overflows at once" if plant.overflow else limits)
            )
    if reference is None:
        return
    for i, tank in enumerate(plant.outputs):
        targets = zip(reference.changes, np.asarray(reference.targets))
        highest = max([reference.initial[i], *(v for (_, j), v in targets if j == i)])
        if highest > rim[tank]:
            yield (
                f"reference: {label_of(plant, 'output', i)} is asked for {highest:g} {length},"
                f" above the rim of {tanks[tank]} at {rim[tank]:g} {length}: "
                + ("a level cannot get there" if plant.overflow else limits)
            )


def _limits_of_levels(case):
    """On limits on levels that the start breaks, or that no level can reach."""
    plant, length, start = case.loop.plant, case.loop.units[0], np.asarray(case.loop.x0)
    for measure, side, sign in (("max_level", "above", 1.0), ("min_level", "below", -1.0)):
        limits = case.limits.get(measure)
        if limits is None or isinstance(limits, str):
            continue
        for i, limit in enumerate(np.broadcast_to(np.asarray(limits, dtype=float), plant.tanks)):
            tank, rim = label_of(plant, "tank", i), float(plant.rim[i])
            if np.isfinite(limit) and sign * (start[i] - limit) > 0.0:
                yield (
                    f"{tank} starts at {start[i]:g} {length}, {side} its limit of {limit:g}"
                    f" {length}: it is broken at t = 0 whatever the gains"
                )
            if sign < 0.0 or not np.isfinite(limit) or limit <= rim:
                continue
            where = f"limits.max_level of {tank} is {limit:g} {length}"
            if limit > 2.0 * rim:
                yield f"{where}, far above its rim at {rim:g} {length}: limits are in {length}"
            else:
                yield f"{where}, above its rim at {rim:g} {length}" + (
                    ", where the tank overflows: no run can break it; limit overflow_volume"
                    if plant.overflow
                    else ": the simulation goes on above the rim as in a higher tank;"
                    " plant.overflow = true simulates the overflow"
                )


def _constraints(case):
    """On input constraints of a controller beyond what the pumps do."""
    loop = case.loop
    amount = lambda value, j: with_input_unit(value, loop.plant, j, loop.units[1])
    controller, bank = loop.controller, loop.actuator
    if getattr(controller, "mode", "") != "constrained":
        return
    for name, pumps, sign in (("u_low", bank.low, -1.0), ("u_high", bank.high, 1.0)):
        limits = np.asarray(getattr(controller, name, pumps), dtype=float)
        for j, (limit, pump) in enumerate(zip(limits, np.asarray(pumps, dtype=float))):
            if sign * (limit - pump) > 0.0:
                yield (
                    f"controller.{name}[{j}] = {amount(limit, j)} is beyond the limit of"
                    f" {label_of(loop.plant, 'pump', j)}, {amount(pump, j)}: the controller"
                    " plans with inputs that the pump cannot give"
                )


def _pumps(case):
    """On pumps that start outside their limits."""
    bank, plant = case.loop.actuator, case.loop.plant
    amount = lambda value, j: with_input_unit(value, plant, j, case.loop.units[1])
    rows = zip(*(np.asarray(v) for v in (bank.low, bank.initial, bank.high)))
    for j, (low, volts, high) in enumerate(rows):
        if not low <= volts <= high:
            yield (
                f"{label_of(plant, 'pump', j)} runs at {amount(volts, j)} before t = 0,"
                f" outside its limits of {low:g} and {amount(high, j)}"
            )


def _played(case):
    """On inputs of an open loop beyond the limits of their pump or valve."""
    plant, bank = case.loop.plant, case.loop.actuator
    signal = steps(getattr(case.loop.controller, "signal", None))
    if signal is None:
        return
    for j in range(plant.pumps):
        targets = [v for (_, i), v in zip(signal.changes, np.asarray(signal.targets)) if i == j]
        inputs = np.array([signal.initial[j], *targets])
        low, high, unit = bank.low[j], bank.high[j], input_unit(plant, j, case.loop.units[1])
        beyond = np.maximum(low - inputs, inputs - high)
        k = int(np.argmax(beyond))
        if beyond[k] > 1e-9 * abs(inputs[k]):
            yield (
                f"inputs: {label_of(plant, 'pump', j)} goes to {inputs[k]:g} {unit}, beyond its"
                f" limits of {low:g} and {high:g} {unit}: it runs at the limit"
            )


def _standing(case):
    """On late pumps that stood still before t = 0, though the level of the start needs an input."""
    bank, (_, drive) = case.loop.actuator, case.loop.units
    part = getattr(case.loop.controller, "law", case.loop.controller)
    late = bank.delay or any(bank.delays) or bank.lag is not None or bank.rate is not None
    if not isinstance(part, PID) or part.reads_inflow or not late:
        return
    steady = part.inner_bias if isinstance(part, Cascade) else part.bias
    if isinstance(part, SharedPID):
        steady = part.shared(steady)
    steady = np.clip(np.asarray(steady), np.asarray(bank.low), np.asarray(bank.high))
    for j, (first, bias) in enumerate(zip(np.asarray(bank.initial), steady)):
        reach = float(bank.high[j] - bank.low[j])
        if first == 0.0 and abs(bias) > STILL * (reach if np.isfinite(reach) else abs(bias)):
            yield (
                f"{label_of(case.loop.plant, 'pump', j)} ran at 0 {drive} before t = 0, where"
                f" {bias:.4g} {drive} hold the level of the start: while its dead time, lag or rate"
                f" limit lasts, the level leaves its start; initial = {bias:.4g} keeps it there"
            )


def _openings(case):
    """On valves of a rig whose inputs are in %, that open by less than 1 %."""
    plant, bank = case.loop.plant, case.loop.actuator
    if case.loop.units[1] != "%":
        return
    for j in range(plant.pumps - len(getattr(plant, "valves", ())), plant.pumps):
        high, initial = float(bank.high[j]), float(bank.initial[j])
        if high <= 1.0 or 0.0 < initial <= 1.0:
            yield (
                f"{label_of(plant, 'pump', j)}: openings are in % here as all inputs: high ="
                f" {high:g} %, initial = {initial:g} %; full open is 100"
            )


def _coarse_prediction(case):
    """On a governor whose predicted loop is unstable, so that it may let no setpoint through."""
    governor, loop = getattr(case.loop.controller, "law", case.loop.controller), case.loop
    if not isinstance(governor, ReferenceGovernor):
        return
    inputs = loop.actuator.driving(tuple(np.asarray(loop.actuator.initial, dtype=float)))
    linear = linearise_compiled(governor.model, np.asarray(loop.x0, dtype=float), inputs)
    A, B, C = (np.asarray(v, dtype=float) for v in linear)
    gains = np.zeros((B.shape[1], len(C)))
    np.fill_diagonal(gains, np.asarray(governor.signed_gain, dtype=float))
    rates = np.block([[A, B], [np.zeros((B.shape[1], sum(B.shape)))]])

    def unstable(samples):
        onward = scipy.linalg.expm(rates * float(governor.horizon) / samples)[: len(A)]
        closed = onward[:, : len(A)] - onward[:, len(A) :] @ gains @ C
        return np.abs(np.linalg.eigvals(closed)).max() > 1.0 + 1e-6

    N = governor.samples
    if unstable(N):
        enough = next((n for n in range(N, 1001) if not unstable(n)), None)
        more = f"controller.samples = {enough} or more, " if enough else ""
        yield (
            f"the loop that the governor predicts, in {N} samples of"
            f" {float(governor.horizon) / N:.3g} s, is unstable, so that it may block every change"
            f" of a setpoint: {more}a shorter controller.horizon or a smaller Kc helps"
        )


def wrong_signs(case):
    """Sentences on gains of a PID that drive a level away from its setpoint."""
    part, plant = getattr(case.loop.controller, "law", case.loop.controller), case.loop.plant
    if not isinstance(part, PID) or not isinstance(plant, TankNetwork):
        return
    name, gains, tanks_of = "Kc", part.signed_gain, part.model.outputs
    if isinstance(part, Cascade) and part.inner:
        name, gains, tanks_of = "inner_Kc", part.inner_Kc, part.inner
    sources = plant.sources or (None,) * len(plant.feeds)  # (source, sink, ...) of each input
    ends = [(source, *feed) for source, feed in zip(sources, plant.feeds)] + list(plant.valves)
    reached = [_downstream(plant, (i for i in tanks if i is not None)) for tanks in ends]
    moved = set().union(*map(part.inputs_of, range(len(tanks_of))))
    for i, tank in enumerate(tanks_of):
        members = part.inputs_of(i)
        # through the input of another loop the sign of a loop alone decides nothing
        if any(tank in reached[j] for j in moved.difference(members)):
            continue
        gain = float(np.asarray(gains)[i])
        of_members = {j: ends[j] for j in members}
        yield from _wrong_ways(plant, part, f"controller.{name}", gain, of_members, (i, tank))


def _acts(plant, ends, tank):
    """1 where an input of ends (source, sink, ...) raises a level, -1 where it lowers it, or 0."""
    if ends in [tuple(pair) for pair in plant.valves if None not in pair]:
        return 0  # it may run backwards
    if tank in ends:
        return (tank in ends[1:]) - (tank == ends[0])
    into, out_of = (tank in _reached(plant, side, ends) for side in (ends[1:], ends[:1]))
    return into - out_of


def _reached(plant, tanks, ends):
    """The tanks whose levels depend on flows into `tanks`, but through the input of these ends."""
    tanks = (i for i in tanks if i is not None)
    return _downstream(plant, tanks, spills=False, without=tuple(ends))


def _moves(plant, j, ends, tank, act):
    """Words on how an input acts on a tank."""
    words = f"{label_of(plant, 'pump', j)} {'fills' if act > 0 else 'empties'}"
    if tank in ends:
        return f"{words} {label_of(plant, 'tank', tank)}"
    side = ends[:1] if act < 0 else ends[1:]
    nearest = next(i for i in side if i is not None and tank in _reached(plant, [i], ends))
    tanks = (label_of(plant, "tank", i) for i in (nearest, tank))
    return f"{words} {', upstream of '.join(tanks)}"


def _wrong_ways(plant, part, name, gain, ends, places):
    """Sentences on a gain of the wrong sign; ends: {input: (source, sink, ...)}."""
    output, tank = label_of(plant, "output", places[0]), places[1]
    acts = {j: _acts(plant, of, tank) for j, of in ends.items()}
    words = {j: _moves(plant, j, ends[j], tank, act) for j, act in acts.items() if act}
    effects = {j: -act if j in part.reversed_inputs else act for j, act in acts.items()}
    if isinstance(part, SplitRange) and {-1, 1} <= set(effects.values()):
        emptying = {j for j, act in acts.items() if act < 0}
        reverse = sorted(set(part.reversed_inputs) - set(acts) | emptying)
        values = (f'"{of}"' if (of := name_of(plant, "pump", j)) else f"{j + 1}" for j in reverse)
        write = f"write reverse = [{', '.join(values)}]" if reverse else "leave reverse out"
        yield (
            f"controller.reverse: {', '.join(words.values())}, and no sign of controller.Kc of"
            f" {output} = {gain:g} brings its level to the setpoint through each of them: {write}"
            + ", and change the sign of controller.Kc"
            * (gain < 0.0)
        )
        return
    for j, effect in effects.items():
        if gain * effect < 0.0:
            yield (
                f"{name} of {output} = {gain:g}: {words[j]}, and this sign drives its level away"
                " from the setpoint: change the sign"
            )


def _switches(case):
    """On the levels of an on-off controller that would drive a tank to its end."""
    part, plant = getattr(case.loop.controller, "law", case.loop.controller), case.loop.plant
    if not isinstance(part, controllers.OnOff) or not isinstance(plant, TankNetwork):
        return
    unit, sources = case.loop.units[0], plant.sources or (None,) * len(plant.feeds)
    ends = [(source, *feed) for source, feed in zip(sources, plant.feeds)] + list(plant.valves)
    for i, (tank, (source, *sinks)) in enumerate(zip(part.model.outputs, ends)):
        on, off, low, high = (
            float(np.asarray(v)[i]) for v in (part.on, part.off, part.low, part.high)
        )
        act = ((tank in sinks) - (tank == source)) * np.sign(high - low)
        if act * (on - off) > 0.0:
            side, end = ("above", "runs empty") if on > off else ("below", "runs full")
            does = "fills" if tank in sinks else "empties"
            yield (
                f"controller.on = {on:g} {unit} is {side} controller.off = {off:g} {unit}:"
                f" {label_of(plant, 'pump', i)} {does} {label_of(plant, 'tank', tank)}, which"
                f" {end} while it is off: exchange on and off"
            )


def _ranges(case):
    """On a split range without spans whose inputs are in different units."""
    part, plant = getattr(case.loop.controller, "law", case.loop.controller), case.loop.plant
    if not isinstance(part, SplitRange) or part.span is not None:
        return
    widths = np.asarray(part.high, dtype=float) - np.asarray(part.low, dtype=float)
    for i, members in enumerate(part.sequence):
        units = {j: input_unit(plant, j, case.loop.units[1]) for j in members}
        if len(set(units.values())) > 1:
            of = {j: "" if unit == "-" else f" {unit}" for j, unit in units.items()}
            shares = (f"{label_of(plant, 'pump', j)} {widths[j]:g}{of[j]}" for j in members)
            yield (
                f"controller.span is left out, and the inputs of {label_of(plant, 'output', i)} are"
                f" in different units: their ranges, {', '.join(shares)}, count as equal units of"
                " the output of its PID; write span, what each input takes of it"
            )


def _downstream(plant, tanks, spills=True, without=None):
    """The tanks whose levels depend on flows into or out of `tanks`; `without` a valve's ends."""
    valves = [pair for pair in plant.valves if tuple(pair) != without]
    pairs = [*plant.links, *(plant.spills if spills else ()), *valves]
    pairs += [pair for a, b in plant.pipes for pair in ((a, b), (b, a))]
    reached, queue = set(), list(tanks)
    while queue:
        tank = queue.pop()
        if tank not in reached:
            reached.add(tank)
            queue += [sink for source, sink in pairs if source == tank and sink is not None]
    return reached


def _feed_forward(case):
    """On a gain of the measured inflow that was hardly meant in length^3/s."""
    part, units = getattr(case.loop.controller, "law", case.loop.controller), case.loop.units
    flow, plant = flow_per_input(units), case.loop.plant
    valves_alone = getattr(plant, "valves", ()) and not plant.feeds
    for name in ("inflow_gain", "inflow_ratio"):
        gains = getattr(part, name, None)
        if gains is None or flow is None or isinstance(part, Cascade) or valves_alone:
            continue
        most = flow * float(np.max(np.abs(gains)))
        if 0.0 < most < LEAST_SHARE:
            yield (
                f"controller.{name}: {100 * most:.3g} % of the measured inflow: a number is in"
                f" {units[1]} per {units[0]}^3/s, of which {1 / flow:.6g} are the whole inflow;"
                f' write "100 %"'
            )


def _open_bottoms(case):
    """On tanks without a bottom out of which liquid can be drawn."""
    if isinstance(case.loop.plant, TankNetwork) and is_open(case.loop):
        yield (
            "plant.bottom = false, and liquid can be drawn out (an inflow or a pump below 0):"
            " levels may fall below 0; true stops them there"
        )


def _unused(case):
    """On an observer whose estimate of disturbances acts on no pump."""
    if is_unused(case.loop):
        part = getattr(case.loop.controller, "law", case.loop.controller)
        without = " without feed-forward" if hasattr(part, "feed_forward") else ""
        yield (
            "observer: its estimate of disturbances (estimate.d) has no effect: the controller"
            f" {type(part).__name__}{without} does not use it"
        )


def model_warnings(case: Case) -> list[str]:
    """Return a sentence for each parameter of a model that is off by more than its uncertainty."""
    sentences = []
    for holder in ("controller", "observer"):
        part = getattr(case.loop, holder)
        inner = f"{holder}.law." if is_component(getattr(part, "law", None)) else f"{holder}."
        part = getattr(part, "law", part)
        model = getattr(part, "model", None)
        if model is not None and getattr(part, "reads_model", True):
            sentences += _differences(case, holder, model, f"{inner}model.")
    return sentences


def _differences(case, holder, model, prefix):
    """`model_warnings` of the model of one holder; prefix: of its dotted names."""
    # no level depends on rims that are no physics
    vacant = () if getattr(model, "overflow", False) else ("rim", "caught")
    theirs = {name: value for name, value, _ in walk(model) if name not in vacant}
    preset = presets.find(case.origin).loop if case.origin else None
    for name, value, meta in walk(case.loop.plant):
        other = theirs.get(name)
        if value is None or other is None or np.shape(other) != np.shape(value):
            continue
        pairs = {f"plant.{name}": value, prefix + name: other}
        same = lambda loop, n, v: has(loop, n) and np.array_equal(get_value(loop, n), v)
        if preset and all(same(preset, n, v) for n, v in pairs.items()):
            continue  # a difference that the preset itself has is meant
        plant, other = np.asarray(value, dtype=float), np.asarray(other, dtype=float)
        allowed, words = _uncertainty(case, f"plant.{name}", plant)
        differs = other != plant  # both infinite: no outlet
        apart = np.abs(np.where(differs, other, 0.0) - np.where(differs, plant, 0.0))
        if np.any(differs & (apart > np.maximum(allowed, 1e-9 * np.abs(plant)))):
            unit = "" if meta["unit"] == "-" else f" {meta['unit']}"
            yield (
                f"{prefix}{name} = {_listed(other)}{unit}, and plant.{name} ="
                f" {_listed(plant)}{unit}: the model of the {holder} differs from the plant{words};"
                f" unless that is meant, set {prefix}{name} = {_listed(plant)} too (in a rig file a"
                " model that is left out follows the plant)"
            )


def _uncertainty(case, name, value):
    """(how far a model may be off the plant's parameter `name`, in its unit; the same in words)."""
    allowed, words = np.zeros(np.shape(value)), ""
    for key, share in case.uncertain.items():
        base, index = split_index(key)
        if base == name:
            allowed[index or ...] = share * np.abs(value[index or ...])
            words = f" by more than [uncertain] has ({100 * share:g} %)"
    for i, key in enumerate(case.covariance[0] if case.covariance else ()):
        base, index = split_index(key)
        if base == name:
            allowed[index or ...] = 2.0 * np.sqrt(case.covariance[1][i][i])
            words = " by more than two standard deviations of [covariance]"
    return allowed, words


def _listed(value):
    return "[" + ", ".join(f"{v:.6g}" for v in value) + "]" if np.ndim(value) else f"{value:.6g}"


def idle_parts(case):
    """Yield a sentence for each part of a case that has no effect on any run of it."""
    rules = (_closed, _valves, _dry, _overflows, _dead_zones)
    for rule in (
        *(rules if isinstance(case.loop.plant, TankNetwork) else ()),
        _faults,
        _gains,
        _courses,
    ):
        yield from rule(case)


def _at(values, k, usual):
    """Entry k of a leaf; `usual` where a plant has no such leaf."""
    return usual if values is None else float(values[k])


def _label(plant, kind, k):
    """What sentences call an opening."""
    if kind == "drain":
        return f"drain of {label_of(plant, 'tank', k)}"
    return label_of(plant, "pump", len(plant.feeds) + k) if kind == "valve" else f"{kind} {k + 1}"


def _closed(case):
    """On keys of drains and orifices that are closed."""
    plant = case.loop.plant
    leaks = {of for of, *_ in case.loop.faults.windows} if case.loop.faults else set()
    for kind in ("drain", "orifice"):
        ports, exponents, resistances = (
            getattr(plant, f"{kind}_{option}") for option in ("port", "exponent", "resistance")
        )
        for k in np.flatnonzero(np.asarray(getattr(plant, kind)) == 0.0).tolist():
            exponent, label = _at(exponents, k, EXPONENT), _label(plant, kind, k)
            if f"{kind}[{k}]" not in leaks and exponent != EXPONENT:
                yield f"{label}: exponent = {exponent:g} has no effect: its area is 0"
            sealed = f"{kind}[{k}]" not in leaks and np.isinf(_at(resistances, k, np.inf))
            if sealed and _at(ports, k, 0.0) > 0.0:
                yield f"{label}: port has no effect: it is closed"


def _valves(case):
    """On keys of valves of another kind."""
    plant = case.loop.plant
    for k, (_, sink) in enumerate(plant.valves):
        label, kind = _label(plant, "valve", k), plant.characteristics[k]
        share = _at(plant.rangeability, k, RANGEABILITY)
        if kind != "equal-percentage" and share != RANGEABILITY:
            word = kind if isinstance(kind, str) else "a table"
            yield f"{label}: rangeability = {share:g} has no effect: its characteristic is {word}"
        if plant.one_way[k] and sink is None:
            yield f"{label}: check = true has no effect: nothing comes back from the basin"


def _dry(case):
    """On openings at or above the rims of the tanks that they leave."""
    plant = case.loop.plant
    ends = {"drain": [(i,) for i in range(plant.tanks)], "pipe": plant.pipes}
    ends |= {"orifice": [links[:1] for links in plant.links], "valve": plant.valves}
    for kind, openings in ends.items():
        ports = getattr(plant, f"{kind}_port")
        if ports is None:
            continue
        for k, tanks in enumerate(openings):
            rim = max(float(plant.rim[i]) for i in tanks if i is not None)
            if float(ports[k]) >= rim:
                yield (
                    f"{_label(plant, kind, k)}: its port, {ports[k]:g} {plant.units[0]}, is not"
                    f" below the rim at {rim:g} {plant.units[0]}: nothing flows through it up to"
                    " there"
                )


def _overflows(case):
    """On spills of a rig whose overflow is not simulated."""
    plant = case.loop.plant
    if plant.spills and not plant.overflow:
        yield "plant.overflow = false: levels rise past their rims, and no [[spill]] has an effect"


def _dead_zones(case):
    """On inputs that never leave their dead zone, and on keys of a dead zone that is none."""
    plant, bank = case.loop.plant, case.loop.actuator
    zones = getattr(bank, "dead_zone", None)
    if zones is None:
        if getattr(bank, "dead_zone_kind", "plain") != "plain":
            yield f'actuator.dead_zone_kind = "{bank.dead_zone_kind}" has no effect: no dead_zone'
        return
    for j, (zone, high) in enumerate(zip(np.asarray(zones), np.asarray(bank.high))):
        if zone >= high > 0.0:
            yield (
                f"{label_of(plant, 'pump', j)} never runs: its dead_zone, {zone:g}, is not below"
                f" its high, {high:g}"
            )


def _faults(case):
    """On faults that change nothing."""
    faults = case.loop.faults
    if faults is None:
        return
    windows = faults.windows
    for k, (of, *_) in enumerate(windows):
        factor, extra = float(faults.factor[k]), float(faults.extra[k])
        value = float(get_value(case.loop.plant, of))
        if sum(other == of for other, *_ in windows) == 1 and value * factor + extra == value:
            yield (
                f"fault {k + 1} of {of}: factor = {factor:g} and extra = {extra:g} leave it at"
                f" {value:g}: it has no effect"
            )


def _gains(case):
    """On keys of the integral action of a PID without one."""
    part = case.loop.controller  # a schedule may hold the Ti of its law
    if not isinstance(part, PID) or part.Ti is not None:
        return
    if part.anti_windup != "back-calculation":
        yield f'controller.anti_windup = "{part.anti_windup}" has no effect: there is no Ti'


def _courses(case):
    """On a shape of ramps of no duration, and sines and pulses of nothing."""
    for name, signal in _ramps_of(case.loop).items():
        if signal.changes and not signal.ramp and signal.shape != "linear":
            yield f'{name}.shape = "{signal.shape}" has no effect: {name}.ramp is 0'
    sine = getattr(case.loop.reference, "second", None)
    if isinstance(sine, Sine):
        if float(sine.amplitude) == 0.0 == float(sine.offset):
            yield "reference.sine has no effect: its amplitude is 0"
        elif sine.period < 2.0 * case.clock.dt:
            yield (
                f"reference.sine.period = {sine.period:g} s is below two samples of"
                f" {case.clock.dt:g} s: the samples show another, slower sine"
            )
    pulses, *_ = parts_of(case.loop.disturbance)
    if pulses is not None:
        for k in np.flatnonzero(np.asarray(pulses.volume) == 0.0):
            yield f"inflow at {pulses.events[k][0]:g} s has no effect: its volume is 0"
