"""Papers compared in Python: counts, rows and the table of a notebook; figures by name."""

import json
import warnings

import pytest

import tuning
from jaxtank.core.errors import InputError
from tuning.cli import main
from tuning.report import papers


def row(quantity, verdict, **more):
    cells = {"quantity": quantity, "unit": "cm", "where": "Table 1", "published": 2.0}
    cells |= {"kind": "number", "deviation": None, "ramp_s": None, "by_ramp": {}}
    return cells | {"measured": [2.0, 2.5], "verdict": verdict, "reason": "because"} | more


@pytest.fixture
def comparison():
    first = [row("error", "reproduced"), row("<b>area</b>", "differs", reason="x < y & z")]
    second = [row("error", "differs", measured=None), row("gain", "fitted", measured="a claim")]
    pages = {"one": {"rows": first}, "two": {"rows": second}}
    return tuning.Comparison(pages, ("a <note>",))


def test_rows_are_counted_by_verdict_and_found_by_quantity(comparison):
    counts = {word: comparison.count(word) for word in papers.VERDICTS}
    assert comparison.count() == 4
    assert counts == dict.fromkeys(papers.VERDICTS, 0) | {
        "reproduced": 1,
        "fitted": 1,
        "differs": 2,
    }
    assert comparison.row("error")["paper"] == "one" and comparison.row("gain")["paper"] == "two"
    table = [line.split() for line in str(comparison).splitlines()[2:5]]
    table = [" ".join(line) for line in table]
    assert table == ["one 1 0 1 0 0", "two 0 1 1 0 0", "all 1 1 2 0 0"]
    assert set(comparison.to_json()) == {"one", "two", "verdict"}


def test_entries_that_differ_by_rounding_alone_are_one_point():
    """Their number would depend on the processor, and with it what a figure shows."""
    found = papers._ratios(row("times", "fitted", measured=[2.0, 2.0 + 4e-16, 2.0 - 3e-16, 5.0]))
    assert found.tolist() == [1.0, 2.5]


def test_a_notebook_shows_every_row_with_its_texts_escaped(comparison):
    shown = comparison._repr_html_()
    assert shown.count("<details>") == 3 and "one: 2 rows" in shown
    assert "<td>&lt;b&gt;area&lt;/b&gt;</td>" in shown and "x &lt; y &amp; z" in shown
    assert "<td>2</td><td>2  2.5</td>" in shown and "<td>-</td>" in shown
    assert "<td>a claim</td>" in shown and "a &lt;note&gt;" in shown and "<b>area" not in shown


def test_unknown_words_are_refused_with_the_nearest(comparison):
    with pytest.raises(InputError, match="reproduced"):
        comparison.count("reproduce")
    with pytest.raises(InputError, match="error"):
        comparison.row("eror")
    with pytest.raises(InputError, match="cascaded"):
        tuning.compare("cascade")
    with pytest.raises(InputError, match="gouta2022/10"):
        tuning.redraw("gouta2022/100")


def test_papers_keep_their_order_and_warnings_become_notes(monkeypatch):
    """Two papers run at a time; what they warn of is noted once and not printed."""

    def measure(paper):
        warnings.warn("a step is too long", UserWarning, stacklevel=1)
        return {"rows": [row(paper, "input")]}

    monkeypatch.setattr(papers, "measure", measure)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = tuning.compare("khalid", "cascaded", "khalid")
    assert list(found.pages) == ["khalid", "cascaded"] and found.notes == ("a step is too long",)
    assert [r["quantity"] for r in found.rows] == ["khalid", "cascaded"]


@pytest.mark.slow
def test_the_rows_of_a_paper_are_those_of_the_command():
    found = tuning.compare("cascaded")
    assert found.row("plant.rim")["measured"] == 10.0  # the rim of the public record [V]
    assert found.row("record, sampling period")["measured"] == 4.0  # s
    assert found.count("input") == 2 and found.count("reproduced") == 0
    assert str(found).splitlines()[2].split()[0] == "cascaded"


def test_the_headline_counts_numbers_and_claims_apart():
    rows = [
        *(row("a", word) for word in ("reproduced", "differs", "fitted", "input")),
        *(row("b", word, kind="claim") for word in ("reproduced", "reproduced", "differs")),
        row("c", "not reproducible", kind="claim"),
    ]
    counts = papers.headline(rows)
    assert counts["numbers"] == {"reproduced": 1, "fitted": 1, "differs": 1, "of": 3}
    assert counts["claims"] == {"reproduced": 2, "fitted": 0, "differs": 1, "of": 3}
    assert counts["input"] == counts["not reproducible"] == 1


def test_the_claims_of_a_ramp_are_the_same_for_each():
    rows = [
        row("error", "differs", kind="claim", by_ramp={"30": "reproduced", "60": "partly"}),
        row("rims", "differs", kind="claim", by_ramp={"30": "not reproduced", "60": "reproduced"}),
        row("other", "reproduced"),
    ]
    assert papers.ramps(rows) == [
        {"ramp_s": 30.0, "reproduced": 1, "of": 2, "differs": ["rims"]},
        {"ramp_s": 60.0, "reproduced": 1, "of": 2, "differs": ["error"]},
    ]
    assert papers.ramps(rows[2:]) == []


@pytest.mark.slow
def test_the_command_says_numbers_and_claims_apart(capsys, monkeypatch, tmp_path):
    """In the terminal, in JSON and on the page."""
    text = "printed numbers: 1 of 2 reproduced, 0 fitted; claims in words: 1 of 1 hold, 0 fitted"
    claim = row("rims", "reproduced", kind="claim", published="below", measured="29 cm")
    claim |= {"by_ramp": {"30": "partly", "60": "reproduced"}, "ramp_s": 60.0}
    rows = [row("a", "reproduced"), row("b", "differs"), claim]

    def measure(paper):
        whole = {"headline": papers.headline(rows), "ramps": papers.ramps(rows), "rows": rows}
        return {"paper": paper, "citation": "C", "notes": "N"} | whole

    monkeypatch.setattr(papers, "measure", measure)
    assert main.main(["compare", "calofir", "--out", str(tmp_path), "--quiet"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    for shown in (printed, page):
        assert text in shown and "with setpoint ramps of 60 s: 1 of 1 claims" in shown
        assert "with setpoint ramps of 30 s: 0 of 1 claims" in shown and "ramps of 60 s" in shown
    assert main.main(["compare", "calofir", "--json", "--quiet"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["headline"]["numbers"]["of"] == 2 and found["headline"]["claims"]["of"] == 1
    assert [one["reproduced"] for one in found["ramps"]] == [0, 1]
    assert main.main(["compare", "all", "--quiet"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "all papers: printed numbers: 8 of 16 reproduced" in printed
