"""What one does with a loop: tune its gains through the simulation, under limits.

import tuning
from jaxtank import presets

result = tuning.tune(presets.load("gouta2015").cases["backstepping"])
print(result)
result.save("tuned")
"""

import importlib

# A type checker reads these imports in place of `__getattr__`; at run time none is made here.
TYPE_CHECKING = False  # for a checker it is True; `typing` would slow down --help
if TYPE_CHECKING:
    from tuning.falsification.result import Attack as Attack
    from tuning.falsification.study import attack as attack
    from tuning.feasible.result import Feasibility as Feasibility
    from tuning.feasible.result import Mend as Mend
    from tuning.feasible.study import apply_mend as apply_mend
    from tuning.feasible.study import can_follow as can_follow
    from tuning.feasible.study import feasibility as feasibility
    from tuning.feasible.study import least_offset as least_offset
    from tuning.figures.comparison import Comparison as Comparison
    from tuning.figures.comparison import compare as compare
    from tuning.figures.comparison import redraw as redraw
    from tuning.identification.batch import identify_many as identify_many
    from tuning.identification.csv_log import read_log as read_log
    from tuning.identification.design import compare_experiments as compare_experiments
    from tuning.identification.experiment import Log as Log
    from tuning.identification.experiment import log as log
    from tuning.identification.fit import identify as identify
    from tuning.identification.problem import Estimation as Estimation
    from tuning.identification.result import Identification as Identification
    from tuning.identification.result import Identifications as Identifications
    from tuning.optimal_input.perfect_information import bound as bound
    from tuning.problem.bounds import Bound as Bound
    from tuning.problem.functions import Constraint as Constraint
    from tuning.problem.functions import Objective as Objective
    from tuning.problem.problem import Problem as Problem
    from tuning.problem.status import Status as Status
    from tuning.search.judged import Answer as Answer
    from tuning.search.judged import Judged as Judged
    from tuning.search.judged import validate as validate
    from tuning.search.options import LBFGS as LBFGS
    from tuning.search.options import SQP as SQP
    from tuning.search.options import TRF as TRF
    from tuning.search.options import Adam as Adam
    from tuning.search.pareto import tradeoff as tradeoff
    from tuning.search.result import ConstraintRow as ConstraintRow
    from tuning.search.result import Message as Message
    from tuning.search.result import ParameterChange as ParameterChange
    from tuning.search.result import TuningResult as TuningResult
    from tuning.search.robust import Certificate as Certificate
    from tuning.search.robust import tune_robust as tune_robust
    from tuning.search.tuner import tune as tune
    from tuning.uncertainty.distributions import Correlated as Correlated
    from tuning.uncertainty.distributions import Discrete as Discrete
    from tuning.uncertainty.distributions import LogUniform as LogUniform
    from tuning.uncertainty.distributions import Normal as Normal
    from tuning.uncertainty.distributions import Uniform as Uniform
    from tuning.uncertainty.result import Ensemble as Ensemble
    from tuning.uncertainty.sensitivity_study import sensitivity as sensitivity
    from tuning.uncertainty.study import ensemble as ensemble

_NAMES = {
    "Adam": "tuning.search.options",
    "Attack": "tuning.falsification.result",
    "Bound": "tuning.problem.bounds",
    "LBFGS": "tuning.search.options",
    "SQP": "tuning.search.options",
    "TRF": "tuning.search.options",
    "Constraint": "tuning.problem.functions",
    "Objective": "tuning.problem.functions",
    "Problem": "tuning.problem.problem",
    "ConstraintRow": "tuning.search.result",
    "Message": "tuning.search.result",
    "ParameterChange": "tuning.search.result",
    "Status": "tuning.problem.status",
    "TuningResult": "tuning.search.result",
    "Certificate": "tuning.search.robust",
    "Feasibility": "tuning.feasible.result",
    "Mend": "tuning.feasible.result",
    "apply_mend": "tuning.feasible.study",
    "can_follow": "tuning.feasible.study",
    "feasibility": "tuning.feasible.study",
    "least_offset": "tuning.feasible.study",
    "Correlated": "tuning.uncertainty.distributions",
    "Discrete": "tuning.uncertainty.distributions",
    "Ensemble": "tuning.uncertainty.result",
    "Estimation": "tuning.identification.problem",
    "Identification": "tuning.identification.result",
    "Log": "tuning.identification.experiment",
    "LogUniform": "tuning.uncertainty.distributions",
    "Normal": "tuning.uncertainty.distributions",
    "Uniform": "tuning.uncertainty.distributions",
    "attack": "tuning.falsification.study",
    "bound": "tuning.optimal_input.perfect_information",
    "compare_experiments": "tuning.identification.design",
    "ensemble": "tuning.uncertainty.study",
    "Comparison": "tuning.figures.comparison",
    "compare": "tuning.figures.comparison",
    "redraw": "tuning.figures.comparison",
    "Identifications": "tuning.identification.result",
    "identify": "tuning.identification.fit",
    "identify_many": "tuning.identification.batch",
    "log": "tuning.identification.experiment",
    "read_log": "tuning.identification.csv_log",
    "tune_robust": "tuning.search.robust",
    "sensitivity": "tuning.uncertainty.sensitivity_study",
    "tradeoff": "tuning.search.pareto",
    "Answer": "tuning.search.judged",
    "Judged": "tuning.search.judged",
    "validate": "tuning.search.judged",
    "tune": "tuning.search.tuner",
}

__all__ = list(_NAMES)  # pyright: ignore[reportUnsupportedDunderAll]  the names of the table


if not TYPE_CHECKING:  # a checker would take any name for one that is here

    def __getattr__(name):
        if name in _NAMES:
            return getattr(importlib.import_module(_NAMES[name]), name)
        raise AttributeError(f"module 'tuning' has no attribute {name!r}")


def __dir__():
    return sorted([*globals(), *__all__])
