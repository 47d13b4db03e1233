"""The results of `identify` (estimates with intervals, the identified case) and `identify_many`."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import chi2

from jaxtank.case import Case
from jaxtank.core.labels import reading_label
from jaxtank.core.text import html_table
from jaxtank.core.tree import get_value
from tuning.identification.diagnosis import Diagnosis, diagnose
from tuning.identification.identified_case import proposed
from tuning.identification.least_squares import Fit
from tuning.identification.problem import Estimation
from tuning.identification.residuals import at_samples, is_white
from tuning.problem.status import Status
from tuning.views import Result


class Experiments(dict[str, dict[str, Any]]):
    """Result of `tuning.compare_experiments`: {description: {"sd", "condition", "open"}}."""

    case: Case
    inputs: list[dict[str, Any]]

    def __init__(
        self,
        case: Case,
        experiments: dict[str, dict[str, Any]],
        inputs: Sequence[dict[str, Any]] = (),
    ):
        super().__init__(experiments)
        self.case, self.inputs = case, list(inputs)

    def _repr_html_(self) -> str:
        """A row for each experiment: standard deviations in per cent of the values."""
        names = list(next(iter(self.values()))["sd"]) if self else []
        size = {n: abs(float(np.asarray(get_value(self.case.loop, n)))) for n in names}

        def cell(name: str, sd: float | None) -> str:
            if sd is None:
                return "not identifiable"
            if not size[name]:
                return f"{sd:.2g}"
            percent = 100 * sd / size[name]
            return f"{percent:.2g} %" if percent < 100 else f"{percent:.0f} %"

        rows = [[name, *(cell(*sd) for sd in row["sd"].items())] for name, row in self.items()]
        caption = f"{self.case.name}: standard deviations that each experiment would leave"
        return html_table(rows, ["experiment", *names], caption)


def channels_of(estimation: Estimation) -> list[tuple[str, str]]:
    """Return (name, unit) of every channel of readings."""
    loop = estimation.case.loop
    unit = lambda volts: "V" if volts else loop.units[0]
    return [(reading_label(loop.plant, t), unit(volts)) for t, volts in estimation.data.channels]


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class Identification(Result):
    """Result of `tuning.identify`; `print(result)` for a table.

    Attributes
    ----------
    case : Case
        The case that was given.
    estimation : Estimation
        Unknowns, experiment data and residual.
    fit : Fit
        Where the best search ended.
    status : Status
        CONVERGED, NOT_CONVERGED, NOT_IDENTIFIABLE or INTERRUPTED.
    parameters : dict
        {name: {"before", "value", "unit", "lower", "upper", "sd", "interval95", "identifiable",
        "at_bound"}}.
    levels : list
        Of each log, of each tank {"value", "interval95"}: levels at the first sample.
    covariance : tuple
        (names, (n, n)) of the parameters that have an interval, in their units.
    quality : dict
        {"rmse", "nrmse_percent", "residual_autocorrelation", "noise"} per channel, and "widened",
        the factor by which correlated residuals widen the intervals.
    directions : list
        What is not identifiable: {"words", "parameters" {name: factor}, "sd"}.
    oddities : list
        What is odd in the data: (kind, log, where, count, first, value), kind one of "frozen",
        "saturated", "spike", "held", "still", "off".
    remedies : list of str
        Which experiments would identify it.
    starts : list
        Of each search {"cost", "evaluations", "agrees"}.
    validation : dict or None
        Prediction of the end of the data from a fit to their beginning.
    profile : dict or None
        Profile likelihood of the least certain parameter.
    wall_s : float
        Run time [s].
    seed : int
        Of the starts.
    law : str or None
        Kind of controller that is proposed for the identified rig.
    accepted : tuple of str
        Causes that were put into the rig.
    likelihood : dict
        {"kind", "asked", "reason", "bic", "process_noise"}: "output-error" or "innovations", why,
        and the standard deviation that the process noise adds to each level per root of a second.
    simulated : Fit
        That to simulated readings, of which the `diagnosis` is.
    refinements : list
        Parts that were added to the rig: (kind, where, before, after), the RMS of predicted blocks
        in the noise without it and with it.
    posterior : Posterior or None
        Draws of the posterior, of which the covariance then is.
    """

    case: Any
    estimation: Estimation
    fit: Fit
    status: Status
    parameters: dict
    levels: list
    covariance: tuple
    quality: dict
    directions: list
    oddities: list
    remedies: list
    starts: list
    validation: dict | None
    profile: dict | None
    wall_s: float
    seed: int
    law: str | None = None
    accepted: tuple = ()
    likelihood: dict[str, Any] = dataclasses.field(default_factory=dict)
    refinements: Sequence[Any] = ()
    simulated: Fit | None = None
    posterior: Any = None

    @functools.cached_property
    def structure(self) -> Diagnosis:
        """Whether the structure of the rig is right: tests of the residuals, fits that pass."""
        diagnosis = diagnose(self.estimation, self.simulated or self.fit)
        if self.likelihood.get("kind") != "innovations" or diagnosis.causes:
            return diagnosis
        # noise that drives the levels explains residuals that are not white, if innovations are
        rows = at_samples(self.estimation, self.fit.residual)
        white = all(is_white(channel) for channel in np.moveaxis(rows, -1, 0))
        return diagnosis._replace(clean=white, white=white)

    @property
    def diagnosis(self) -> dict[str, Any]:
        """{"clean", "causes": [{"kind", "where", "value", "unit", "interval95", "delta_bic",
        "equivalent"}], "sentence"} of `structure`, places counted from 1.
        """
        return self._report().diagnosis_of(self)

    @functools.cached_property
    def proposed(self) -> tuple[Case, str | None]:
        """(identified case, why no controller of kind `law` could be proposed, or None)."""
        return proposed(self)

    @property
    def identified(self) -> Case:
        """The case with the estimates, also in models, their covariance and the noise."""
        return self.proposed[0]

    @property
    def prior(self) -> dict[str, Any] | None:
        """Parameters with a prior, and the probability that these data alone differ from it as
        much as they do: {"names", "probability"}; None without a prior.
        """
        est = self.estimation
        if est.prior is None:
            return None
        names, mean, root = est.prior
        alone, coordinates = est.alone, est.alone.estimation.coordinates
        at = np.array([coordinates.names.index(name) for name in names])
        known = ~alone.unidentifiable[at]  # by these data alone
        if not known.any():
            return {"names": names, "probability": 1.0}
        values = coordinates.values(alone.fit.p)
        change = (np.array([values[name] for name in names]) - mean)[known]
        spread = np.linalg.inv(root.T @ root)[np.ix_(known, known)]
        spread += alone.values_covariance[np.ix_(at[known], at[known])]
        moved = float(change @ np.linalg.solve(spread, change))
        return {"names": names, "probability": float(chi2.sf(moved, known.sum()))}

    @property
    def identifiable(self) -> bool:
        """Whether every parameter is identifiable, so that a rig file may be written."""
        return all(p["identifiable"] for p in self.parameters.values())

    @property
    def channels(self) -> list[tuple[str, str]]:
        """(name, unit) of every channel of readings."""
        return channels_of(self.estimation)

    @property
    def correlation(self) -> tuple[tuple, np.ndarray]:
        """(names, (n, n)) correlation of the estimates that have an interval."""
        names, matrix = self.covariance
        sd = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        return names, np.asarray(matrix) / np.outer(sd, sd)

    @property
    def message(self) -> str:
        """How it ended, in one line."""
        return "; ".join(self._report().sentences_of(self))


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class Identifications(Result):
    """Result of `tuning.identify_many`: arrays with one row for each log.

    `print(result)` for a table; `to_json()`, `plot()`, `save(folder)`.

    Attributes
    ----------
    case : Case
        The case that was given.
    logs : tuple of str
        Names of the logs.
    channels : tuple of (str, str)
        (name, unit) of each channel of readings.
    names, units : tuple of str
        Of the parameters.
    values, sd : (logs, parameters) array
        Estimates and standard deviations; NaN in `sd`, `interval95` and `covariance` of what is not
        identifiable or ends at its bound.
    interval95 : (logs, parameters, 2) array
        95 % intervals, for white noise.
    covariance : (logs, parameters, parameters) array
        Of the estimates.
    levels, levels_sd : (logs, tanks) array
        Levels at the first sample.
    rmse, autocorrelation : (logs, channels) array
        Of the residuals; autocorrelation at one sample.
    converged : (logs,) bool array
    iterations : int
        Of the slowest fit.
    wall_s : float
        Run time [s].
    """

    case: Case
    logs: tuple[str, ...]
    channels: tuple[tuple[str, str], ...]
    names: tuple
    units: tuple
    values: np.ndarray
    sd: np.ndarray
    interval95: np.ndarray
    covariance: np.ndarray
    levels: np.ndarray
    levels_sd: np.ndarray
    rmse: np.ndarray
    autocorrelation: np.ndarray
    converged: np.ndarray
    iterations: int
    wall_s: float

    def __len__(self):
        return len(self.values)
