"""report.html: well-formed, self-contained, escaped, the same for the same result; opened in a
browser where there is one.
"""

import contextlib
import functools
import json
import re
import shutil
import textwrap
import xml.etree.ElementTree
from html.parser import HTMLParser

import matplotlib.pyplot as plt
import numpy as np
import pytest
from helpers import ONE_TANK, faulty_pictures, no_live_page

import tuning
from jaxtank import rig
from jaxtank.plots import responses, run as pictures
from tuning.cli import main
from tuning.identification.csv_log import read_log
from tuning.report import html, papers, tables
from tuning.report.document import Report, Text, terminal
from tuning.report.tables import Table, Value

NASTY = "a <b>\"rig\"</b> & $\\x{$ 'y' </style><script>alert(1)</script>"
TUNED = "responses rig margins inner saturation clouds convergence landscape"
PICTURES = {
    "tune": TUNED.split(),
    "tune-one": [name for name in TUNED.split() if name != "inner"],
    "compare": ["published", "rig-calofir"],
    "uncertainty": ["fan", "violations", "rig"],
    "sensitivity": ["tornado"],
    "identify": ["fit", "residuals", "rig"],
}
QUICK = ("tune-one", "compare")
KINDS = [k if k in QUICK else pytest.param(k, marks=pytest.mark.slow) for k in PICTURES]
VOID = {"meta", "br", "img", "link", "hr", "input"}


