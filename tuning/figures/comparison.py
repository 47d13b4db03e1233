"""`tuning.compare`: published beside measured numbers; `tuning.redraw`: a figure by our runs."""

import warnings
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from jaxtank import presets
from jaxtank.core.errors import unknown
from jaxtank.core.text import html_table
from tuning.figures import drawing
from tuning.figures.figure import find
from tuning.report import papers, tables
from tuning.views import Shown

COLOURS = {  # colour of each verdict in a notebook
    papers.REPRODUCED: "#0072B2",
    papers.FITTED: "#9A6A00",
    papers.DIFFERS: "#B8431A",
    papers.IMPOSSIBLE: "#6B6B6B",
    papers.INPUT: "#6B6B6B",
}


class Comparison(Shown):
    """Published and measured numbers of some papers; made by `tuning.compare`.

    A notebook shows how many rows of each paper have which verdict, and all rows folded below.

    Attributes
    ----------
    pages : dict
        {paper: page}, as `jaxtank compare PAPER --json` has it: {"citation", "notes", "headline",
        "ramps", "rows"}.
    notes : tuple of str
        Warnings of the runs.
    """

    def __init__(self, pages: dict[str, dict[str, Any]], notes: tuple[str, ...] = ()):
        self.pages, self.notes = pages, notes

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Every row, with its paper; keys as `jaxtank compare PAPER --json` has them."""
        return [{"paper": name} | row for name, page in self.pages.items() for row in page["rows"]]

    def count(self, verdict: str | None = None) -> int:
        """Return how many rows have a verdict, or how many rows there are.

        Raises InputError for a word that is no verdict.
        """
        if verdict is not None and verdict not in papers.VERDICTS:
            raise unknown("verdict", verdict, papers.VERDICTS)
        return sum(verdict in (None, row["verdict"]) for row in self.rows)

    def row(self, quantity: str) -> dict[str, Any]:
        """Return the row of a quantity, the first of that name; InputError for an unknown one."""
        for row in self.rows:
            if row["quantity"] == quantity:
                return row
        raise unknown("quantity", quantity, [row["quantity"] for row in self.rows])

    def to_json(self) -> dict[str, Any]:
        """Return {paper: page}, as `jaxtank compare all --json` prints them."""
        return {**self.pages, "verdict": papers.verdict_of(self.pages).to_json()}

    def plot(self) -> dict[str, Any]:
        """Return matplotlib figures {"published": measured over published, coloured by verdict}."""
        return papers.overview(self.pages)

    def __str__(self) -> str:
        counts = tables.table(self._counts(), ["paper", *papers.VERDICTS])
        return "\n".join([counts, str(papers.verdict_of(self.pages)), *self.notes])

    def _repr_html_(self) -> str:
        from tuning.report.html import rendered

        counts = html_table(self._counts(), ["paper", *papers.VERDICTS])
        rows = {name: list(map(_cells, page["rows"])) for name, page in self.pages.items()}
        heads = ("quantity", "unit", "published", "measured", "verdict", "where", "why")
        parts = {"verdict": papers.verdict_of(self.pages), "heads": heads, "colours": COLOURS}
        return rendered("comparison.html", counts, papers=rows, notes=self.notes, **parts)

    def _counts(self) -> list[list[Any]]:
        """Rows of paper and number of rows of each verdict, and their sums."""
        tally = {n: Counter(r["verdict"] for r in page["rows"]) for n, page in self.pages.items()}
        rows = [[n, *(counts[w] for w in papers.VERDICTS)] for n, counts in tally.items()]
        sums = ["all", *(sum(column) for column in list(zip(*rows))[1:])]
        return [*rows, sums] if len(rows) > 1 else rows


def compare(*names: str) -> Comparison:
    """Return published and measured numbers of papers, with a verdict for each.

    The runs take 3 to 20 s a paper; two papers run at a time.

    Parameters
    ----------
    names : papers, as "gouta2022"; every one where none is named.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        For a paper that is unknown.

    Examples
    --------
    >>> import jax, tuning
    >>> jax.config.update("jax_enable_x64", True)
    >>> found = tuning.compare("cascaded")
    >>> found.row("plant.rim")["verdict"], found.count("differs")
    ('input', 0)
    """
    chosen = list(dict.fromkeys(names)) or list(presets.PAPERS)
    for name in chosen:
        presets.load(name)  # which knows the nearest name
    with warnings.catch_warnings(record=True) as noted, ThreadPoolExecutor(2) as pool:
        warnings.simplefilter("always")
        pages = dict(zip(chosen, pool.map(papers.measure, chosen)))
    return Comparison(pages, tuple(dict.fromkeys(str(note.message) for note in noted)))


def redraw(name: str) -> Any:
    """Return a figure of a paper as a matplotlib figure of our runs, with what the paper states and
    what is seen here below it.

    Parameters
    ----------
    name : "PAPER/NUMBER", as `jaxtank figure` lists them.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        For a name that no figure has, and a figure that is no result.

    Examples
    --------
    >>> import jax, tuning
    >>> jax.config.update("jax_enable_x64", True)
    >>> figure = tuning.redraw("mirakhorli/3")
    >>> figure.axes[0].get_title()
    'memberships of input 1'
    """
    figure = find(name)
    return drawing.draw(figure, drawing.run(figure))


def _cells(row: dict[str, Any]) -> list[str]:
    numbers = [_number(row["published"]), _number(row["measured"])]
    return [row["quantity"], row["unit"], *numbers, row["verdict"], row["where"], row["reason"]]


def _number(value: Any) -> str:
    if value is None:
        return "-"
    return value if isinstance(value, str) else str(tables.numbers(value, 4))
