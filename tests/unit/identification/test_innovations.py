"""The likelihood of the innovations against a filter and logs of these tests' own, in NumPy."""

import dataclasses

import numpy as np
import pytest
from helpers import rk4

import tuning
from jaxtank import rig
from jaxtank.core.errors import InputError
from tuning.identification.innovations import Likelihood

RIG = """
name = "two tanks"
tank = [
    { area = 200.0, rim = 60.0, level = 12.0 },
    { area = 150.0, rim = 60.0, drain = 0.4, level = 10.0 },
]
orifice = [{ from = 1, to = 2, area = 0.35 }]
pump = [{ name = "P", to = 1, gain = 8.0, high = 12.0 }]
inputs = { initial = [5.0] }
"""
TRUE = {"plant.pump_gain[0]": 8.0, "plant.orifice[0]": 0.35, "plant.drain[1]": 0.4}
FREE = {name: (value / 5, value * 5) for name, value in TRUE.items()}
DT, NOISE, PROCESS = 4.0, 0.1, 0.03
SUBSTEPS = 2


def rate(x, v, gain=8.0, orifice=0.35, drain=0.4):
    """Rates of the two levels; also of complex levels."""
    first, second = orifice * np.sqrt(1962.0 * x[0]), drain * np.sqrt(1962.0 * x[1])
    return np.array([(gain * v - first) / 200.0, (first - second) / 150.0])


def data(seed, process=PROCESS, samples=200, parts=8, tanks=(1,)):
    """A log of Euler's and Maruyama's steps with noise on both levels."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(3.0, 9.0, samples // 20), 20)
    x, levels = np.array([12.0, 10.0]), []
    for v in u:
        levels.append(x)
        for _ in range(parts):
            x = x + DT / parts * rate(x, v) + process * np.sqrt(DT / parts) * rng.normal(size=2)
    y = np.array(levels)[:, list(tanks)] + NOISE * rng.normal(size=(samples, len(tanks)))
    return tuning.log(t=DT * np.arange(samples), u=u, y=y, tanks=list(tanks))


def log_likelihood(log, x, process, noise, **values):
    """That of an extended Kalman filter; the transition matrix by complex steps."""
    P, total = np.zeros((2, 2)), 0.0
    for k in range(log.samples):
        for c, tank in enumerate(log.tanks):
            if np.isnan(log.y[k, c]):
                continue
            H = np.eye(2)[tank]
            S, v = H @ P @ H + noise[c] ** 2, log.y[k, c] - x[tank]
            total -= 0.5 * (v**2 / S + np.log(2 * np.pi * S))
            K = P @ H / S
            x, P = x + K * v, P - np.outer(K, H @ P)
        step = lambda x, v=log.u[k, 0]: rk4(lambda x: rate(x, v, **values), x, DT / SUBSTEPS)
        move = lambda x, step=step: step(step(x))  # SUBSTEPS
        F = np.stack([move(x + 1e-30j * e).imag / 1e-30 for e in np.eye(2)], axis=1)
        x, P = move(x), F @ P @ F.T + DT * np.diag(process) ** 2
    return total


@pytest.fixture(scope="module")
def likelihood():
    """That of two channels with missing readings, at 10 % more than the case's parameters."""
    log = data(1, samples=60, tanks=(0, 1))
    log.y[7:12, 0] = log.y[20, 1] = np.nan
    case = rig.loads(RIG)
    estimation = tuning.Estimation(case, [log], FREE, noise=[0.05, 0.07], substeps=SUBSTEPS)
    problem = Likelihood(estimation)
    z = np.concatenate([estimation.nominal(), np.log([0.03, 0.08, 0.06, 0.09])])
    z[:3] += np.log(1.1)
    return problem, z


