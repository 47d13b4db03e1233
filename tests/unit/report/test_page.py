"""report.html: well-formed, self-contained, escaped, the same for the same result; opened in a
browser where there is one.
"""

import json
import re
import shutil
import subprocess
import textwrap
import xml.etree.ElementTree
from html.parser import HTMLParser

import matplotlib.image
import matplotlib.pyplot as plt
import numpy as np
import pytest

import tuning
from jaxtank import rig
from jaxtank.plots import responses
from jaxtank.plots import run as pictures
from tuning.cli import main
from tuning.identification.csv_log import read_log
from tuning.report import html, papers, tables
from tuning.report.document import Report, Text, terminal
from tuning.report.tables import Table, Value

NASTY = "a <b>\"rig\"</b> & $\\x{$ 'y' </style><script>alert(1)</script>"
KINDS = ("tune", "uncertainty", "sensitivity", "identify", "compare")
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


@pytest.fixture(scope="module")
def case(gouta):
    return gouta("backstepping", {"clock.duration": 60, "clock.dt": 0.2}).replace(name=NASTY)


@pytest.fixture(scope="module")
def results(case, tmp_path_factory):
    """{kind: (what saves itself to a folder, names of its pictures)}."""
    tuned = tuning.tune(
        case,
        nominal=True,
        starts=1,
        screening=2,
        iterations=3,
        validation=4,
        limits={"max_level": 30.0},
    )
    cloud = tuning.ensemble(case, samples=4, limits={"max_level": 9.0})
    sensitive = tuning.sensitivity(
        case, {"plant.drain[0]": tuning.Uniform(relative=0.05)}, measures=["rms_error_total"]
    )
    folder = tmp_path_factory.mktemp("logs")
    t = np.arange(0.0, 60.0, 2.0)
    level = 5.0 + 2.0 * np.sin(t / 10.0)
    rows = [f"{a:g},3,3,{h:.3f},{h:.3f}" for a, h in zip(t, level)]
    path = folder / 'log <i>&"$_^{$".csv'
    path.write_text("t [s],pump1 [V],pump2 [V],h1 [cm],h2 [cm]\n" + "\n".join(rows) + "\n")
    record = read_log(path, case.loop, {}, ".")
    found = tuning.identify(
        case,
        [record],
        {"plant.pump_gain[0]": (1.0, 20.0)},
        start="measured",
        starts=1,
        iterations=3,
    )
    row = {
        "quantity": NASTY,
        "unit": "cm",
        "where": "<sec>",
        "published": 1.0,
        "measured": 2.0,
        "verdict": "differs",
        "reason": NASTY,
        "kind": "number",
    }
    pages = {
        "calofir": {
            "paper": "calofir",
            "citation": NASTY,
            "rows": [row, {**row, "verdict": "reproduced"}],
        }
    }
    return {
        "tune": (
            tuned.save,
            [
                "responses",
                "rig",
                "margins",
                "inner",
                "saturation",
                "clouds",
                "convergence",
                "landscape",
            ],
        ),
        "uncertainty": (cloud.save, ["fan", "violations", "rig"]),
        "sensitivity": (sensitive.save, ["tornado"]),
        "identify": (found.save, ["fit", "residuals", "rig"]),
        "compare": (lambda *a: papers.save(pages, *a), ["published", "rig-calofir"]),
    }


@pytest.fixture(scope="module")
def folders(results, tmp_path_factory):
    """{kind: folder that it was saved to}."""
    made = {}
    for kind, (save, _) in results.items():
        made[kind] = tmp_path_factory.mktemp(kind)
        save(made[kind], f"jaxtank {kind} {NASTY}")
    plt.close("all")
    return made


# the live page, which has no access to the report and a policy of its own (tests/unit/live)
LIVE = re.compile(
    r'<iframe class="live" title="[^"<]*" width="100%" height="900"'
    r' sandbox="allow-scripts allow-downloads" allow="clipboard-write" loading="lazy"'
    r' srcdoc="[^"<]*default-src \'none\'[^"<]*">'
)


@pytest.mark.parametrize("kind", KINDS)
def test_a_page_is_well_formed_and_asks_nothing_of_the_network(folders, kind):
    whole = (folders[kind] / "report.html").read_text(encoding="utf-8")
    text, frames = LIVE.subn("<iframe>", whole)
    assert frames == whole.count("<iframe") == (kind in ("tune", "uncertainty", "compare"))
    if kind == "compare":  # what was found comes before what can be moved
        assert text.index('id="published"') < text.index("<table") < text.index("<iframe>")
    elif frames:
        assert text.index("<iframe>") < text.index("<figure")
    read = Reader(text)
    assert len(read.ids) == len(set(read.ids))
    for tag, attrs in read.tags:
        assert tag not in ("script", "link", "object"), tag
        for name in ("src", "href"):
            assert attrs.get(name, "#").startswith(("#", "data:image/png;base64,")), (
                tag,
                attrs[name][:60],
            )
        assert not any(n.startswith("on") for n in attrs)
    pointed = set(re.findall(r'(?:href="#|url\(#)([^")]+)', text))
    assert pointed and pointed <= set(read.ids)
    assert "http" not in text and "@import" not in text and "@font-face" not in text
    assert len(text) < 2_000_000
    assert '<meta name="viewport"' in text and "@media print" in text and "max-width" in text


