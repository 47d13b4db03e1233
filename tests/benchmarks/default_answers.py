"""The default answer of ten cases on plants that neither search nor its own judgement has used.

    python tests/benchmarks/default_answers.py                    # all rows; about half an hour
    python tests/benchmarks/default_answers.py 'gouta2015*'       # some, by name
    python tests/benchmarks/default_answers.py --plants 512       # fewer plants
    python tests/benchmarks/default_answers.py --again 'cascaded*'  # also: tuned again, other draws
    python tests/benchmarks/default_answers.py --offsets 'gouta2015*'  # also: where plants rest

Of each case: total rms error of its own run; its mean on --plants (4,096) plants; how many of
--attacked (10,000) random plants and 256 corners of the box pass a limit, noise on; rms change of
the inputs from sample to sample; published and tuned. The many plants run at ten times the step
where the search did (--true-step: at the case's own).
"""

import argparse
import fnmatch
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxtank
import tuning
from jaxtank import rig
from jaxtank.case import Scenario
from jaxtank.core.tree import get_value, with_values
from jaxtank.limits import limited_levels
from tuning.feasible.study import least_offsets
from tuning.problem.scenarios import groups_of, runs_of, values_of
from tuning.search.judged import judge
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.needs import Needs, plateaus_of
from tuning.uncertainty.sampling import probabilities

ROWS = {
    "gouta2015/backstepping": {},
    "gouta2015/backstepping-ff": {},
    "gouta2015/ngpc": {},
    "cascaded/pi": {},
    "gouta2022/chadpc, delay 0.2 s": {"actuator.delay": 0.2},
    "tests/data/rigs/watertank.toml": {},
    "tests/data/rigs/buffer_tank.toml": {},
    "khalid/laguerre": {},
    "calofir/backstepping": {},
    "mirakhorli/sfc": {},
}

CORNERS, OFFSETS = 256, 256


def main():
    """Print a row for each case."""
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=["*"])
    parser.add_argument("--plants", type=int, default=4096)
    parser.add_argument("--attacked", type=int, default=10_000)
    parser.add_argument("--true-step", action="store_true")
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--offsets", action="store_true")
    asked = parser.parse_args()
    for name, values in ROWS.items():
        if any(fnmatch.fnmatch(name, pattern) for pattern in asked.names):
            _row(name, values, asked)


def _row(name, values, asked):
    case = rig.set_values(rig.open_case(name.partition(",")[0]), values)
    began = time.process_time()
    result = tuning.tune(case)
    spent = time.process_time() - began
    answer = result.answer
    print(f"{name}: {result.status}, {spent:.1f} core-s")
    for n, p in result.parameters.items():
        print(f"    {n} {p['before']:.5g} -> {p['after']:.5g} {p['unit']} {p['at_bound'] or ''}")
    print(f"    own run {answer.nominal['before']:.4g} -> {answer.nominal['after']:.4g}")
    sides = {"before": result.case, "after": result.tuned}
    for side, one in sides.items():
        print(f"    {side}: {_side(answer.setting, one, asked)}")
    if asked.offsets:
        _offsets(answer.setting, result.tuned)
    if asked.again:
        _again(case, result, asked)


def _side(setting, one, asked):
    """Error and change of the inputs on --plants plants, and how many of --attacked spill."""
    noisy = with_values(one.loop, {"sensor.noise": setting.searched.loop.sensor.noise})
    here = setting.replace(searched=one.replace(loop=noisy, scenarios=()))
    if not asked.true_step:
        here = here.replace(searched=_coarse(here))
    found = judge(here, asked.plants, 77)
    spilt = judge(here, asked.attacked, 78)
    past = int((~spilt.held).sum()) + _corners(here)
    return (
        f"error {np.mean(found.error[~found.failed]):.4g}, cost {np.mean(found.cost):.4g}, change"
        f" {100 * np.mean(found.travel):.3g} %, past a limit {past} of {asked.attacked + CORNERS},"
        f" highest {np.round(spilt.level.max(axis=0), 3)}"
    )


