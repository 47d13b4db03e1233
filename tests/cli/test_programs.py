"""Which programs a command compiles: each costs a second or two that no user asked for."""

import pytest
from helpers import command, programs_compiled


def compiled(*words):
    """How often a command compiles each program."""
    with programs_compiled() as programs:
        assert command(*words, "--json", "--quiet").code in (0, 3, 4)
    return programs


@pytest.mark.slow
def test_a_run_is_one_program():
    assert compiled("simulate", "cascaded/pi", "--dt", "8") == {"evaluate_compiled": 1}


@pytest.mark.slow
def test_an_ensemble_is_two_programs():
    """The measures of a batch, and the trajectories of the fan chart."""
    result = compiled("uncertainty", "cascaded/pi", "--dt", "8", "--samples", "8")
    assert result == {"_run": 1, "_trajectories": 1}


@pytest.mark.slow
def test_the_nominal_optimum_needs_four_large_programs():
    """Measures to report, derivatives, values of a block of points, values of validation plants. At
    10,241 samples no coarse step is used, and no Jacobian is compiled to judge it.
    """
    words = ["tune", "cascaded/pi", "--nominal", "--starts", "2", "--screening", "8"]
    result = compiled(*words, "--dt", "0.4", "--free", "controller.Kc[0]=0.5:3")
    small = {name: n for name, n in result.items() if name in ("simulate_compiled", "_followed")}
    large = {"evaluate_compiled": 1, "_slopes": 1, "_values": 2}
    assert result == large | small and all(n == 1 for n in small.values())


@pytest.mark.slow
def test_the_default_answer_needs_six_large_programs():
    """Judged and reported with and without a safety filter; derivatives and values of a block."""
    result = compiled("tune", "gouta2015/backstepping", "--dt", "0.5", "--starts", "2")
    large = {"_run": 2, "evaluate_compiled": 2, "_slopes": 1, "_values": 1}
    assert {name: n for name, n in result.items() if name in large} == large
    assert sum(result.values()) - sum(large.values()) < 12 and "_one_step_jacobians" not in result