@pytest.mark.parametrize("kind", KINDS)
def test_every_picture_is_there_with_words_to_it(results, folders, kind):
    text = (folders[kind] / "report.html").read_text(encoding="utf-8")
    figures = re.findall(r'<figure id="([^"]+)".*?</figure>', text, flags=re.DOTALL)
    assert figures == results[kind][1]
    assert {f"{name}.png" for name in figures} == {p.name for p in folders[kind].glob("*.png")}
    assert text.count("<svg ") == text.count('role="img"') == len(figures)
    assert all(caption.strip() for caption in re.findall(r"<figcaption>(.*?)</figcaption>", text))
    assert [p.name for p in folders[kind].iterdir() if p.name.startswith(".")] == []


@pytest.mark.parametrize("kind", KINDS)
def test_what_users_call_things_is_text_and_no_markup(folders, kind):
    text = (folders[kind] / "report.html").read_text(encoding="utf-8")
    read = Reader(text)
    assert f"jaxtank {kind} {NASTY}" in read.words  # the command
    assert not any(tag in ("b", "i", "sec") for tag, _ in read.tags)
    if kind == "identify":
        # in a picture, and not set as mathematics
        assert 'log <i>&"$_^{$".csv, measured and simulated' in read.words
    else:
        assert read.words.count("alert(1)") > 2


@pytest.mark.parametrize(
    "kind",
    [
        "tune",
        "sensitivity",
        "compare",
        *(pytest.param(k, marks=pytest.mark.slow) for k in KINDS[1::2]),
    ],
)
def test_a_picture_that_fails_costs_itself_and_not_the_answer(
    results, folders, kind, tmp_path, monkeypatch, capsys
):
    """A text that matplotlib cannot set, in one picture; then a function that cannot draw. Nothing
    of an earlier result stays.
    """
    plot, name = (responses, "panels") if kind == "sensitivity" else (pictures, "rig")
    usual, (save, _) = getattr(plot, name), results[kind]
    whole = {path.name for path in folders[kind].iterdir()}
    shutil.copytree(folders[kind], tmp_path, dirs_exist_ok=True)

    def unset(*args):
        drawn = usual(*args)
        for figure in drawn.values() if isinstance(drawn, dict) else [drawn]:
            figure.suptitle(r"$\x{$")
        return drawn

    def undrawn(*_):
        plt.figure()
        raise ZeroDivisionError

    for fault in (unset, undrawn):
        monkeypatch.setattr(plot, name, fault)
        written = save(tmp_path, "")
        (note,) = capsys.readouterr().err.splitlines()
        assert note.startswith("jaxtank: note: ") and "could not be drawn" in note
        left = {path.name for path in tmp_path.iterdir()}
        assert (
            left == {path.name for path in written}
            and {"result.json", "report.html"} <= left < whole
        )
        assert len(whole - left) == 1 or fault is undrawn
        assert all(n.endswith(".png") for n in whole - left)
        assert json.loads((tmp_path / "result.json").read_text())
        assert not plt.get_fignums()


def test_results_are_on_the_disk_before_any_picture_is_drawn(
    results, folders, tmp_path, monkeypatch
):
    """A program that ends while it draws, as by a second Ctrl-C, leaves the answer."""

    class Ended(BaseException):
        pass

    def end(*_):
        raise Ended

    monkeypatch.setattr(responses, "responses", end)
    with pytest.raises(Ended):
        results["tune"][0](tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        "result.json",
        "rig.toml",
        "trajectory.csv",
        "before.csv",
    }
    assert (tmp_path / "rig.toml").read_bytes() == (folders["tune"] / "rig.toml").read_bytes()


def test_the_numbers_of_a_tuning_are_on_its_page(results, folders):
    read = Reader((folders["tune"] / "report.html").read_text(encoding="utf-8"))
    result = results["tune"][0].__self__
    for printed in (
        *result.message.split("; "),
        *result.parameters,
        tables.number(result.objective["after"]),
        "seed",
    ):
        assert " ".join(printed.split()) in read.words
    warned = [a for tag, a in read.tags if a.get("class", "").startswith("status")]
    assert ("warn" in warned[0]["class"]) == (not result.success)
    assert "[controller]" in read.words or "controller" in rig.dump(result.tuned)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_same_result_gives_the_same_bytes(results, folders, tmp_path, kind):
    save, _ = results[kind]
    save(tmp_path, f"jaxtank {kind} {NASTY}")
    plt.close("all")
    assert (tmp_path / "report.html").read_bytes() == (folders[kind] / "report.html").read_bytes()


