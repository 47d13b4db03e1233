"""The loop of `rivals.py`, and its gradient by two gains, in two other differentiable simulators.

    pip install jaxonomy fugacio
    python tests/benchmarks/simulators.py [rounds] [--markdown]

Each is timed as it comes and with the XLA options that importing jaxtank sets, in processes of its
own, in turn: core time of the second and later calls, medians, and ratios in the same round to ours
on the same samples. What is not installed is named. Nothing is asserted: machines differ.
"""

import json
import os
import statistics
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import rivals
from measuring import core_times, first_number, report, with_range

from jaxtank import presets
from jaxtank.core.tree import get_value
from jaxtank.loop import run as loop

BEGIN, END = "<!-- tests/benchmarks/simulators.py -->", "<!-- end of simulators -->"
CALLS = 3
"""Timed calls of a round, of which the least counts."""

GAINS = ("controller.k", "controller.k1")


def jaxonomy_system(case, r, x0):
    """A `LeafSystem`: levels as a continuous state, the held inputs and the sum of squared errors
    as a discrete one that a controller updates at every sample. Returns (system, context of
    (k + k1, k1), cost of the context at the end).
    """
    import jaxonomy

    c, gain, k1, b, floor, high = rivals.constants(case)
    rows = jnp.asarray(r.T)

    class Loop(jaxonomy.LeafSystem):
        def __init__(self):
            super().__init__(name="loop")
            self.declare_dynamic_parameter("gains", np.array([gain, k1]))
            self.declare_continuous_state(default_value=jnp.asarray(x0, float), ode=self.ode)
            self.declare_discrete_state(default_value=jnp.zeros(4))
            self.declare_periodic_update(self.sample, period=case.clock.dt, offset=0.0)

        def ode(self, time, state, **given):
            return jnp.stack(rivals.field(c, state.continuous_state, state.discrete_state[:2], jnp))

        def sample(self, time, state, **given):
            x, total, k = state.continuous_state, *state.discrete_state[2:]
            now = rows[k.astype(int)]
            u = rivals.controller(c, *given["gains"], b, floor, high, x, now, jnp)
            total = total + jnp.sum((x[:2] - now) ** 2)
            return jnp.stack([*u, total, k + 1.0])

    system = Loop()

    def context(gains):
        return system.create_context().with_parameter("gains", gains)

    def cost(context):
        total, k = context.discrete_state[2:]
        return jnp.sqrt(total / k)

    return system, context, cost


def jaxonomy_options(case, samples):
    import jaxonomy

    return jaxonomy.SimulatorOptions(
        ode_solver_method="rk4",
        max_minor_step_size=case.clock.dt,
        max_major_steps=samples + 8,
        save_time_series=False,
    )


def by_jaxonomy(case, r, x0):
    """(run, gradient, samples) by `simulate` and `simulate_jacfwd` of jaxonomy."""
    import jaxonomy

    system, context, cost = jaxonomy_system(case, r, x0)
    gains = jnp.array(rivals.constants(case)[1:3])
    until = (0.0, (r.shape[1] - 1) * case.clock.dt + 1e-6)  # hardly a step after the last sample
    options = jaxonomy_options(case, r.shape[1])

    @jax.jit
    def run(gains):
        return cost(jaxonomy.simulate(system, context(gains), until, options=options).context)

    slopes = jax.jit(
        lambda gains: jaxonomy.simulation.simulator.simulate_jacfwd(
            system, context, until, gains, cost, options=options
        )
    )
    return lambda: run(gains), lambda: slopes(gains), r.shape[1]


def by_fugacio(case, r, x0):
    """(run, gradient, samples) by `odeint` of fugacio, one step to a sample; the controller acts in
    all stages, for its simulations know no held inputs.
    """
    from fugacio.sim.dynamics import odeint

    c, gain, k1, b, floor, high = rivals.constants(case)
    rows, h = jnp.asarray(r.T), case.clock.dt
    t = jnp.arange(r.shape[1]) * h

    def rates(t, y, gains):
        now = rows[jnp.floor(t / h + 1e-6).astype(int)]
        u = rivals.controller(c, *gains, b, floor, high, y, now, jnp)
        return jnp.stack(rivals.field(c, y, u, jnp))

    def cost(gains):
        levels = odeint(rates, jnp.asarray(x0, float), t, gains)
        return jnp.sqrt(jnp.mean(jnp.sum((levels[:, :2] - rows) ** 2, axis=1)))

    run, slopes, gains = jax.jit(cost), jax.jit(jax.jacfwd(cost)), jnp.array([gain, k1])
    return lambda: run(gains), lambda: slopes(gains), r.shape[1]


