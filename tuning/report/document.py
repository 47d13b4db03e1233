"""A result as a Report: sections of texts, tables, figures and live pages, for any renderer."""

import dataclasses
import sys
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from jaxtank.core.text import one_line
from tuning.report.advice import Advice
from tuning.report.tables import Table, columns
from tuning.report.verdict import Verdict

BOLD, GOOD, BAD, END = "\033[1m", "\033[1;32m", "\033[1;31m", "\033[0m"  # headings, verdicts


@dataclasses.dataclass(frozen=True)
class Text:
    """Sentences, each a paragraph or an item of a list; `on`: "terminal" or "page" alone."""

    sentences: Sequence[str]
    items: bool = False
    gap: bool = False  # after an empty line on a terminal
    heading: str = ""
    on: str = ""
    layout: bool = False  # columns of characters, as of equations
    top: bool = False  # above the parts of a page that are folded

    def lines(self):
        """Return the lines of the sentences, wrapped unless they are a layout."""
        first, rest = ("- ", "  ") if self.items else ("", "")
        if self.layout:
            return [first + sentence for sentence in self.sentences]
        wrapper = textwrap.TextWrapper(columns(), first, rest, break_on_hyphens=False)
        wrapper.break_long_words = False
        return [line for s in self.sentences for line in wrapper.wrap(s) or [""]]


@dataclasses.dataclass(frozen=True)
class Figure:
    """A matplotlib figure with its caption."""

    name: str
    caption: str
    drawing: Any


@dataclasses.dataclass(frozen=True)
class Live:
    """The live page of a result or of a Case."""

    result: Any


@dataclasses.dataclass(frozen=True)
class Report:
    """A result as data for printing and display; the verdict is None where no run is judged."""

    name: str  # of the case, paper or file
    what: str  # that was done with it
    verdict: Verdict | None
    facts: Sequence[tuple[str, Any]]
    sections: Sequence[Text | Table | Figure | Live]
    subtitle: str = ""
    files: Mapping[str, str] = dataclasses.field(default_factory=dict)  # {heading: text}
    advice: Advice | None = None

    @property
    def title(self) -> str:
        return ": ".join(filter(None, [self.name, self.what]))

    @property
    def sections_with_verdict(self) -> Sequence[Text | Table | Figure | Live]:
        """The sections, the first one with name and verdict."""
        first = [Text([f"{self.name}: {self.verdict}"])] if self.verdict else []
        return [*first, *self.sections]


def terminal(report: Report, colour: bool = False, advice: bool = False) -> str:
    """Return the text of a Report for a terminal; advice: with its three sentences."""
    painted = lambda line, code: f"{code}{line}{END}" if colour else line
    lines: list[str] = []
    if report.verdict:
        words, code = f"{report.name}: {report.verdict}", GOOD if report.verdict.good else BAD
        lines += (painted(line, code) for line in Text([words]).lines())
    if advice and report.advice:
        lines += Text(report.advice, items=True).lines()
    for section in report.sections:
        if isinstance(section, (Figure, Live)) or section.on == "page":
            continue
        if (section.gap or section.heading) and lines:
            lines.append("")
        if section.heading:
            lines += (painted(line, BOLD) for line in Text([section.heading]).lines())
            lines.append("=" * min(columns(), len(section.heading)))
        lines += section.lines()
    return "\n".join(lines)


def failed(name: str, error: Exception, *drawings: Any) -> None:
    """Report on stderr that the picture `name` could not be drawn, and close its figures."""
    import matplotlib.pyplot as plt

    for drawing in drawings:
        plt.close(drawing)
    why = f"{type(error).__name__}: {one_line(error, 200)}"
    print(f"jaxtank: note: {name} could not be drawn ({why})", file=sys.stderr)