def test_ids_of_two_equal_figures_do_not_clash():
    def drawn():
        figure, ax = plt.subplots()
        ax.plot([0, 1], [0, 1], "o-")
        return figure

    one, other = (html.svg(drawn(), name) for name in ("one", "other"))
    plt.close("all")
    ids = [set(re.findall(r' id="([^"]+)"', text)) for text in (one, other)]
    assert all(ids) and not ids[0] & ids[1]
    assert one.replace("one-", "").count("#") == other.replace("other-", "").count("#") > 0


def test_a_picture_of_very_many_points_is_kept_small():
    figure, ax = plt.subplots()
    angle = np.linspace(0.0, 1000.0, 200_000)
    ax.plot(np.cos(angle) * np.sin(1.7 * angle), np.sin(3.1 * angle), linewidth=0.2)
    text = html.svg(figure, "dense")
    plt.close(figure)
    assert "data:image/png" in text and len(text) < html.LARGEST


def test_compare_and_show_write_to_the_folder_asked_for(tmp_path, monkeypatch, capsys):
    row = {
        "quantity": "q",
        "unit": "m",
        "where": "eq. 1",
        "published": 1.0,
        "measured": 1.0,
        "verdict": "reproduced",
        "reason": "",
        "kind": "number",
    }
    monkeypatch.setattr(
        papers, "measure", lambda paper: {"paper": paper, "citation": "C", "rows": [row]}
    )
    assert main.main(["compare", "calofir", "--out", str(tmp_path / "one"), "--quiet"]) == 0
    assert {p.name for p in (tmp_path / "one").iterdir()} == {
        "published.png",
        "report.html",
        "result.json",
        "rig-calofir.png",
    }
    assert json.loads((tmp_path / "one" / "result.json").read_text())["rows"] == [row]
    assert (
        f"jaxtank compare calofir --out {tmp_path / 'one'}"
        in (tmp_path / "one" / "report.html").read_text()
    )
    assert main.main(["show", "mirakhorli/sfc", "--out", str(tmp_path / "two"), "--quiet"]) == 0
    # a file of its own needs its namespace
    drawn = xml.etree.ElementTree.parse(tmp_path / "two" / "rig.svg").getroot()
    assert drawn.tag == "{http://www.w3.org/2000/svg}svg"
    assert {"pump 1", "tank 3", "42 %"} <= {t.strip() for t in drawn.itertext()}
    (tmp_path / "file").write_text("")
    for asked in (["compare", "calofir"], ["show", "mirakhorli/sfc"]):
        assert main.main([*asked, "--out", str(tmp_path / "file")]) == 2
    assert capsys.readouterr().err.count("is a file") == 2


def shown(*sections):
    return html.document(Report("t", "s", [], sections))


def test_sections_become_tables_lists_and_paragraphs():
    table = Table([["x<1", Value(2)], ["y", "-"]], ["name", "value"])
    columns = Text(["one   two"], layout=True)
    words = "limits hold on 256 of 256 plants of the rig with two tanks, proved for the first tank"
    notes = Text(["first", "second"], items=True)
    sections = [Text([words, "other"]), notes, table, columns, Text(["never"], on="terminal")]
    read = Reader(shown(*sections))
    tags = [tag for tag, _ in read.tags]
    counts = {"li": 2, "ul": 1, "td": 4, "th": 2, "pre": 1}
    assert {tag: tags.count(tag) for tag in counts} == counts
    assert ("td", {"class": "number"}) in read.tags and "never" not in read.words
    assert "x<1" in read.words and f"<p>{words}</p>" in html.fragment(sections)
    text = terminal(Report("t", "s", [], sections, width=80)).splitlines()
    assert text[:6] == [*textwrap.wrap(words, 80), "other", "- first", "- second", "name  value"]


BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
browser = pytest.mark.skipif(
    BROWSER is None, reason="no chromium, chromium-browser or google-chrome on the path"
)


def seen(path, shot):
    """(what the browser complains of, the page as it understood it); a picture of it is written to
    `shot`.
    """
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--enable-logging=stderr",
        "--log-level=0",
        "--window-size=420,1600",
    ]
    flags += [
        f"--user-data-dir={shot.parent / 'profile'}",
        "--disable-dev-shm-usage",
        "--virtual-time-budget=2000",
    ]
    options = {"capture_output": True, "text": True, "timeout": 120, "check": True}
    subprocess.run([BROWSER, *flags, f"--screenshot={shot}", path.as_uri()], **options)
    done = subprocess.run([BROWSER, *flags, "--dump-dom", path.as_uri()], **options)
    return [line for line in done.stderr.splitlines() if "CONSOLE" in line], done.stdout


