"""What the default rate of the safety filter costs and saves with noisy readings.

    python tests/audits/safety_rate.py            three cases of gouta2015, sigma 0.03 cm
    python tests/audits/safety_rate.py mirakhorli/lqi

Printed for kappa as it is without noise, and the default: errors of the nominal run and of 32
plants of the box, total variation of the inputs per sample in % of their range, gap.
"""

import sys

import jax
import numpy as np
from safety_attacks import corners

from jaxtank import evaluate, presets, rig
from jaxtank.core.tree import with_values

SIGMA, PLANTS, SPREAD = 0.03, 32, 0.05
CASES = {"gouta2015/backstepping": 0.05, "gouta2015/backstepping-ff": 0.1, "gouta2015/ngpc": 0.1}
MEASURES = ["rms_error_total", "input_travel", "filter_active_fraction"]


def row(case, rate):
    """The line of a case at a rate [1/s], or its default."""
    given = {} if rate is None else {"rate": rate}
    _, rows = case.safety_design(**given)
    loop = case.with_safety_filter(**given).loop
    drawn = corners(np.random.default_rng(1), loop.plant, PLANTS, SPREAD)
    values = {f"plant.{n}": v for n, v in drawn.items() if v.size}

    @jax.jit
    @jax.vmap
    def run(values, key):
        return evaluate(with_values(loop, values), case.clock, MEASURES, key)

    of = run(values, jax.random.split(jax.random.key(0), PLANTS))
    nominal = evaluate(loop, case.clock, MEASURES, jax.random.key(0))
    span = np.asarray(loop.actuator.high) - np.maximum(loop.actuator.low, 0.0)
    change = 100.0 * np.mean(np.asarray(of["input_travel"]) / span) / case.clock.samples
    gap = np.nanmax([r.gap for r in rows])
    return (
        f"kappa {rows[0].rate:.3g} 1/s: error {float(nominal['rms_error_total']):.4f} cm nominal,"
        f" {float(of['rms_error_total'].mean()):.4f} cm mean, inputs {change:.3f} % per sample,"
        f" acts in {100 * float(of['filter_active_fraction'].mean()):.1f} %, gap {gap:.3f} cm"
    )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name in sys.argv[1:] or CASES:
        dt = CASES.get(name, presets.find(name).clock.dt)
        case = rig.set_values(presets.find(name), {"sensor.noise": SIGMA, "clock.dt": dt})
        quiet = presets.find(name).replace(clock=case.clock).safety_design()[1][0].rate
        for rate in (quiet, None):
            print(f"{name}, T {dt:g} s, {row(case, rate)}", flush=True)