def test_the_likelihood_is_that_of_a_filter_in_numpy(likelihood):
    problem, z = likelihood
    v, S, *_ = problem.at(z)
    ours = -0.5 * np.sum(v**2 / S + np.log(2 * np.pi * S))
    log, levels = problem.estimation.logs[0], problem.split(z)[1][0]
    values = {"gain": 8.8, "orifice": 0.385, "drain": 0.44}
    theirs = log_likelihood(log, levels, [0.03, 0.08], [0.06, 0.09], **values)
    assert ours == pytest.approx(theirs, rel=1e-9)
    rows, _ = problem.residual_and_jacobian(z)
    shift = problem.shift[np.nonzero(problem.estimation.mask)[2]]
    rows = rows[: 2 * v.size]  # without those that hold the noises of the tanks together
    squares = rows @ rows - shift.sum() + v.size * np.log(2 * np.pi)
    assert -0.5 * squares == pytest.approx(theirs, rel=1e-9)


def test_its_slopes_are_those_of_differences(likelihood):
    problem, z = likelihood
    _, jacobian = problem.residual_and_jacobian(z)
    for i, e in enumerate(np.eye(z.size)):
        ends = [problem.residual_and_jacobian(z + s * 1e-6 * e)[0] for s in (1, -1)]
        np.testing.assert_allclose(jacobian[:, i], (ends[0] - ends[1]) / 2e-6, atol=2e-6)


def identified(log, likelihood):
    settings = {"starts": 1, "hold_back": 0, "substeps": SUBSTEPS, "likelihood": likelihood}
    return tuning.identify(rig.loads(RIG), log, FREE, **settings)


def covered(result, widened=True):
    """Whether each 95 % interval holds the true value; also of intervals for white noise."""
    share, hits = 1.0 if widened else 1.0 / result.quality["widened"], []
    for name, value in TRUE.items():
        ends, estimate = (result.parameters[name][key] for key in ("interval95", "value"))
        low, high = (estimate + share * (end - estimate) for end in ends)
        hits.append(low <= value <= high)
    return hits


@pytest.mark.slow
def test_the_data_choose_the_likelihood_and_the_noises():
    disturbed, quiet = (identified(data(3, process), "auto") for process in (PROCESS, 0.0))
    assert disturbed.likelihood["kind"] == "innovations"
    assert disturbed.likelihood["bic"]["innovations"] < disturbed.likelihood["bic"]["output-error"]
    assert disturbed.quality["noise"][0] == pytest.approx(NOISE, rel=0.4)
    process = disturbed.likelihood["process_noise"]
    assert np.sqrt(np.mean(np.square(process))) == pytest.approx(PROCESS, rel=0.4)
    assert disturbed.identified.loop.sensor.noise[1] == disturbed.quality["noise"][0]
    assert (quiet.likelihood["kind"], quiet.likelihood["reason"]) == ("output-error", "white")
    assert "likelihood: innovations, by the lower BIC" in str(disturbed)


def test_a_structure_whose_innovations_are_white_is_not_rejected():
    """Noise that drives the levels: residuals of the simulation are correlated, innovations not."""
    log, case = data(3, process=0.1, tanks=(0, 1)), rig.loads(RIG)
    result = tuning.identify(case, log, FREE, starts=1, likelihood="innovations")
    simulated = dataclasses.replace(result, likelihood={})
    assert not simulated.structure.white and not simulated.structure.causes
    assert result.structure.clean and not result.identified.rejected
    assert "rejected" not in str(result)


def test_a_robust_loss_beside_the_filter_is_refused():
    with pytest.raises(InputError, match="loss = 'huber' beside likelihood"):
        tuning.identify(rig.loads(RIG), data(1), FREE, loss="huber", likelihood="auto")


@pytest.mark.slow
def test_intervals_of_the_filter_cover_where_noise_drives_the_levels():
    logs = [data(100 + seed, samples=800) for seed in range(60)]
    by_filter = np.mean([covered(identified(log, "innovations")) for log in logs])
    simulated = [identified(log, "output-error") for log in logs]
    widened, white = (np.mean([covered(r, w) for r in simulated]) for w in (True, False))
    print(f"covered: {by_filter:.3f}; output error {widened:.3f}, for white noise {white:.3f}")
    assert 0.90 <= by_filter <= 0.98 and white < 0.8