@browser
@pytest.mark.parametrize("kind", KINDS)
def test_a_browser_opens_the_page_without_complaint(results, folders, tmp_path, kind):
    complaints, dom = seen(folders[kind] / "report.html", tmp_path / "shot.png")
    assert complaints == []
    dom = re.sub(r' srcdoc="[^"]*"', "", dom)
    assert dom.count("<svg ") == dom.count("<figure ") == len(results[kind][1])
    picture = matplotlib.image.imread(tmp_path / "shot.png")
    assert picture.shape[1] == 420 and picture[..., :3].std() > 0.05


@browser
def test_a_complaint_would_be_reported(tmp_path):
    (tmp_path / "bad.html").write_text(
        "<!DOCTYPE html><title>x</title><script>console.error('oh')</script>"
    )
    assert seen(tmp_path / "bad.html", tmp_path / "shot.png")[0]


def probed(page, expression, width, folder):
    """The page as the browser understood it, its title replaced by the value of `expression`."""
    script = f"<script>document.title = {expression}</script></body>"
    (folder / "probe.html").write_text(page.replace("</body>", script), encoding="utf-8")
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--disable-background-networking",
    ]
    flags += [
        f"--window-size={width},1000",
        f"--user-data-dir={folder / 'profile'}",
        "--virtual-time-budget=2000",
        "--dump-dom",
    ]
    options = {"capture_output": True, "text": True, "timeout": 120, "check": True}
    return subprocess.run([BROWSER, *flags, (folder / "probe.html").as_uri()], **options).stdout


@browser
@pytest.mark.parametrize("kind", KINDS)
def test_pictures_fit_a_phone_and_scroll_once_they_are_tapped(folders, tmp_path, kind):
    """None is wider than the text; an enlarged one is wider than its box, which scrolls.

    A browser without a window gives the focus when it likes, so a class stands for it.
    """
    page = (folders[kind] / "report.html").read_text(encoding="utf-8")
    assert ":focus" in page
    page = page.replace(":focus", ".tapped")
    probe = """
        JSON.stringify([...document.querySelectorAll('figure > div')].map(box => {
            const svg = box.querySelector('svg'), column = document.querySelector('main');
            const right = e => e.getBoundingClientRect().right;
            const fits = right(svg) <= right(column) + 0.5 && svg.clientWidth > 300;
            box.classList.add('tapped');
            const wide = box.parentElement.className === 'wide';
            const scrolls = box.scrollWidth > box.clientWidth + 100;
            return fits && scrolls === wide && getComputedStyle(box).overflowX === 'auto';
        }))"""
    dom = probed(page, probe, 390, tmp_path)
    found = json.loads(dom[dom.index("<title>") + 7 : dom.index("</title>")])
    assert len(found) == page.count("<figure ") and all(found), found


@browser
@pytest.mark.parametrize("width", [1400, 900, 390])
def test_no_column_of_a_page_of_claims_is_cut(tmp_path, width):
    """What a box of the page holds is no wider than the box: nothing has to be pushed aside to be
    read.
    """
    words = (
        "the ideal rig starts faster, without delay, lag or noise, and its pumps are stronger than"
        " those of the paper"
    )
    row = {
        "quantity": "RMS error of CHADPC against ENMPC, paper-like rig",
        "unit": "cm^3/(s V)",
        "where": "sec. 5.1, 5.3, Table 2",
    }
    row |= {"published": words, "measured": words, "verdict": "differs", "reason": words}
    row["kind"] = "claim"
    listed = row | {
        "published": tuple(0.123456 + k for k in range(16)),
        "measured": tuple(0.654321 + k for k in range(16)),
    }
    papers.save({"calofir": {"paper": "calofir", "citation": "C", "rows": [row, listed]}}, tmp_path)
    whole = (tmp_path / "report.html").read_text()
    probe = (
        "Math.max(...[...document.querySelectorAll('.scroll, main')].map(e => e.scrollWidth -"
        " e.clientWidth))"
    )
    dom = probed(whole, f"'cut ' + {probe}", width, tmp_path)
    assert "<title>cut 0</title>" in dom, dom[dom.index("<title>") :][:60]


def test_cells_of_a_table_of_texts_carry_their_headings():
    """A narrow window shows them one below the other."""
    read = shown(Table([["x", 2, "w" * 80], ["y", 3, ""]], ["name", "value", 'why "so"']))
    assert '<div class="scroll texts">' in read and read.count('data-head="name"') == 2
    assert 'data-head="why &#34;so&#34;"' in read
    plain = shown(Table([["x", 2]], ["name", "value"]))
    assert "data-head=" not in plain and '<div class="scroll">' in plain