def _offsets(setting, case):
    """How far from its setpoints a plant stays that cannot hold a plateau, and the least that
    algebra allows, for each such plateau: Euclidean over the outputs, mean of these plants.
    """
    here = _coarse(setting.replace(searched=case))
    draws = Draws(here.loop, setting.distributions)
    values = draws.values(probabilities("random", draws.dimensions, OFFSETS, 81))
    least = least_offsets(Needs(case, values, setting.case.limits))
    plateaus = plateaus_of(case)
    ramp = float(case.loop.reference.ramp)
    ends = [p.time_s - ramp for p in plateaus[1:]] + [case.clock.duration]
    rows = [round(end / here.clock.dt) - 1 for end in ends]
    outputs = list(case.loop.plant.outputs)

    def one(values):
        run = jaxtank.simulate(with_values(here.loop, values), here.clock)
        return jnp.stack([run.x[row] for row in rows])[:, jnp.array(outputs)]

    levels = np.asarray(jax.jit(jax.vmap(one))(values))
    found = np.linalg.norm(levels - np.array([p.values for p in plateaus]), axis=2)
    cannot = least > 1e-6
    for k, plateau in enumerate(plateaus):
        few = cannot[:, k]
        if few.sum() > OFFSETS // 10:
            text = ", ".join(f"{v:g}" for v in plateau.values)
            print(
                f"    setpoints {text}: {int(few.sum())} of {OFFSETS} plants cannot hold them and"
                f" stay {found[few, k].mean():.3g} off, at least {least[few, k].mean():.3g}; the"
                f" others {found[~few, k].mean():.3g}"
            )


def _coarse(setting):
    kept = setting.replace(filter=setting.searched.safety)
    return kept.coarse()


def _corners(setting):
    """How many of 256 corners of the box pass a limit on a level."""
    case, rng = setting.searched, np.random.default_rng(79)
    shares = {n: getattr(d, "relative", None) for n, d in setting.distributions.items()}
    if None in shares.values():
        return 0
    scenarios = []
    for i in range(CORNERS):
        values = {}
        for name, share in shares.items():
            value = np.asarray(get_value(case.loop, name), dtype=float)
            values[name] = (value * (1 + share * rng.choice([-1, 1], value.shape))).tolist()
        scenarios.append(Scenario(f"corner {i}", values, seed=i))
    runs, past = runs_of(case.replace(reachable=False), scenarios, 80), 0
    limit = limited_levels(setting.case)
    for group in groups_of(runs):
        measures, _ = values_of(group, ["max_level", "overflow_volume"], {"x0": _starts(case)})
        past += int((np.asarray(measures["max_level"])[0] > limit + 1e-9).any(axis=1).sum())
    return past


def _starts(case):
    return np.asarray(case.loop.x0)[None]


def _again(case, result, asked):
    """The answer tuned again, and the answers of other draws of plants, on common plants."""
    again = tuning.tune(result.tuned)
    change = max(abs(p["after"] / p["before"] - 1) for p in again.parameters.values())
    print(f"    tuned again: gains change by at most {100 * change:.3g} %")
    costs = []
    for seed in (0, 1, 2):
        other = result if seed == 0 else tuning.tune(case, seed=seed)
        setting = other.answer.setting
        loop = with_values(
            setting.searched.loop, {n: p["after"] for n, p in other.parameters.items()}
        )
        here = setting.replace(searched=setting.searched.replace(loop=loop))
        here = here.replace(searched=here.coarse()) if not asked.true_step else here
        costs.append(float(np.mean(judge(here, asked.plants, 77).cost)))
    spread = 100 * (max(costs) / min(costs) - 1)
    print(f"    other draws of 32 plants: cost on common plants differs by {spread:.3g} %")


if __name__ == "__main__":
    main()