def by_jaxtank(case, r, x0):
    """(run, gradient, samples) of ours."""
    names, point = ("rms_error_total",), {name: get_value(case.loop, name) for name in GAINS}

    def run():
        return loop.evaluate(case.loop, case.clock, names)[names[0]]

    def gradient():
        slopes = loop.sensitivities(case.loop, case.clock, names, point)[1][names[0]]
        by_k, by_k1 = jnp.ravel(slopes)
        return jnp.stack([by_k, by_k1 - by_k])  # by k + k1 with k1 held, and by k1

    return run, gradient, r.shape[1]


SIMULATORS = {
    "jaxtank": by_jaxtank,
    "jaxonomy": by_jaxonomy,
    "fugacio, controller in all stages": by_fugacio,
}


def measure(name):
    """Print JSON: core time of a step [s] of a run and of a gradient, and what they give."""
    jax.config.update("jax_enable_x64", True)
    case = presets.find("gouta2015/backstepping")
    r = np.array([np.asarray(v) for v in case.loop.reference.sample(case.clock)[0]])
    *calls, samples = SIMULATORS[name](case, r, tuple(map(float, case.loop.x0)))
    found = []
    for call in calls:
        seconds = min(core_times({"": call}, CALLS)[""]) / samples
        found.append({"s": seconds, "value": np.ravel(call()).tolist()})
    print("JSON" + json.dumps(found))


def measured(name, option):
    """What `measure` prints in a process with or without the XLA options; None: not installed."""
    env = os.environ | {"JAXTANK_XLA_OPTION": option, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, __file__, "--one", name], env=env, capture_output=True, text=True
    )
    lines = [line[4:] for line in done.stdout.splitlines() if line.startswith("JSON")]
    if not lines and "ModuleNotFoundError" not in done.stderr:
        raise RuntimeError(done.stderr)
    return json.loads(lines[0]) if lines else None


HEADS = [
    *("", "XLA options", "run, ns per step", "times ours (range)", "gradient, times its own run"),
    *("gradient, times ours (range)", "RMS error from ours, cm", "slopes from ours"),
]


def main(words):
    if "--one" in words:
        return measure(words[words.index("--one") + 1])
    rounds = first_number(words, 5)
    kinds = [(n, o) for n in SIMULATORS for o in ("1", "0") if (n, o) != ("jaxtank", "0")]
    found = {kind: [] for kind in kinds}
    for _ in range(rounds):
        for kind in kinds:
            found[kind].append(measured(*kind))
    ours = found["jaxtank", "1"]
    rows = []
    for (name, option), all_rounds in found.items():
        if None in all_rounds:
            print(f"{name} is not installed")
            continue
        per = [1e9 * one[0]["s"] for one in all_rounds]
        ratios = [[one[i]["s"] / own[i]["s"] for one, own in zip(all_rounds, ours)] for i in (0, 1)]
        of_run = statistics.median(one[1]["s"] / one[0]["s"] for one in all_rounds)
        run, gradient = map(with_range, ratios)
        (error, slopes), (own, own_slopes) = (
            [np.array(part["value"]) for part in side[0]] for side in (all_rounds, ours)
        )
        apart = [abs(error - own).max(), (abs(slopes - own_slopes) / abs(own_slopes)).max()]
        options = "ours" if option == "1" else "as they come"
        cells = [options, f"{statistics.median(per):,.0f}", run, f"{of_run:.3g}", gradient]
        rows.append([name, *cells, f"{apart[0]:.1e}", f"{100 * apart[1]:.1g} %"])
    return report(words, HEADS, rows, BEGIN, END)


if __name__ == "__main__":
    main(sys.argv[1:])
