"""Simulation-based calibration of the posterior of `identify` (Talts et al., arXiv:1804.06788).

Parameters are drawn from the [covariance] of a rig, a log is made with them and identified with
that covariance as the prior: the share of the posterior below the true value is then uniform.

python tests/audits/calibration.py [N]            Laplace, N (200) logs of each of two rigs
python tests/audits/calibration.py --hmc [N]      draws by NUTS, N (60) logs of the smaller one
"""

import sys
from pathlib import Path

import jax
import numpy as np
from scipy import stats

import jaxtank
import tuning
from jaxtank import rig
from jaxtank.core.tree import get_value, with_values

RIGS = Path(__file__).parents[1] / "data" / "rigs"

ONE = """
name = "one tank"
tank = [{ area = 10.0, rim = 20.0, drain = 0.05, level = 5.0 }]
pump = [{ gain = 3.0, to = 1, high = 10.0, initial = 1.5 }]
controller = { kind = "pi", Kc = 1.0, Ti = 20.0 }
reference = { initial = [5.0], changes = [[5.0, 1, 12.0]] }
values = { "clock.dt" = 0.5, "clock.duration" = 60.0, "sensor.noise" = [0.05] }
"""


def one_tank(folder):
    """A tank with a drain and a pump: two parameters."""
    path = folder / "one.toml"
    path.write_text(ONE)
    return rig.load(path), ("plant.pump_gain[0]", "plant.drain[0]")


def two_tanks(folder):
    """Two tanks in series without overflow: three parameters."""
    case = rig.load(RIGS / "two_tanks.toml")
    values = {"sensor.noise": 0.05, "plant.overflow": False, "reference.targets": [5.0, 3.0]}
    values |= {"clock.duration": 800.0}
    names = ("plant.pump_gain[0]", "plant.drain[1]", "plant.orifice[0]")
    return rig.set_values(case, values), names


def replicates(case, names, count, spread=0.05, seed=0):
    """Yield (values, Log, case with the prior) of `count` draws of the prior."""
    nominal = np.array([float(get_value(case.loop, name)) for name in names])
    rng = np.random.default_rng(seed)
    matrix = np.outer(nominal, nominal) * spread**2 * (0.7 * np.eye(len(names)) + 0.3)
    prior = case.replace(covariance=(names, tuple(map(tuple, matrix))))
    for k in range(count):
        values = rng.multivariate_normal(nominal, matrix)
        loop = with_values(case.loop, dict(zip(names, values)))
        run = jaxtank.simulate(loop, case.clock, jax.random.key(seed * 10**6 + k))
        log = tuning.log(t=np.asarray(run.t), u=np.asarray(run.u), y=np.asarray(run.y))
        yield values, log, prior


def shares(case, names, count, hmc=False, seed=0):
    """(count, n) share of the posterior below the true value, of each log and parameter."""
    rows = []
    for values, log, prior in replicates(case, names, count, seed=seed):
        free = {n: (v / 3, v * 3) for n, v in zip(names, np.abs(values))}
        fit = tuning.identify(prior, log, free, starts=1, hold_back=0, substeps=4)
        if hmc:
            from tuning.identification.posterior import with_draws

            draws = with_draws(fit, seed=len(rows)).posterior
            columns = [draws.values[:, draws.names.index(n)] for n in names]
            rows.append([np.mean(c < v) for c, v in zip(columns, values)])
        else:
            estimates = [fit.parameters[n] for n in names]
            scores = [(v - p["value"]) / p["sd"] for p, v in zip(estimates, values)]
            rows.append(stats.norm.cdf(scores))
    return np.array(rows)


def probabilities(shares):
    """(n,) probability of each parameter's shares, were they uniform (Kolmogorov-Smirnov)."""
    return np.array([stats.kstest(column, "uniform").pvalue for column in shares.T])


if __name__ == "__main__":
    import pathlib
    import tempfile

    jax.config.update("jax_enable_x64", True)
    hmc = "--hmc" in sys.argv
    count = int(next((w for w in sys.argv[1:] if w.isdigit()), 60 if hmc else 200))
    with tempfile.TemporaryDirectory() as name:
        for make in (one_tank,) if hmc else (one_tank, two_tanks):
            case, names = make(pathlib.Path(name))
            for n, p in zip(names, probabilities(shares(case, names, count, hmc))):
                print(f"{make.__name__} {n}: p = {p:.3f} of {count} logs", flush=True)
