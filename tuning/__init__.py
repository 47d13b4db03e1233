"""What one does with a loop: tune its gains through the simulation, under limits.

import tuning
from jaxtank import presets

result = tuning.tune(presets.load("gouta2015").cases["backstepping"])
print(result)
result.save("tuned")
"""

import importlib

_NAMES = {
    "Adam": "tuning.search.options",
    "Bound": "tuning.problem.bounds",
    "LBFGS": "tuning.search.options",
    "SQP": "tuning.search.options",
    "TRF": "tuning.search.options",
    "Problem": "tuning.problem.problem",
    "ParameterChange": "tuning.search.result",
    "Status": "tuning.problem.status",
    "TuningResult": "tuning.search.result",
    "Certificate": "tuning.search.robust",
    "Correlated": "tuning.uncertainty.distributions",
    "Discrete": "tuning.uncertainty.distributions",
    "Ensemble": "tuning.uncertainty.study",
    "Estimation": "tuning.identification.problem",
    "Identification": "tuning.identification.fit",
    "Log": "tuning.identification.experiment",
    "LogUniform": "tuning.uncertainty.distributions",
    "Normal": "tuning.uncertainty.distributions",
    "Uniform": "tuning.uncertainty.distributions",
    "bound": "tuning.optimal_input.perfect_information",
    "compare_experiments": "tuning.identification.design",
    "ensemble": "tuning.uncertainty.study",
    "Identifications": "tuning.identification.batch",
    "identify": "tuning.identification.fit",
    "identify_many": "tuning.identification.batch",
    "log": "tuning.identification.experiment",
    "read_log": "tuning.identification.csv_log",
    "tune_robust": "tuning.search.robust",
    "sensitivity": "tuning.uncertainty.sensitivity_study",
    "tradeoff": "tuning.search.pareto",
    "tune": "tuning.search.tuner",
}

__all__ = list(_NAMES)


def __getattr__(name):
    if name in _NAMES:
        return getattr(importlib.import_module(_NAMES[name]), name)
    raise AttributeError(f"module 'tuning' has no attribute {name!r}")


def __dir__():
    return sorted([*globals(), *__all__])
