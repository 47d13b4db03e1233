"""The live page of a result inside its report; imported by the reports."""

from jaxtank.core.errors import InputError
from tuning.report.figures import failed


def panel(result):
    """Return an element with the live page of a result or of a Case, for a report."""
    # "" for a case that cannot be run in a browser, with a note on stderr where that is not known.
    from tuning.live import shown  # only where a page is written

    try:
        make = shown.of_result if hasattr(result, "case") else shown.of_case
        return shown.frame(make(result))
    except InputError:
        return ""
    except Exception as error:
        failed("the live page", error)
        return ""
