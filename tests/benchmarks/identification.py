"""CPU seconds of identification: 64 noisy fits of the four-tank rig in one batch, and the fit to
the record of the cascaded tanks.

python tests/benchmarks/identification.py [cascaded_tanks.csv]
"""

import sys
import time

began = time.process_time()

import jax  # noqa: E402
import numpy as np  # noqa: E402

jax.config.update("jax_enable_x64", True)

import tuning  # noqa: E402
from jaxtank import presets  # noqa: E402
from jaxtank.core.tree import get_value  # noqa: E402
from tuning.identification import simulation  # noqa: E402

FREE = (
    "plant.pump_gain[0]",
    "plant.pump_gain[1]",
    "plant.drain[0]",
    "plant.drain[1]",
    "plant.orifice[0]",
)
"""Five coefficients, as in methods 1.5; with four levels at the start that makes nine unknowns."""


def logs_of(case, count, noise=0.1, samples=1201, seed=0):
    """(logs of a run of 1200 s at 1 Hz with `noise` [cm] drawn anew for each, inputs that step
    about the pumps' operating point).
    """
    rng = np.random.default_rng(seed)
    t = np.arange(samples) * 1.0
    rest = np.asarray(case.loop.actuator.initial)
    u = np.array([8.4, 8.4]) if not rest.any() else rest
    levels = 1 + 0.08 * np.sign(rng.standard_normal((samples // 60 + 1, 2)))
    u = np.clip(u * np.repeat(levels, 60, axis=0)[:samples], 0, 12)
    channels = tuple((i, False) for i in range(4))
    x0 = np.array([[10.0, 9.0, 8.0, 7.0]])
    dt = np.append(np.diff(t), 0.0)
    y = np.asarray(
        simulation.play(
            simulation.rig_of(case.loop), dt[None], u[None], x0, channels=channels, substeps=4
        )
    )[0]
    return [
        tuning.log(t=t, u=u, y=y + noise * rng.standard_normal(y.shape), name=f"log {e + 1}")
        for e in range(count)
    ], x0[0]


def four_tank(count=64):
    """Print what the batch costs and how well it does."""
    case = presets.load("gouta2015").cases["backstepping"]
    logs, x0 = logs_of(case, count)
    print(
        f"levels from {min(one.y.min() for one in logs):.1f} to"
        f" {max(one.y.max() for one in logs):.1f} cm"
    )
    truth = {n: float(get_value(case.loop, n)) for n in FREE}
    signs = np.where(np.arange(len(FREE)) % 2, 1.3, 0.7)
    from jaxtank.core.tree import with_values

    wrong = case.replace(
        loop=with_values(case.loop, {n: v * f for (n, v), f in zip(truth.items(), signs)})
    )
    free = {n: (v / 5, v * 5) for n, v in truth.items()}
    for words in ("first call, compiled with it", "second call"):
        start = time.process_time()
        found = tuning.identify_many(wrong, logs, free, noise=0.1)
        print(
            f"{count} fits of {len(FREE)} parameters and 4 levels, {words}:"
            f" {time.process_time() - start:.2f} core-s, {found.wall_s:.2f} s"
        )
    true = np.array([truth[n] for n in found.names])
    inside = (found.interval95[..., 0] <= true) & (true <= found.interval95[..., 1])
    print(
        f"converged {found.converged.sum()} of {count} in {found.iterations} iterations; 95 %"
        f" intervals cover {100 * inside.mean():.1f} %"
    )
    print("standard deviations %: " + ", ".join(f"{100 * v:.3f}" for v in found.sd.mean(0) / true))
    print(
        "scatter / predicted:   "
        + ", ".join(f"{v:.2f}" for v in found.values.std(0) / found.sd.mean(0))
    )
    print(
        "levels: scatter / predicted"
        f" {np.round((found.levels - x0).std(0) / found.levels_sd.mean(0), 2)}"
    )


def cascaded(path):
    """Print what the fit to the public record of the cascaded tanks costs, from a rig whose
    parameters are 30 % off.
    """
    case = presets.load("cascaded").cases["open-loop"]
    start, cpu = time.perf_counter(), time.process_time()
    log = tuning.read_log(path, case.loop, case.log)
    found = tuning.identify(case, log, hold_back=len(log.t) - 700)
    print(
        f"\n{found}\n{time.perf_counter() - start:.1f} s, {time.process_time() - cpu:.1f} core-s,"
        " compilation included"
    )


if __name__ == "__main__":
    print(f"imports {time.process_time() - began:.1f} core-s")
    four_tank()
    for name in sys.argv[1:]:
        cascaded(name)
