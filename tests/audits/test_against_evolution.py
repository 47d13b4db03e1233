"""One start reaches what SciPy's differential evolution reaches: see against_evolution.py."""

import against_evolution
import pytest
from against_evolution import AGREES, PROBLEMS


@pytest.mark.slow
@pytest.mark.parametrize("name", ["water tank", "tanks in series"])
def test_one_start_of_a_quick_problem_ends_at_the_optimum(name):
    case = PROBLEMS[name]()
    least, _ = against_evolution.evolved(case, seeds=1, generations=80)
    result = against_evolution.tuned(case, seed=7)
    assert result.success and all(c.margin >= 0 for c in result.constraints)
    assert result.objective["after"] == pytest.approx(least, rel=AGREES)


@pytest.mark.slow
def test_ten_seeds_of_every_problem_end_at_the_optimum(capsys):
    assert against_evolution.main(["--seeds", "10"]) == 0
    assert capsys.readouterr().out.count("10 of 10") >= len(PROBLEMS)