class Reader(HTMLParser):
    """Reads a page and fails where a tag is not closed in its turn."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.ids, self.text = [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_startendtag(self, tag, attrs):
        self.note(tag, attrs)

    def handle_starttag(self, tag, attrs):
        self.note(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def note(self, tag, attrs):
        names = [n for n, _ in attrs]
        assert len(names) == len(set(names)), f"{tag} says {names}"
        self.tags.append((tag, dict(attrs)))
        self.ids += [v for n, v in attrs if n == "id"]

    def handle_endtag(self, tag):
        assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data):
        self.text.append(data)

    @property
    def words(self):
        return " ".join("".join(self.text).split())


def row(**more):
    """One row of a comparison."""
    cells = {"quantity": NASTY, "unit": "cm", "where": "<sec>", "published": 1.0, "measured": 2.0}
    return cells | {"verdict": "differs", "reason": NASTY, "kind": "number"} | more


def page_of(*rows):
    return {"calofir": {"paper": "calofir", "citation": NASTY, "rows": rows}}


@pytest.fixture(scope="module")
def saves(gouta, tmp_path_factory):
    """Function of a kind that returns what saves a result of it to a folder."""
    short = {"clock.duration": 60, "clock.dt": 0.2}
    case = gouta("backstepping", short).replace(name=NASTY)

    def identified():
        t = np.arange(0.0, 60.0, 2.0)
        rows = [f"{a:g},3,3,{h:.3f},{h:.3f}" for a, h in zip(t, 5.0 + 2.0 * np.sin(t / 10.0))]
        path = tmp_path_factory.mktemp("logs") / 'log <i>&"$_^{$".csv'
        heads = "t [s],pump1 [V],pump2 [V],h1 [cm],h2 [cm]\n"
        path.write_text(heads + "\n".join(rows) + "\n")
        log, free = read_log(path, case.loop, {}, "."), {"plant.pump_gain[0]": (1.0, 20.0)}
        return tuning.identify(case, [log], free, start="measured", starts=1, iterations=3)

    limits = {"max_level": 30.0}
    search = tuning.Options(starts=1, screening=2, iterations=3, validation=4)
    area = {"plant.drain[0]": tuning.Uniform(relative=0.05)}
    one = rig.loads(ONE_TANK).replace(name=NASTY)
    makers = {
        "tune": lambda: tuning.tune(case, search, limits=limits),
        "tune-one": lambda: tuning.tune(one, search, nominal=True),
        "uncertainty": lambda: tuning.ensemble(case, samples=4, limits={"max_level": 9.0}),
        "sensitivity": lambda: tuning.sensitivity(case, area, measures=["rms_error_total"]),
        "identify": identified,
    }
    pages = page_of(row(), row(verdict="reproduced"))
    compared = lambda *a: papers.save(pages, *a)
    return functools.cache(lambda kind: compared if kind == "compare" else makers[kind]().save)


@pytest.fixture(scope="module")
def folder_of(saves, tmp_path_factory):
    """Function of a kind that returns the folder with its result."""
    return functools.cache(lambda kind: saved(saves, kind, tmp_path_factory.mktemp(kind)))


def saved(saves, kind, path):
    """The folder `path` with the result of a kind."""
    with no_live_page() if kind == "tune-one" else contextlib.nullcontext():
        saves(kind)(path, f"jaxtank {kind} {NASTY}")
    plt.close("all")
    return path


# the live page, which has no access to the report and a policy of its own (tests/unit/live)
LIVE = re.compile(
    r'<iframe class="live" title="[^"<]*" style="width: 100%" height="900"'
    r' sandbox="allow-scripts allow-downloads" allow="clipboard-write" loading="lazy"'
    r' srcdoc="[^"<]*default-src \'none\'[^"<]*">'
)


@pytest.mark.slow_for("tune-one", "compare")
@pytest.mark.parametrize("kind", KINDS)
def test_a_page_is_well_formed_and_asks_nothing_of_the_network(folder_of, kind):
    whole = (folder_of(kind) / "report.html").read_text(encoding="utf-8")
    text, frames = LIVE.subn("<iframe>", whole)
    assert frames == whole.count("<iframe") == (kind in ("tune", "uncertainty", "compare"))
    parts = [text.index(part) for part in ('class="status', 'class="advice"', "<figure")]
    if kind not in ("compare", "sensitivity"):  # whose tables are long
        parts.append(text.index("<table"))
    folded = text.index("<details")
    assert parts == sorted(parts) and parts[-1] < folded < text.find("<iframe>") % len(text)
    read = Reader(text)
    assert len(read.ids) == len(set(read.ids))
    for tag, attrs in read.tags:
        assert tag not in ("script", "link", "object"), tag
        for name in ("src", "href"):
            assert attrs.get(name, "#").startswith(("#", "data:image/png;base64,")), tag
        assert not any(n.startswith("on") for n in attrs)
    pointed = set(re.findall(r'(?:href="#|url\(#)([^")]+)', text))
    assert pointed and pointed <= set(read.ids)
    assert "http" not in text and "@import" not in text and "@font-face" not in text
    assert len(text) < 2_000_000
    assert '<meta name="viewport"' in text and "@media print" in text and "max-width" in text


@pytest.mark.extended_for("compare")
@pytest.mark.parametrize("kind", KINDS)
def test_pictures_have_captions_and_names_of_users_are_no_markup(folder_of, kind):
    text = (folder_of(kind) / "report.html").read_text(encoding="utf-8")
    figures = re.findall(r'<figure id="([^"]+)".*?</figure>', text, flags=re.DOTALL)
    assert figures == PICTURES[kind]
    assert {f"{name}.png" for name in figures} == {p.name for p in folder_of(kind).glob("*.png")}
    assert text.count("<svg ") == text.count('role="img"') == len(figures)
    assert all(caption.strip() for caption in re.findall(r"<figcaption>(.*?)</figcaption>", text))
    assert [p.name for p in folder_of(kind).iterdir() if p.name.startswith(".")] == []
    read = Reader(text)
    assert f"jaxtank {kind} {NASTY}" in read.words  # the command
    assert not any(tag in ("b", "i", "sec") for tag, _ in read.tags)
    if kind == "identify":  # in a picture, and not set as mathematics
        assert 'log <i>&"$_^{$".csv, measured and simulated' in read.words
    else:
        assert read.words.count("alert(1)") > 2


@pytest.mark.slow_for("tune", "tune-one", "uncertainty", "sensitivity", "identify")
@pytest.mark.parametrize("kind", PICTURES)
def test_a_picture_that_fails_costs_itself_and_not_the_answer(
    saves, folder_of, kind, tmp_path, monkeypatch, capsys
):
    """A text that matplotlib cannot set, in one picture; then a function that cannot draw. Nothing
    of an earlier result stays.
    """
    plot, name = (responses, "panels") if kind == "sensitivity" else (pictures, "rig")
    usual, whole = getattr(plot, name), {path.name for path in folder_of(kind).iterdir()}
    shutil.copytree(folder_of(kind), tmp_path, dirs_exist_ok=True)

    unset, undrawn = faulty_pictures(usual)
    for fault in (unset, undrawn):
        monkeypatch.setattr(plot, name, fault)
        written = saves(kind)(tmp_path, "")
        (note,) = capsys.readouterr().err.splitlines()
        assert note.startswith("jaxtank: note: ") and "could not be drawn" in note
        left = {path.name for path in tmp_path.iterdir()}
        assert left == {path.name for path in written}
        assert {"result.json", "report.html"} <= left < whole
        assert len(whole - left) == 1 or fault is undrawn
        assert all(n.endswith(".png") for n in whole - left)
        assert json.loads((tmp_path / "result.json").read_text())
        assert not plt.get_fignums()


@pytest.mark.slow
def test_results_are_on_the_disk_before_any_picture_is_drawn(
    saves, folder_of, tmp_path, monkeypatch
):
    """A program that ends while it draws, as by a second Ctrl-C, leaves the answer."""

    class Ended(BaseException):
        pass

    def end(*_):
        raise Ended

    whole = folder_of("tune")
    monkeypatch.setattr(responses, "responses", end)
    with pytest.raises(Ended):
        saves("tune")(tmp_path)
    files = {"result.json", "rig.toml", "trajectory.csv", "before.csv"}
    assert {path.name for path in tmp_path.iterdir()} == files
    assert (tmp_path / "rig.toml").read_bytes() == (whole / "rig.toml").read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_the_verdict_is_one_sentence_on_page_terminal_notebook_and_in_json(saves, folder_of, kind):
    read = Reader((folder_of(kind) / "report.html").read_text(encoding="utf-8"))
    payload = json.loads((folder_of(kind) / "result.json").read_text())
    said, advice = payload["verdict"], payload["advice"]
    assert len(advice) == 3 and all(line.endswith(".") and len(line) < 300 for line in advice)
    assert all(" ".join(line.split()) in read.words for line in advice)
    sentence = " ".join(said["sentence"].split())
    (status,) = [a["class"] for tag, a in read.tags if a.get("class", "").startswith("status")]
    assert sentence and sentence in read.words and ("warn" in status) != said["good"]
    if kind != "compare":
        result = saves(kind).__self__
        assert result.to_json()["verdict"] == said and result.to_json()["advice"] == advice
        printed = " ".join(terminal(result.report(), advice=True).split())
        assert all(" ".join(line.split()) in printed for line in advice)
        assert not any(" ".join(line.split()) in " ".join(repr(result).split()) for line in advice)
        assert sentence in " ".join(repr(result).split())
        assert max(map(len, repr(result).splitlines())) <= 80
        assert sentence in Reader(result._repr_html_()).words


def test_the_numbers_of_a_tuning_are_on_its_page(saves, folder_of):
    read = Reader((folder_of("tune-one") / "report.html").read_text(encoding="utf-8"))
    result = saves("tune-one").__self__
    cost = tables.number(result.objective["after"])
    for text in (*result.message.split("; "), *result.parameters, cost, "seed"):
        assert " ".join(text.split()) in read.words
    assert "[controller]" in read.words or "controller" in rig.dump(result.tuned)


@pytest.mark.slow
@pytest.mark.parametrize("kind", PICTURES)
def test_the_same_result_gives_the_same_bytes(saves, folder_of, tmp_path, kind):
    again = saved(saves, kind, tmp_path)
    assert (again / "report.html").read_bytes() == (folder_of(kind) / "report.html").read_bytes()


def test_ids_of_two_equal_figures_do_not_clash():
    def drawn():
        figure, ax = plt.subplots()
        ax.plot([0, 1], [0, 1], "o-")
        return figure

    texts = [html.svg(drawn(), name) for name in ("first", "second")]
    plt.close("all")
    ids = [set(re.findall(r' id="([^"]+)"', text)) for text in texts]
    assert all(ids) and not ids[0] & ids[1]


def test_a_picture_of_very_many_points_is_kept_small():
    figure, ax = plt.subplots()
    angle = np.linspace(0.0, 1000.0, 200_000)
    ax.plot(np.cos(angle) * np.sin(1.7 * angle), np.sin(3.1 * angle), linewidth=0.2)
    text = html.svg(figure, "dense")
    plt.close(figure)
    assert "data:image/png" in text and len(text) < html.LARGEST


def test_compare_and_show_write_to_the_folder_asked_for(tmp_path, monkeypatch, capsys):
    page = page_of(row(measured=1.0, verdict="reproduced", reason=""))["calofir"]
    page["rows"] = list(page["rows"])
    monkeypatch.setattr(papers, "measure", lambda paper: page)
    out = tmp_path / "compared"
    assert main.main(["compare", "calofir", "--out", str(out), "--quiet"]) == 0
    files = {"published.png", "report.html", "result.json", "rig-calofir.png"}
    assert {p.name for p in out.iterdir()} == files
    assert json.loads((out / "result.json").read_text())["rows"] == page["rows"]
    assert f"jaxtank compare calofir --out {out}" in (out / "report.html").read_text()
    assert main.main(["show", "mirakhorli/sfc", "--out", str(tmp_path / "two"), "--quiet"]) == 0
    # a file of its own needs its namespace
    drawn = xml.etree.ElementTree.parse(tmp_path / "two" / "rig.svg").getroot()
    assert drawn.tag == "{http://www.w3.org/2000/svg}svg"
    assert {"pump 1", "tank 3", "42 %"} <= {t.strip() for t in drawn.itertext()}
    (tmp_path / "file").write_text("")
    for asked in (["compare", "calofir"], ["show", "mirakhorli/sfc"]):
        assert main.main([*asked, "--out", str(tmp_path / "file")]) == 2
    assert capsys.readouterr().err.count("is a file") == 2


def rendered(*sections):
    return html.document(Report("t", "", None, [], sections))


def test_sections_become_tables_lists_and_paragraphs():
    table = Table([["x<1", Value(2)], ["y", "-"]], ["name", "value"])
    columns = Text(["one   two"], layout=True)
    words = "limits hold on 256 of 256 plants of the rig with two tanks, proved for the first tank"
    notes = Text(["first", "second"], items=True)
    sections = [Text([words, "other"]), notes, table, columns, Text(["never"], on="terminal")]
    read = Reader(rendered(*sections))
    tags = [tag for tag, _ in read.tags]
    counts = {"li": 2, "ul": 1, "td": 4, "th": 2, "pre": 1}
    assert {tag: tags.count(tag) for tag in counts} == counts
    assert ("td", {"class": "number"}) in read.tags and "never" not in read.words
    assert "x<1" in read.words and f"<p>{words}</p>" in html.fragment(sections)
    text = terminal(Report("t", "", None, [], sections)).splitlines()
    assert text[:6] == [*textwrap.wrap(words, 80), "other", "- first", "- second", "name  value"]


def test_cells_of_a_table_of_texts_carry_their_headings():
    """A narrow window shows them one below the other."""
    read = rendered(Table([["x", 2, "w" * 80], ["y", 3, ""]], ["name", "value", 'why "so"']))
    assert '<div class="scroll texts" tabindex="0">' in read and read.count('data-head="name"') == 2
    assert 'data-head="why &#34;so&#34;"' in read
    plain = rendered(Table([["x", 2]], ["name", "value"]))
    assert "data-head=" not in plain and '<div class="scroll" tabindex="0">' in plain


# whether each picture fits a narrow window, and scrolls in its box once it is tapped
PROBE = """[...document.querySelectorAll('figure > div')].map(box => {
    const svg = box.querySelector('svg'), column = document.querySelector('main');
    const right = e => e.getBoundingClientRect().right;
    const fits = right(svg) <= right(column) + 0.5 && svg.clientWidth > 300;
    box.tabIndex = 0;
    box.focus();
    const wide = box.parentElement.className === 'wide';
    return fits && (box.scrollWidth > box.clientWidth + 100) === wide;
})"""


@pytest.mark.extended_for("tune-one")
@pytest.mark.parametrize("kind", KINDS)
def test_a_browser_opens_the_page_without_complaint_and_pictures_fit_a_phone(
    browser, folder_of, kind
):
    page, complaints = browser.new_page(viewport={"width": 390, "height": 900}), []
    page.on("console", lambda m: complaints.append(m.text))
    page.on("pageerror", lambda e: complaints.append(str(e)))
    page.goto((folder_of(kind) / "report.html").as_uri())
    unfolded = """[...document.querySelectorAll('details:not(.screen) :is(table, svg, pre)')]
        .every((e) => e.checkVisibility())"""
    assert not page.evaluate(unfolded)
    page.emulate_media(media="print")  # what is folded is on paper, but for the live page
    assert page.evaluate(unfolded) and not page.is_visible("details.screen")
    page.emulate_media(media="screen")
    page.evaluate("document.querySelectorAll('details').forEach((one) => (one.open = true))")
    assert page.evaluate(PROBE) == [True] * len(PICTURES[kind])
    assert complaints == []
    page.close()


def test_a_table_of_limits_with_long_names_fits_a_phone(browser, tmp_path):
    name = "steady-state error of intermediate_storage_LT102"
    limits = [[name, "<= 0.5 cm", "0.1153 cm", "0.385 cm", "59.5 s"]]
    heads, levels = ["limit", "", "value", "margin", "at"], [[31.4, 33.09, 16.15, 14.1]] * 2
    measures = [["max_level", "cm", *(Value(each) for each in levels)]]
    tables = [Table(limits, heads), Table(measures, ["measure", "unit", "before", "after"])]
    (tmp_path / "report.html").write_text(rendered(*tables), encoding="utf-8")
    page = browser.new_page(viewport={"width": 390, "height": 900})
    page.goto((tmp_path / "report.html").as_uri())
    page.evaluate("document.querySelectorAll('details').forEach((one) => (one.open = true))")
    widths = "[...document.querySelectorAll('.scroll')].map((e) => [e.scrollWidth, e.clientWidth])"
    assert all(0 < whole <= seen for whole, seen in page.evaluate(widths))
    page.close()


@pytest.mark.slow
def test_no_column_of_a_page_of_claims_is_cut(browser, tmp_path):
    """A box of the page is as wide as what it holds: nothing has to be pushed aside to be read."""
    words = (
        "the ideal rig starts faster, without delay, lag or noise, and its pumps are stronger than"
        " those of the paper"
    )
    texts = {"quantity": "RMS error of CHADPC against ENMPC, paper-like rig", "kind": "claim"}
    texts |= {"unit": "cm^3/(s V)", "where": "sec. 5.1, 5.3, Table 2", "reason": words}
    many = [tuple(start + k for k in range(16)) for start in (0.123456, 0.654321)]
    claim = row(**texts, published=words, measured=words)
    numbers = row(**texts, published=many[0], measured=many[1])
    printed = terminal(papers.report(page_of(claim, numbers)), advice=True)
    assert max(map(len, printed.splitlines())) <= 80
    papers.save(page_of(claim, numbers), tmp_path)
    for width in (1400, 900, 390):
        page = browser.new_page(viewport={"width": width, "height": 1000})
        page.goto((tmp_path / "report.html").as_uri())
        cut = """Math.max(...[...document.querySelectorAll('.scroll, main')].map(
            e => e.scrollWidth - e.clientWidth))"""
        assert page.evaluate(cut) == 0, width
        page.close()


def test_no_line_breaks_within_an_option_and_what_a_name_says_is_escaped():
    text = str(html.unbroken("--mend <b> helps; not a--b or 5 -> 3"))
    assert text.startswith('<span class="option">--mend</span> &lt;b&gt; helps')
