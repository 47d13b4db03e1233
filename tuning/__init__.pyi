from jaxtank.bounds import Bound as Bound
from tuning.falsification.study import Attack as Attack, attack as attack
from tuning.feasible.result import Feasibility as Feasibility, Mend as Mend
from tuning.feasible.study import (
    apply_mend as apply_mend,
    can_follow as can_follow,
    feasibility as feasibility,
    least_offset as least_offset,
)
from tuning.figures.comparison import Comparison as Comparison, compare as compare, redraw as redraw
from tuning.identification.batch import identify_many as identify_many
from tuning.identification.csv_log import read_log as read_log
from tuning.identification.design import compare_experiments as compare_experiments
from tuning.identification.experiment import Log as Log, log as log
from tuning.identification.fit import identify as identify
from tuning.identification.prediction import Prediction as Prediction, predict as predict
from tuning.identification.problem import Estimation as Estimation
from tuning.identification.result import (
    Identification as Identification,
    Identifications as Identifications,
)
from tuning.optimal_input.perfect_information import bound as bound
from tuning.problem.functions import Constraint as Constraint, Objective as Objective
from tuning.problem.problem import Problem as Problem
from tuning.problem.status import Status as Status
from tuning.search.comparison import (
    ControllerComparison as ControllerComparison,
    compare_controllers as compare_controllers,
)
from tuning.search.discrete import tune_choices as tune_choices
from tuning.search.judged import Answer as Answer, Judged as Judged, validate as validate
from tuning.search.options import (
    LBFGS as LBFGS,
    SQP as SQP,
    TRF as TRF,
    Adam as Adam,
    Options as Options,
)
from tuning.search.pareto import tradeoff as tradeoff
from tuning.search.result import (
    ConstraintRow as ConstraintRow,
    Message as Message,
    ParameterChange as ParameterChange,
    TuningResult as TuningResult,
)
from tuning.search.robust import Certificate as Certificate, tune_robust as tune_robust
from tuning.search.tuner import tune as tune, tune_by_rule as tune_by_rule
from tuning.uncertainty.distributions import (
    Correlated as Correlated,
    Discrete as Discrete,
    Empirical as Empirical,
    LogUniform as LogUniform,
    Normal as Normal,
    Uniform as Uniform,
    empirical as empirical,
)
from tuning.uncertainty.sensitivity_study import sensitivity as sensitivity
from tuning.uncertainty.study import Ensemble as Ensemble, ensemble as ensemble
