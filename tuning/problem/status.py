"""How a search ended, as `tune` and `identify` report it."""

import enum


class Status(enum.StrEnum):
    """How a search ended. A text too: `Status.CONVERGED == "converged"`.

    >>> print(Status("not_converged").name, Status.NOT_CONVERGED)
    NOT_CONVERGED not_converged
    """

    CONVERGED = "converged"  # a search came to its end, and every limit holds
    NOT_CONVERGED = "not_converged"
    """No search came to its end, or the conditions of an optimum do not hold."""
    INFEASIBLE = "infeasible"  # the least violation of the limits was found, and it is not zero
    NOT_IDENTIFIABLE = "not_identifiable"  # the data do not determine every parameter (`identify`)
    INTERRUPTED = "interrupted"  # ctrl-C ended the search; the result is the best point so far
